"""Prior draws and diagnostics of crossings, with their posterior draws, as ArviZ groups them."""

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from schemas.results import CrossingResult, Prior, Results
from services.common.arrays import Floats
from services.common.extras import check_installed
from services.history.draws import DrawsOfCrossing, posterior

if TYPE_CHECKING:
    import xarray as xr

_DRAWS: Final = 2000
_SEED: Final = 1


def prior_of(crossings: Sequence[CrossingResult]) -> "xr.Dataset":
    """Return draws of the priors as arrays (chain, draw, crossing), one chain of 2000.

    The names are those of the posterior. Common factors of mass and gain are not in the draws. A
    prior with a spike gives zeros, so results of older programs, which do not name it, give none.
    """
    rng = np.random.default_rng(_SEED)
    drawn = []
    for crossing in crossings:
        known = {n: p.prior for n, p in (crossing.parameters or {}).items() if p.prior is not None}
        draws = {name: _drawn(prior, rng)[np.newaxis] for name, prior in known.items()}
        drawn.append(
            DrawsOfCrossing(crossing.crossing_id, crossing.vehicle, crossing.bridge, draws)
        )
    return posterior(drawn)


def groups_beside(path: Path, crossings: Sequence[CrossingResult]) -> "dict[str, xr.Dataset]":
    """Return the groups of a file of draws beyond the posterior's; none in a `.npz`."""
    if path.suffix != ".nc" or not crossings:
        return {}
    return {"prior": prior_of(crossings), "sample_stats": statistics_of(crossings)}


def origin_of(results: Results) -> dict[str, str]:
    """Return the header of results as attributes of a group: versions, site, settings, seed."""
    created = datetime.fromtimestamp(results.created, UTC)
    return {
        "created_at": created.isoformat(),
        "inference_library_version": results.version,
        "site_hash": results.site_hash,
        "settings": json.dumps(results.settings),
    }


def prior_draws(prior: Prior) -> Floats:
    """Return 2000 draws (n,) of a prior."""
    return _drawn(prior, np.random.default_rng(_SEED))


def prior_density(prior: Prior, values: Floats) -> Floats:
    """Return the density of a prior without its spike, at values (n,), up to a constant factor."""
    if prior.distribution == "uniform":
        return (np.abs(values - prior.location) <= prior.scale).astype(np.float64)
    if prior.distribution == "log_normal":
        positive = np.maximum(values, np.finfo(np.float64).tiny)
        z = np.log(positive / prior.location) / prior.scale
        return np.asarray(np.where(values > 0.0, np.exp(-0.5 * z**2) / positive, 0.0))
    density = np.exp(-0.5 * ((values - prior.location) / prior.scale) ** 2)
    is_possible = prior.distribution != "half_normal" or values >= prior.location
    return np.asarray(np.where(is_possible, density, 0.0))


def _drawn(prior: Prior, rng: np.random.Generator) -> Floats:
    """Return draws (n,) of a prior, with the zeros of its spike."""
    values = _continuous(prior, rng)
    if prior.probability_zero is None:
        return values
    return np.where(rng.random(_DRAWS) < prior.probability_zero, 0.0, values)


def _continuous(prior: Prior, rng: np.random.Generator) -> Floats:
    """Return draws (n,) of a prior's distribution, without its spike."""
    if prior.distribution == "uniform":
        return prior.location + prior.scale * rng.uniform(-1.0, 1.0, _DRAWS)
    standard = rng.standard_normal(_DRAWS)
    if prior.distribution == "log_normal":
        return np.asarray(prior.location * np.exp(prior.scale * standard))
    if prior.distribution == "half_normal":
        standard = np.abs(standard)
    return np.asarray(prior.location + prior.scale * standard)


def statistics_of(crossings: Sequence[CrossingResult]) -> "xr.Dataset":
    """Return diagnostics of the draws and of the fit as arrays (crossing,), NaN where absent."""
    check_installed("a dataset of diagnostics", "xarray")
    import xarray as xr

    names = sorted({name for crossing in crossings for name in crossing.diagnostics})
    rows = {
        name: [float(crossing.diagnostics.get(name, np.nan)) for crossing in crossings]
        for name in names
    }
    rows["chi2_per_dof"] = [
        np.nan if crossing.chi2_per_dof is None else crossing.chi2_per_dof for crossing in crossings
    ]
    return xr.Dataset(
        {name: ("crossing", values) for name, values in rows.items()},
        coords={
            "crossing": [crossing.crossing_id for crossing in crossings],
            "verdict": ("crossing", [str(crossing.verdict) for crossing in crossings]),
        },
        attrs={"inference_library": "driveby"},
    )
