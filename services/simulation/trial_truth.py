"""Truth of the crossings of a site validation."""

from statistics import NormalDist
from typing import Final

import numpy as np

from schemas.site import Site
from schemas.validation_records import ValidationConditions
from services.simulation.drawn import CrossingTruth, draw_truth
from services.simulation.drive import beam_of
from services.simulation.wheel_paths import WANDER_M, SurfaceOptions, wheel_paths_of

CROSSINGS: Final = 12
WEAK_RATIO: Final = 0.5
_STEADY_M_PER_S2: Final = 0.1
"""Largest change of speed: a survey is driven evenly."""
ALL_SEEDS: Final = 1 << 63
"""Number of seeds of crossings."""


def drawn_truth(
    site: Site, conditions: ValidationConditions, seed: int, number: int
) -> tuple[CrossingTruth, int | None]:
    """Return the truth of a crossing, and the index of its weak element, if any."""
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    truth = draw_truth(site, seed, _mass_score(seed - number, number))
    how = truth.conditions
    truth = truth._replace(
        conditions=how._replace(
            road_class=conditions.road_class,
            speed_m_per_s=conditions.speed_m_per_s,
            change_m_per_s=min(how.change_m_per_s, _STEADY_M_PER_S2 * how.period_s / (2.0 * np.pi)),
            rate_hz=conditions.rate_hz,
        ),
        paths=wheel_paths_of(vehicle, SurfaceOptions(None, None, WANDER_M))
        if conditions.road == "surface" and vehicle.tandem is None
        else None,
    )
    if number % 3 != 1:
        return truth, None
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x5EA4]))
    weak = int(rng.integers(bridge.elements))
    ratios = np.ones(bridge.elements)
    ratios[weak] = WEAK_RATIO
    rigidity = beam_of(bridge, ratios).flexural_rigidity_nm2
    return truth._replace(beam=truth.beam._replace(flexural_rigidity_nm2=rigidity)), weak


def _mass_score(first_seed: int, number: int) -> float:
    """Return the standard score of a crossing's total mass: the medians of twelfths of the prior.

    Nothing but the prior determines the mass, to which all EI of a crossing are proportional.
    Twelve independent draws are one set of luck, shared by every pair, that decides alone where
    everything else is known well.
    """
    rng = np.random.default_rng(np.random.SeedSequence([first_seed % ALL_SEEDS, 0x3A55]))
    part = int(rng.permutation(CROSSINGS)[number % CROSSINGS])
    return NormalDist().inv_cdf((part + 0.5) / CROSSINGS)
