"""Files of posterior draws: `driveby identify --draws`.

OUT.nc is NetCDF-4 in the convention of ArviZ's InferenceData, for `arviz.from_netcdf("OUT.nc")`: a
group `posterior` in which every parameter is an array (chain, draw, crossing). It needs the extra
`notebook`. OUT.npz needs nothing but numpy and holds arrays (chain, draw) named NAME, or
CROSSING/NAME where there are several crossings.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.parameters import unit
from services.common.errors import InputError
from services.common.extras import check_installed
from services.common.files import replaced_atomically
from services.identification.methods import METHODS

if TYPE_CHECKING:
    import xarray as xr

Draws = dict[str, NDArray[np.float64]]
"""Draws (chains, draws) of every parameter, by name."""
_SUFFIXES = (".npz", ".nc")


class DrawsOfCrossing(NamedTuple):
    """The draws of one crossing, with its names."""

    crossing_id: str
    vehicle: str
    bridge: str
    draws: Draws


def check_draws(path: Path, method: str) -> None:
    """Refuse an invalid file or method before the work is done."""
    check_draws_file(path)
    if not METHODS[method].has_noise_model:
        raise InputError(f"--draws: method {method} has no draws, use --method pre")


def check_draws_file(path: Path) -> None:
    """Refuse an unknown kind of file, or one that needs a package that is not installed."""
    if path.suffix not in _SUFFIXES:
        raise InputError(f"{path}: draws are written as {' or '.join(_SUFFIXES)}")
    if path.suffix == ".nc":
        otherwise = "or name a file .npz"
        check_installed(f"{path}: NetCDF", "xarray", "h5netcdf", otherwise=otherwise)


def write_draws(
    path: Path,
    crossings: Iterable[DrawsOfCrossing],
    groups: "Mapping[str, xr.Dataset] | None" = None,
    origin: Mapping[str, str] | None = None,
) -> None:
    """Write the draws of the crossings that have some; an existing file is replaced.

    A NetCDF file also gets `groups` in addition to its group `posterior`, and in each of them the
    attributes `origin`.
    """
    some = [crossing for crossing in crossings if crossing.draws]
    if path.suffix == ".nc":
        every = {"posterior": posterior(some), **(groups or {})}
        _write_netcdf(path, {name: one.assign_attrs(origin or {}) for name, one in every.items()})
        return
    if len(some) == 1:
        arrays: Mapping[str, NDArray[np.float64]] = some[0].draws
    else:
        arrays = {f"{c.crossing_id}/{name}": x for c in some for name, x in c.draws.items()}
    with replaced_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def posterior(crossings: Iterable[DrawsOfCrossing]) -> "xr.Dataset":
    """Return the draws of several crossings in one dataset: arrays (chain, draw, crossing).

    Chains longer than the shortest are thinned evenly to its length; `draws_sampled` is the number
    of draws before. Where the crossings differ in their parameters, as on bridges of 5 and of 7
    elements, the arrays of each vehicle on each bridge are named VEHICLE.BRIDGE.NAME and have a
    dimension VEHICLE.BRIDGE.crossing of their own.

    Raise InputError if xarray is not installed.
    """
    check_installed("a dataset of draws", "xarray")
    import xarray as xr

    some = [crossing for crossing in crossings if crossing.draws]
    length = min((_length(c.draws) for c in some), default=0)
    are_alike = len({frozenset(c.draws) for c in some}) == 1
    pairs: dict[str, list[DrawsOfCrossing]] = {}
    for c in some:
        pairs.setdefault("" if are_alike else f"{c.vehicle}.{c.bridge}.", []).append(c)
    arrays: dict[str, xr.DataArray] = {}
    for prefix, alike in pairs.items():
        dimension = f"{prefix}crossing"
        of_each = {
            dimension: [c.crossing_id for c in alike],
            f"{prefix}vehicle": (dimension, [c.vehicle for c in alike]),
            f"{prefix}bridge": (dimension, [c.bridge for c in alike]),
            f"{prefix}draws_sampled": (dimension, [_length(c.draws) for c in alike]),
        }
        for name in alike[0].draws:
            values = np.stack([_thinned(c.draws[name], length) for c in alike], axis=-1)
            chains = {"chain": np.arange(values.shape[0]), "draw": np.arange(length)}
            arrays[f"{prefix}{name}"] = xr.DataArray(
                values,
                dims=("chain", "draw", dimension),
                coords={**chains, **of_each},
                attrs={"units": _unit(name)},
            )
    return xr.Dataset(arrays, attrs={"inference_library": "driveby"})


def _unit(name: str) -> str:
    """Return the SI unit of the draws of a name, that of its ending beyond the parameters."""
    try:
        return unit(name)
    except KeyError:
        return "m" if name.endswith("_m") else ""


def _length(draws: Draws) -> int:
    return int(next(iter(draws.values())).shape[1])


def _thinned(values: NDArray[np.float64], length: int) -> NDArray[np.float64]:
    return values[:, np.arange(length) * values.shape[1] // length]


def _write_netcdf(path: Path, groups: "Mapping[str, xr.Dataset]") -> None:
    with replaced_atomically(path) as temporary:
        for number, (name, dataset) in enumerate(groups.items()):
            dataset.to_netcdf(temporary, mode="a" if number else "w", group=name, engine="h5netcdf")
