"""The data of simulated crossings as the engine gives them, without any identification."""

from typing import Any

import numpy as np

from pre_core.crossing.preparation import Inputs
from schemas.reasons import Reason
from schemas.results import Crossing
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS
from schemas.site import Site
from services.drives.runs import Run
from services.identification.crossing_data import CrossingData, Passing, rejected
from services.identification.pre_method import inputs_of
from services.simulation.drawn import Seen, see


def data_alone(runs: list[Run], site: Site, settings: IdentificationSettings) -> list[Seen]:
    """What the engine would give to a method of every crossing; nothing is identified.

    The results are rejections without a reason that means anything.
    """

    def nothing(data: CrossingData, settings: IdentificationSettings, **others: Any) -> Crossing:
        passing = Passing(data.stay.entry_s, data.stay.exit_s, 0.0)
        return rejected(data, settings, passing, [Reason.FAILED])

    return see(runs, site, settings, nothing)


def inputs_of_seen(seen: Seen) -> Inputs:
    """A crossing as method `pre` takes it: all samples that the engine gave."""
    samples = seen.data.samples
    assert samples is not None  # noqa: S101 - a recording without any has no crossings
    acceleration = np.stack([samples.channels[name] for name in CHANNELS])
    return inputs_of(seen.data, seen.settings, acceleration, samples.start_s)
