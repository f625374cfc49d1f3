"""Calibration of a method's intervals on many simulated crossings.

One crossing becomes one record (`record`), a JSON object with all data of the statistics; records
can be stored, merged and inspected singly.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from typing import Any, NamedTuple

import numpy as np

from pre_core import parameters
from pre_core.constants import NORMAL_975
from pre_core.physics.road import Profile
from schemas.results import CrossingResult, Parameter
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.common.arrays import Floats
from services.common.child_process import ChildPool
from services.identification.result_parts import detrended
from services.simulation.drawn import (
    IdentifiedCrossing,
    SimulatedCrossing,
    draw_truth,
    drive,
    identify_simulated,
)
from studies.simulation.truths import true_values
from studies.validation import calibration_statistics as statistics
from studies.validation.bound import bound_at_truth
from studies.validation.calibration_statistics import Scores

Record = dict[str, Any]
"""One crossing as JSON, see `record`."""

_FEWEST_RANKS = 20
"""Fewest ranks for a test of uniformity."""


def _estimates(result: CrossingResult) -> dict[str, Parameter]:
    estimates = dict(result.parameters or {})
    if result.derived is not None:
        estimates["f1_hz"] = result.derived.f1_hz
        estimates["max_deflection_m"] = result.derived.max_deflection_m
    return estimates


def road_z(result: CrossingResult, road: Profile) -> float | None:
    """Return the rms of the road's error over its standard deviation; None without a road.

    The error is less its parabola: `std_m` does not cover offset, tilt and bend.
    """
    if result.road is None or result.road.std_m is None:
        return None
    x = np.array(result.road.x_m)
    error = np.array(result.road.mean_m) - np.interp(x, road.x_m, road.height_m)
    std = np.maximum(np.array(result.road.std_m), 1e-9)
    return float(np.sqrt(np.mean((detrended(x, error, 2) / std) ** 2)))


def record(
    seed: int,
    drawn: SimulatedCrossing,
    seen: IdentifiedCrossing | None,
    bound: dict[str, dict[str, float]],
) -> Record:
    """Return one crossing as JSON: conditions, truth, verdict, estimates and bounds by name."""
    truth = true_values(drawn.truth) | {"max_deflection_m": drawn.largest_deflection_m}
    line: Record = {
        "seed": seed,
        "conditions": drawn.truth.conditions._asdict(),
        "truth": truth,
    }
    if seen is None:
        return line | {
            "verdict": "not_found",
            "reasons": [],
            "estimates": {},
            "ranks": {},
            "bound": bound,
        }
    result = seen.result
    estimates = _estimates(result)
    return line | {
        "verdict": result.verdict,
        "reasons": [str(reason) for reason in result.reasons],
        "chi2_per_dof": result.chi2_per_dof,
        "diagnostics": dict(result.diagnostics),
        "scale_error": result.scale_error,
        "road_z": road_z(result, drawn.road),
        "estimates": {
            name: {
                "mean": p.mean,
                "std": p.std,
                "q025": p.q025,
                "q50": p.q50,
                "q975": p.q975,
            }
            for name, p in estimates.items()
        },
        "ranks": _ranks(truth, estimates, seen.draws, seed),
        "bound": bound,
    }


def _ranks(
    truth: dict[str, float],
    estimates: dict[str, Parameter],
    draws: dict[str, Floats] | None,
    seed: int,
) -> dict[str, float]:
    """Return the truth's ranks among draws; without draws, as far as three quantiles allow.

    `seed` is that of the random share of ties: springs that are absent in truth and in draws.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x71E5]))
    ranks = {
        name: statistics.rank_from_quantiles(truth[name], p.q025, p.q50, p.q975)
        for name, p in estimates.items()
        if name in truth
    }
    for name, values in (draws or {}).items():
        if name in truth:
            (ranks[name],) = statistics.rank(
                values[:, None], np.array([truth[name]]), rng.uniform(size=1)
            ).tolist()
    return ranks


def one_crossing(
    site: Site, seed: int, settings: IdentificationSettings, declared_noise: float = 1.0
) -> Record:
    """Simulate, identify and judge one crossing; see `record`.

    `declared_noise` is the declared noise over the true one: 0.5 is the negative control.
    """
    drawn = drive(site, draw_truth(site, seed), seed)
    sensor = drawn.site.sensor
    density = tuple(declared_noise * d for d in sensor.noise_density_ug_per_rthz)
    declared = drawn.site.model_copy(
        update={"sensor": sensor.model_copy(update={"noise_density_ug_per_rthz": density})}
    )
    found = identify_simulated([drawn.run], declared, settings)
    if len(found) != 1:
        return record(seed, drawn, None, {})
    is_comparable = found[0].result.parameters is not None and declared_noise == 1.0
    return record(seed, drawn, found[0], bound_at_truth(found[0], drawn) if is_comparable else {})


