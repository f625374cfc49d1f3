"""Do surveys reach what is predicted of them? Simulated crossings, identified, beside the plan.

    python -m tests.survey.achieved [RUNS]

The paper's truck over the paper's bridge, both as the site file says; the receiver has errors. On
one groove each run has a road of its own; on a surface all runs of a row are in one lane, and their
likelihoods are fused as well. Some five minutes with five runs.
"""

import os
import sys
from typing import NamedTuple

from services.simulation.drive import DrivenRoad, Measurement

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from pre_core.survey.plan import SurveySpreads, survey_information, survey_spreads
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.identification import fusing
from services.identification.usable import Source, source_of
from services.planning.alternatives import with_noise
from services.planning.crossings import CrossingSimulator, PlannedCrossing, PlannedRoad, scale_error
from services.simulation.drawn import identify_simulated
from services.simulation.drive import declared_site, simulate_drive
from services.simulation.wheel_paths import SurfaceOptions, wheel_paths_of
from studies.simulation.truths import default_site

WANDER_M = 0.12
RATE_HZ = 1000.0
SETTINGS = IdentificationSettings(method="pre", threads=2)


class Row(NamedTuple):
    name: str
    noise_ug: float
    speed_m_per_s: float
    surface: SurfaceOptions | None


ROWS = (
    Row("one groove, 25 µg/√Hz", 25.0, 10.0, None),
    Row("one groove, 100 µg/√Hz", 100.0, 10.0, None),
    Row("one groove, 25 µg/√Hz, 20 m/s", 25.0, 20.0, None),
    Row("surface, single tyres, 5 mm aside", 10.0, 10.0, SurfaceOptions("single", 0.005, WANDER_M)),
    Row("surface, single tyres, 10 mm aside", 10.0, 10.0, SurfaceOptions("single", 0.01, WANDER_M)),
    Row("surface, twin tyres behind", 10.0, 10.0, SurfaceOptions("twin", 0.005, WANDER_M)),
)


class Achieved(NamedTuple):
    """Standard deviations of ln EI, and errors of its mean, run by run."""

    std: np.ndarray  # (runs, e)
    error: np.ndarray
    level_std: np.ndarray  # (runs,)
    level_error: np.ndarray
    verdicts: list[str]
    sources: list[Source]


def site_of(row: Row) -> Site:
    """The owner knows the tyres, but not that the rear axle runs aside."""
    site = declared_site(with_noise(default_site(), (row.noise_ug,) * 4), row.noise_ug, RATE_HZ)
    if row.surface is None:
        return site
    single = row.surface.tyres == "single"
    known = {
        "twin_tyre_distance_m": (0.0, 0.0 if single else 0.33),
        "tyre_width_m": (0.25, 0.25 if single else 0.22),
    }
    return site.model_copy(update={"vehicles": (site.vehicles[0].model_copy(update=known),)})


def predicted(row: Row, crossings: int) -> SurveySpreads:
    site = site_of(row)
    if row.surface is not None:
        aside = {"rear_axle_offset_m": row.surface.rear_offset_m}
        site = site.model_copy(update={"vehicles": (site.vehicles[0].model_copy(update=aside),)})
    crossing = PlannedCrossing(site, row.speed_m_per_s)
    simulated = CrossingSimulator(PlannedRoad("A", WANDER_M, row.surface is not None))
    known = simulated.known(crossing)
    precision = survey_information([simulated.track((crossing,))], crossings, known.log_odds.size)
    found = survey_spreads(known, precision, np.array(site.bridges[0].lengths_m))
    scale = scale_error(site)
    return SurveySpreads(np.hypot(found.elements, scale), float(np.hypot(found.level, scale)))


def achieved(row: Row, runs: int) -> Achieved:
    site = site_of(row)
    lengths = np.array(site.bridges[0].lengths_m)
    asked = None if row.surface is None else row.surface._replace(tyres=None)
    paths = None if asked is None else wheel_paths_of(site.vehicles[0], asked)
    seen = [
        identify_simulated(
            [
                simulate_drive(
                    site,
                    np.ones(7),
                    DrivenRoad("A", 100 if paths else 100 + run, paths),
                    Measurement(
                        row.noise_ug, rate_hz=RATE_HZ, has_receiver_errors=True, seed=(7, run)
                    ),
                    speed_m_per_s=(row.speed_m_per_s,) * 2,
                ).run
            ],
            site,
            SETTINGS,
        )[0]
        for run in range(runs)
    ]
    answered = [one for one in seen if one.draws is not None]
    nominal = np.array(site.bridges[0].nominal_flexural_rigidity_nm2)
    ln_ei = [
        np.log(np.array([one.draws[f"EI_{e + 1}"] for e in range(7)]).T / nominal)  # type: ignore[index]
        for one in answered
    ]
    level = [draws @ lengths / lengths.sum() for draws in ln_ei]
    return Achieved(
        np.array([draws.std(axis=0) for draws in ln_ei]),
        np.array([draws.mean(axis=0) for draws in ln_ei]),
        np.array([draws.std() for draws in level]),
        np.array([draws.mean() for draws in level]),
        [one.result.verdict for one in seen],
        [
            source._replace(crossing_id=f"run-{run}")
            for run, source in enumerate(source_of(one.result) for one in seen)
            if source is not None
        ],
    )


def fused(found: Achieved, lengths: np.ndarray) -> tuple[np.ndarray, float]:
    """Standard deviations of ln EI and of its mean when all runs are one."""
    ln_ei = np.log(fusing.fused(found.sources).ei_nm2)
    return ln_ei.std(axis=0), float((ln_ei @ lengths / lengths.sum()).std())


def percent(values: np.ndarray) -> str:
    return " ".join(f"{100.0 * value:4.1f}" for value in values)


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    print("standard deviations of ln EI_1 … EI_7, and of their mean, in per cent")
    for row in ROWS:
        plan, found = predicted(row, 1), achieved(row, runs)
        error = np.sqrt(np.mean(found.error**2, axis=0))
        level = np.sqrt(np.mean(found.level_error**2))
        print(f"\n{row.name}; {', '.join(found.verdicts)}")
        print(f"  predicted         {percent(plan.elements)}   {100.0 * plan.level:4.1f}")
        std = np.median(found.std, axis=0)
        print(f"  reported          {percent(std)}   {100.0 * np.median(found.level_std):4.1f}")
        print(f"  rms error         {percent(error)}   {100.0 * level:4.1f}")
        if row.surface is not None and runs > 1:
            whole = predicted(row, runs)
            std, level = fused(found, np.array(site_of(row).bridges[0].lengths_m))
            print(
                f"  predicted of all {runs}  {percent(whole.elements)}   {100.0 * whole.level:4.1f}"
            )
            print(f"  all {runs} fused         {percent(std)}   {100.0 * level:4.1f}", flush=True)


if __name__ == "__main__":
    main()
