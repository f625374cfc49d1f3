"""Data of simulated crossings from the engine, without identification."""

from typing import Any

import numpy as np

from pre_core.crossing.preparation import CrossingInputs
from schemas.reasons import Reason
from schemas.results import CrossingResult
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.drives.runs import Run
from services.finding.crossing_data import CrossingData
from services.finding.placed import middle_of
from services.identification.pre_method import inputs_of
from services.identification.result_parts import CrossingTimes, rejected
from services.simulation.drawn import IdentifiedCrossing, identify_simulated


def crossing_data_only(
    runs: list[Run], site: Site, settings: IdentificationSettings
) -> list[IdentifiedCrossing]:
    """Return the engine's data of every crossing, with meaningless rejections as results."""

    def nothing(
        data: CrossingData, settings: IdentificationSettings, **others: Any
    ) -> CrossingResult:
        passing = CrossingTimes(data.stay.entry_s, data.stay.exit_s, 0.0)
        return rejected(data, settings, passing, [Reason.FAILED])

    return identify_simulated(runs, site, settings, nothing)


def inputs_of_seen(seen: IdentifiedCrossing) -> CrossingInputs:
    """Return a crossing's input of method `pre`: all samples from the engine."""
    samples = seen.data.samples
    assert samples is not None  # noqa: S101 - a recording without any has no crossings
    vehicle = seen.data.vehicle
    acceleration = np.stack([samples.channels[name] for name in vehicle.channels])
    return inputs_of(seen.data, seen.settings, middle_of(vehicle, acceleration), samples.start_s)