def in_processes(
    jobs: Sequence[Callable[[], Record]],
    processes: int,
    progress: Callable[[Record], object] = lambda line: None,
) -> list[Record]:
    """Return the records of all jobs, in their order; each process runs one at a time.

    Jobs are pickled: partial applications of functions of modules.
    """
    if processes == 1:
        lines = []
        for job in jobs:
            lines.append(job())
            progress(lines[-1])
        return lines
    # A fork is impossible: the threads of numba and OpenBLAS would not survive it.
    with ChildPool(processes, "spawn") as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for future in as_completed(futures):
                progress(future.result())
        finally:
            for future in futures:
                future.cancel()
    return [future.result() for future in futures]


# Statistics of many records


class StudyTarget(NamedTuple):
    """One target: a measured value, and its limits."""

    name: str
    measured: float | None
    low: float
    high: float
    note: str = ""

    @property
    def is_met(self) -> bool:
        """Return whether it is met; a target without a measurement is not."""
        return self.measured is not None and self.low <= self.measured <= self.high


GROUPS: dict[str, tuple[str, ...]] = {
    "vehicle": tuple(row.name for row in parameters.SCALARS if row.part == parameters.TRUCK),
    "bridge": ("rhoA", "alpha", "beta"),
    "supports": ("k_rot_start", "k_rot_end"),
    "wheelbase": ("wheelbase",),
    "derived": ("f1_hz", "max_deflection_m"),
}
"""Parameters whose ranks are reported together, as far as the truck and the bridge have them."""
SMALLEST_P = 0.01
"""Probability of the ranks below which a group fails, its parameters tested one by one."""


def elements_of(records: list[Record]) -> int:
    """Return the number of elements of the bridge in these records."""
    return sum(name.startswith("EI_") for name in records[0]["truth"])


def groups_of(records: list[Record]) -> dict[str, tuple[str, ...]]:
    """Return the names of each group of parameters that have a rank in all usable records."""
    usable = [line for line in records if line["estimates"]]
    wanted = {"EI": tuple(f"EI_{e + 1}" for e in range(elements_of(records)))} | GROUPS
    found = {
        group: tuple(name for name in names if all(name in line["ranks"] for line in usable))
        for group, names in wanted.items()
    }
    return {group: names for group, names in found.items() if usable and names}


def scores(records: list[Record]) -> Scores:
    """Return the errors of all crossings with an estimate."""
    usable = [line for line in records if line["estimates"]]
    names = [f"EI_{e + 1}" for e in range(elements_of(records))]
    truth = _table(usable, names, lambda line, name: line["truth"][name])

    def estimate(key: str) -> Floats:
        return _table(usable, names, lambda line, name: line["estimates"][name][key])

    low, middle, high = estimate("q025"), estimate("q50"), estimate("q975")
    std_log = np.log(high / low) / (2.0 * NORMAL_975)
    return Scores(
        np.array([line["seed"] for line in usable], dtype=np.int64),
        np.array([line["verdict"] == "good" for line in usable], dtype=np.bool_),
        (estimate("mean") - truth) / estimate("std"),
        np.log(middle / truth) / std_log,
        (low <= truth) & (truth <= high),
        std_log,
        _table(usable, names, lambda line, name: line["bound"].get("std", {}).get(name, np.nan)),
    )


def _table(
    records: list[Record], names: Sequence[str], value: Callable[[Record, str], float]
) -> Floats:
    table = [[value(line, name) for name in names] for line in records]
    return np.array(table, dtype=np.float64).reshape(len(records), len(names))


def ranks_of(records: list[Record]) -> dict[str, Floats]:
    """Return the truth's ranks (crossings, parameters) in usable crossings, by group."""
    usable = [line for line in records if line["estimates"]]
    return {
        group: _table(usable, names, lambda line, name: line["ranks"][name])
        for group, names in groups_of(records).items()
    }


def rank_tests(records: list[Record]) -> dict[str, dict[str, statistics.Uniformity]]:
    """Return by group and parameter whether the truth's ranks are uniform."""
    names = groups_of(records)
    return {
        group: {name: statistics.uniformity(ranks[:, k]) for k, name in enumerate(names[group])}
        for group, ranks in ranks_of(records).items()
        if ranks.shape[0] >= _FEWEST_RANKS
    }


