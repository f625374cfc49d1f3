"""The Markov chains of an identification as a file: `driveby identify --draws`.

Both kinds hold, for every unknown, an array (chain, draw). ArviZ reads them:

    arviz.convert_to_inference_data(dict(numpy.load("OUT.npz")))
    arviz.convert_to_inference_data(xarray.open_dataset("OUT.nc"))

An archive of several crossings names its arrays CROSSING/NAME.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.common.files import replaced_atomically

Draws = dict[str, NDArray[np.float64]]
_SUFFIXES = (".npz", ".nc")


def check_draws(path: Path, method: str) -> None:
    """Refuse what cannot be written, before the work is done."""
    if path.suffix not in _SUFFIXES:
        raise InputError(f"{path}: draws are written as {' or '.join(_SUFFIXES)}")
    if method != "pre":
        raise InputError(f"--draws: method {method} has no draws, pre has")


def write_draws(path: Path, crossings: dict[str, Draws]) -> None:
    """Write the draws of every crossing that has some."""
    if len(crossings) == 1:
        (arrays,) = crossings.values()
    else:
        arrays = {
            f"{name}/{key}": x for name, draws in crossings.items() for key, x in draws.items()
        }
    if path.suffix == ".nc":
        if len(crossings) > 1:
            raise InputError(
                f"{path}: a netCDF file holds one crossing, these are {len(crossings)}; use .npz"
            )
        _write_netcdf(path, arrays)
        return
    with replaced_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _write_netcdf(path: Path, arrays: Draws) -> None:
    from scipy.io import netcdf_file  # slow to import, seldom needed

    with replaced_atomically(path) as temporary, netcdf_file(temporary, "w") as file:
        for key, values in arrays.items():
            if "chain" not in file.dimensions:
                file.createDimension("chain", values.shape[0])
                file.createDimension("draw", values.shape[1])
            file.createVariable(key, "f8", ("chain", "draw"))[:] = values
