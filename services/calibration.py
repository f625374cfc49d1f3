"""Many drawn crossings, identified and judged: are the intervals of a method true?

One crossing becomes one record (`record`), a JSON object that holds all that the statistics need;
records can be stored, put together and looked at one by one.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any

import numpy as np

from pre_core.road import Profile
from schemas.results import Crossing, Parameter
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.crossing_bound import bound_at_truth
from services.drawn_crossings import Drawn, Seen, draw_truth, drive, see, true_values
from services.worker.crossing_data import detrended


def _estimates(result: Crossing) -> dict[str, Parameter]:
    estimates = dict(result.parameters or {})
    if result.derived is not None:
        estimates["f1_hz"] = result.derived.f1_hz
        estimates["max_deflection_m"] = result.derived.max_deflection_m
    return estimates


def _road_z(result: Crossing, road: Profile) -> float | None:
    """Root mean square of the road's error over its standard deviation; None without a road.

    Both without their straight lines: integrated accelerations leave level and slope unknown.
    """
    if result.road is None or result.road.std_m is None:
        return None
    x = np.array(result.road.x_m)
    true = detrended(x, np.interp(x, road.x_m, road.height_m))
    std = np.maximum(np.array(result.road.std_m), 1e-9)
    return float(np.sqrt(np.mean(((np.array(result.road.mean_m) - true) / std) ** 2)))


def record(
    seed: int, drawn: Drawn, seen: Seen | None, bound: dict[str, dict[str, float]]
) -> dict[str, Any]:
    """One crossing as JSON: conditions, truth, verdict, estimates and bounds by name."""
    truth = true_values(drawn.truth) | {"max_deflection_m": drawn.largest_deflection_m}
    line: dict[str, Any] = {
        "seed": seed,
        "conditions": drawn.truth.conditions._asdict(),
        "truth": truth,
    }
    if seen is None:
        return line | {"verdict": "not_found", "reasons": [], "estimates": {}, "bound": bound}
    result = seen.result
    return line | {
        "verdict": result.verdict,
        "reasons": [str(reason) for reason in result.reasons],
        "chi2_per_dof": result.chi2_per_dof,
        "diagnostics": dict(result.diagnostics),
        "scale_error": result.scale_error,
        "road_z": _road_z(result, drawn.road),
        "estimates": {
            name: {
                "mean": p.mean,
                "std": p.std,
                "q025": p.q025,
                "q50": p.q50,
                "q975": p.q975,
            }
            for name, p in _estimates(result).items()
        },
        "bound": bound,
    }


def one_crossing(
    site: Site, seed: int, settings: IdentificationSettings, declared_noise: float = 1.0
) -> dict[str, Any]:
    """Draw, drive, identify and judge one crossing; see `record`.

    `declared_noise` is what the owner declares over what the sensors have: 0.5 is the negative
    control.
    """
    drawn = drive(site, draw_truth(site, seed), seed)
    sensor = drawn.site.sensor
    density = tuple(declared_noise * d for d in sensor.noise_density_ug_per_rthz)
    told = drawn.site.model_copy(
        update={"sensor": sensor.model_copy(update={"noise_density_ug_per_rthz": density})}
    )
    found = see([drawn.run], told, settings)
    seen = found[0] if len(found) == 1 else None
    is_comparable = seen is not None and seen.result.parameters and declared_noise == 1.0
    bound = bound_at_truth(seen, drawn) if seen is not None and is_comparable else {}
    return record(seed, drawn, seen, bound)


def many_crossings(
    site: Site,
    seeds: range,
    settings: IdentificationSettings,
    *,
    processes: int = 2,
    declared_noise: float = 1.0,
    progress: Callable[[dict[str, Any]], None] = lambda line: None,
) -> list[dict[str, Any]]:
    """`one_crossing` for every seed, in processes of one thread each; ordered by seed."""
    alone = settings.model_copy(update={"threads": 1})
    lines = []
    for line in _each(site, seeds, alone, processes, declared_noise):
        progress(line)
        lines.append(line)
    return sorted(lines, key=lambda line: int(line["seed"]))


def _each(
    site: Site,
    seeds: range,
    settings: IdentificationSettings,
    processes: int,
    declared_noise: float,
) -> Iterator[dict[str, Any]]:
    if processes == 1:
        for seed in seeds:
            yield one_crossing(site, seed, settings, declared_noise)
        return
    # Not by fork: numba's and OpenBLAS's threads would not survive it.
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(one_crossing, site, s, settings, declared_noise) for s in seeds]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            for future in futures:
                future.cancel()
