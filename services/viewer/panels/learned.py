"""Comparison of posterior and prior: the interval of each parameter against its prior's.

All parameters are on one scale, standard deviations of their own prior from its centre (of the
logarithm, where the prior is log-normal). An interval as wide as the prior means no information, a
point complete information; one at the prior's edge contradicts the site file, but for the lower
edge of a half-normal prior, whose likeliest value is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from pre_core.constants import NORMAL_975
from schemas.results import Prior
from services.common.arrays import Floats
from services.viewer.crossing_scene import CrossingScene, Panel
from services.viewer.crossing_view import ParameterRow
from services.viewer.rerun_parts import (
    MUTED,
    WEAK,
    RerunStream,
    flat_view,
    log_labels,
    log_strips,
    rgb,
)

_HALF_NORMAL_025, _HALF_NORMAL_975 = 0.0313379, 2.2414027
_BEYOND = 4.5
"""Prior standard deviations at which the picture ends."""
_ROW = 0.4
"""Distance between two parameters in prior standard deviations; the view has one scale."""


class PriorPosterior(NamedTuple):
    """One parameter; limits of 95 % in standard deviations of its prior."""

    name: str
    prior: tuple[float, float]
    low: float
    estimate: float
    high: float

    @property
    def share(self) -> float:
        """Width of the interval over the prior's: 0 for complete information, 1 for none."""
        return (self.high - self.low) / (self.prior[1] - self.prior[0])


def prior_posterior_rows(parameters: Sequence[ParameterRow]) -> list[PriorPosterior]:
    """Return the parameters that have a prior, the bridge's elements first."""
    rows = [_row_of(row, row.prior) for row in parameters if row.prior is not None]
    return sorted(rows, key=lambda row: not row.name.startswith("EI_"))


def _row_of(row: ParameterRow, prior: Prior) -> PriorPosterior:
    low, estimate, high = (
        float(np.clip(_in_standard_deviations(value, prior), -_BEYOND, _BEYOND))
        for value in (row.low, row.mean, row.high)
    )
    return PriorPosterior(row.name, _limits(prior), low, estimate, high)


def _in_standard_deviations(value: float, prior: Prior) -> float:
    if prior.scale <= 0.0:
        return 0.0
    if prior.distribution != "log_normal":
        return (value - prior.location) / prior.scale
    if value <= 0.0 or prior.location <= 0.0:
        return -_BEYOND
    return float(np.log(value / prior.location)) / prior.scale


def _limits(prior: Prior) -> tuple[float, float]:
    match prior.distribution:
        case "half_normal":
            return _HALF_NORMAL_025, _HALF_NORMAL_975
        case "uniform":  # its scale is half its width
            return -0.95, 0.95
        case _:
            return -NORMAL_975, NORMAL_975


def _data(scene: CrossingScene) -> list[PriorPosterior] | None:
    has_meaning = scene.crossing.interval_has_meaning
    return (prior_posterior_rows(scene.crossing.parameters) or None) if has_meaning else None


def _layout(scene: CrossingScene, rows: Sequence[PriorPosterior]) -> rrb.View:
    down = (-2.0 * _ROW, (len(rows) + 1) * _ROW)
    return flat_view(f"{scene.root}/learned", "Posterior and prior", (-3.6, 4.2), down)


def _log(recording: RerunStream, scene: CrossingScene, rows: Sequence[PriorPosterior]) -> None:
    """Draw a line for each parameter: its prior, wide and grey, and its posterior on top."""
    entity, doubtful = f"{scene.root}/learned", scene.crossing.is_doubtful
    weak = () if scene.compared is None else scene.compared.weak
    weak_names = {f"EI_{element.number}" for element in weak}

    def colour(row: PriorPosterior) -> tuple[int, int, int]:
        plain = WEAK if row.name in weak_names else "#56B4E9"
        return rgb("#d5d9dd" if doubtful else plain)

    down: Floats = _ROW * np.arange(len(rows), dtype=np.float64)
    priors = [[(row.prior[0], y), (row.prior[1], y)] for row, y in zip(rows, down, strict=True)]
    log_strips(recording, f"{entity}/prior", priors, [rgb("#3a4148")], 5.0, is_behind=True)
    colours = [colour(row) for row in rows]
    intervals = [[(row.low, y), (row.high, y)] for row, y in zip(rows, down, strict=True)]
    log_strips(recording, f"{entity}/interval", intervals, colours, 2.0)
    recording.log(
        f"{entity}/estimate",
        rr.Points2D(
            [(row.estimate, y) for row, y in zip(rows, down, strict=True)],
            colors=colours,
            radii=rr.Radius.ui_points(3.5),
        ),
        static=True,
    )
    nominal = [[(0.0, down[0] - 0.2), (0.0, down[-1] + 0.2)]]
    log_strips(recording, f"{entity}/nominal", nominal, [rgb(MUTED)], 0.5)
    up = down - 0.2  # a label is drawn below its point
    names = [row.name for row in rows]
    log_labels(recording, f"{entity}/name", names, np.full(len(rows), -2.9), up)
    shares = [f"{100.0 * row.share:.2g} % of prior" for row in rows]
    log_labels(recording, f"{entity}/share", shares, np.full(len(rows), 3.3), up)


PANEL: Final = Panel(_data, _layout, _log)