def checks(records: list[Record]) -> list[StudyTarget]:
    """Return the targets of well-specified crossings (docs/validation.md)."""
    s = scores(records)
    if s.seeds.size < 2:
        return [StudyTarget("crossings with numbers", float(s.seeds.size), 2.0, np.inf)]
    pooled = statistics.pooled_share(s.is_covered.astype(np.float64))
    each = s.is_covered.mean(axis=0)
    ratio = float(np.nanmean(s.std_log) / np.nanmean(s.bound))
    good = np.mean([line["verdict"] == "good" for line in records])
    worst = np.maximum(np.abs(s.z), np.abs(s.z_log))[s.is_good]
    tests = rank_tests(records)
    return [
        StudyTarget("pooled coverage", pooled.value, 0.93, 0.97, f"± {pooled.error:.3f}"),
        StudyTarget("coverage of each element, least", float(each.min()), 0.90, 0.99),
        StudyTarget("coverage of each element, most", float(each.max()), 0.90, 0.99),
        StudyTarget(
            "root mean square of z, ln EI", statistics.root_mean_square(s.z_log), 0.9, 1.15
        ),
        StudyTarget("root mean square of z, EI", statistics.root_mean_square(s.z), 0.9, 1.15),
        StudyTarget("mean standard deviation over bound", ratio, 0.0, 1.25),
        StudyTarget("share good", float(good), 0.95, 1.0),
        StudyTarget("largest |z| among good", float(worst.max()) if worst.size else None, 0.0, 5.0),
        *(
            StudyTarget(
                f"ranks of {group}, p",
                statistics.bonferroni_p_value(
                    np.array([test.p_value for test in of_group.values()])
                ),
                SMALLEST_P,
                1.0,
                min(of_group, key=lambda name: of_group[name].p_value),
            )
            for group, of_group in tests.items()
        ),
    ]


def distribution(records: list[Record], key: str) -> dict[str, float] | None:
    """Return quantiles of a diagnostic, or of a number of the records; None without any."""
    values = [line.get("diagnostics", {}).get(key, line.get(key)) for line in records]
    known = np.array([value for value in values if value is not None], dtype=np.float64)
    if known.size == 0:
        return None
    shares = {"least": 0.0, "5 %": 0.05, "median": 0.5, "95 %": 0.95, "most": 1.0}
    return {name: float(np.quantile(known, q)) for name, q in shares.items()}


def by_condition(records: list[Record]) -> list[tuple[str, int, float, float | None, float | None]]:
    """Return crossings, share good, coverage and rms of z in parts of the conditions."""

    def change(line: Record) -> float:
        how = line["conditions"]
        return float(2.0 * np.pi * how["change_m_per_s"] / how["period_s"])

    parts: list[tuple[str, Callable[[Record], bool]]] = [
        ("at most 200 Hz", lambda line: line["conditions"]["rate_hz"] <= 200.0),
        ("500 Hz", lambda line: line["conditions"]["rate_hz"] == 500.0),
        ("1000 Hz and more", lambda line: line["conditions"]["rate_hz"] >= 1000.0),
        ("below 10 m/s", lambda line: line["conditions"]["speed_m_per_s"] < 10.0),
        ("10 to 18 m/s", lambda line: 10.0 <= line["conditions"]["speed_m_per_s"] < 18.0),
        ("18 m/s and more", lambda line: line["conditions"]["speed_m_per_s"] >= 18.0),
        ("speed changes by more than 0.3 m/s²", lambda line: change(line) > 0.3),
        ("steadier", lambda line: change(line) <= 0.3),
        ("road class A", lambda line: line["conditions"]["road_class"] == "A"),
        ("road class B", lambda line: line["conditions"]["road_class"] == "B"),
        ("less than 50 µg/√Hz", lambda line: line["conditions"]["noise_ug_per_rthz"] < 50.0),
        ("50 µg/√Hz and more", lambda line: line["conditions"]["noise_ug_per_rthz"] >= 50.0),
        ("start to end", lambda line: line["conditions"]["forward"]),
        ("end to start", lambda line: not line["conditions"]["forward"]),
        ("1 fix a second", lambda line: line["conditions"]["fix_rate_hz"] < 5.0),
    ]
    rows = []
    for name, belongs in parts:
        chosen = [line for line in records if belongs(line)]
        if not chosen:
            continue
        s = scores(chosen)
        good = float(np.mean([line["verdict"] == "good" for line in chosen]))
        covered = float(s.is_covered.mean()) if s.seeds.size else None
        rms = statistics.root_mean_square(s.z_log) if s.seeds.size else None
        rows.append((name, len(chosen), good, covered, rms))
    return rows
