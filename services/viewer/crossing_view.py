"""Data of one crossing's figure: bare arrays, from whatever file or message."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from schemas.results import CrossingResult, Prior, first_compared_axle, unresolved_note
from services.common.arrays import Floats
from services.identification.comparison import (
    Comparison,
    Estimate,
    compare,
    describe_clear_elements,
    sentences,
    unresolved_elements,
)

VEHICLE_COLOURS = {
    "front": "#0072B2",
    "rear": "#D55E00",
}  # Okabe and Ito: distinguishable by all eyes
TRUTH_COLOUR = "#000000"
VERDICT_COLOURS = {"good": "#009E73", "suspect": "#B57A00", "rejected": "#C0392B"}
BESIDE_S = 1.0
"""Time in s shown before the entry and after the exit of a crossing."""


class CrossingSpan(Protocol):
    """A truck's stay on a bridge, identified or not."""

    @property
    def forward(self) -> bool: ...  # noqa: D102
    @property
    def entry_time_s(self) -> float: ...  # noqa: D102
    @property
    def exit_time_s(self) -> float: ...  # noqa: D102
    @property
    def speed_m_per_s(self) -> float: ...  # noqa: D102
    @property
    def span_m(self) -> float: ...  # noqa: D102


class ElementGeometry(Protocol):
    """The elements of a bridge along its span; `schemas.site.Bridge` fits."""

    @property
    def elements(self) -> int: ...  # noqa: D102
    @property
    def lengths_m(self) -> tuple[float, ...]: ...  # noqa: D102
    @property
    def nominal_flexural_rigidity_nm2(self) -> tuple[float, ...]: ...  # noqa: D102
    @property
    def interior_supports_m(self) -> tuple[float, ...]: ...  # noqa: D102


class ResultElements(NamedTuple):
    """The elements of a bridge according to a result, without a site file."""

    lengths_m: tuple[float, ...]
    nominal_flexural_rigidity_nm2: tuple[float, ...]
    interior_supports_m: tuple[float, ...] = ()

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.lengths_m)


class DetectedCrossingView(NamedTuple):
    """A crossing detected in the positions and not identified; fields as in `CrossingView`."""

    vehicle: str
    bridge: str
    forward: bool
    entry_time_s: float
    exit_time_s: float
    speed_m_per_s: float
    span_m: float


class RoadView(NamedTuple):
    """Road profiles over chainage, all of one length, m."""

    x_m: Floats
    front_m: Floats
    rear_m: Floats

    @property
    def largest_m(self) -> float:
        """Largest absolute height of both profiles, m."""
        return float(max(np.abs(self.front_m).max(), np.abs(self.rear_m).max()))


class ParameterRow(NamedTuple):
    """One line of the table of parameters."""

    name: str
    unit: str
    mean: float
    low: float
    high: float
    prior: Prior | None = None


class ResidualCells(NamedTuple):
    """Residual bins of a fit, in multiples of the declared noise power: 1 is expected."""

    mean_square: Floats
    """Mean squares (3, 3, b): kinds, segments and bands; NaN without data.

    The kinds are profiles, front and rear body; the segments before, on and after the bridge.
    """
    excess_std: Floats
    """Excess (3, 3, b) over 1, in standard deviations of chance."""
    edges_hz: tuple[float, ...]
    """Band edges (b + 1,), the last one infinite."""


class CrossingView(NamedTuple):
    """One crossing as drawn.

    The bridge has n elements: `element_edges_m` has n + 1 values, the others n. A rejected crossing
    has no `rigidity_nm2` and no interval; a crossing without an interval has `interval_nm2` None.
    """

    crossing_id: str
    vehicle: str
    bridge: str
    forward: bool  # driven from the bridge's start to its end
    entry_time_s: float  # UTC since 1970: first axle on
    exit_time_s: float  # last axle off
    speed_m_per_s: float
    method: str
    verdict: str
    reasons: tuple[str, ...]
    reason_texts: tuple[str, ...]
    chi2_per_dof: float | None
    element_edges_m: Floats
    nominal_nm2: Floats
    rigidity_nm2: Floats | None
    interval_nm2: Floats | None  # (n, 2): 2.5 % and 97.5 % points
    road: RoadView | None
    parameters: tuple[ParameterRow, ...]
    interior_supports_m: tuple[float, ...] = ()
    scale_error: float = 0.0
    """Relative standard deviation that all elements share (mass, gain)."""
    resolution: str | None = None
    """Sentence on unresolved elements; None where the crossing resolves every element."""
    residuals: ResidualCells | None = None
    """Residual bins; None where the samples are not available."""
    unresolved: frozenset[int] = frozenset()
    """Numbers of the elements too uncertain to resolve a loss of half their EI."""
    first_axle: int = 1
    """Number of the first of the two compared axles: "front" in the names of files and fields."""

    @property
    def axle_names(self) -> dict[str, str]:
        """Names of the compared axles in words, by "front" and "rear"."""
        if self.first_axle == 1:
            return {"front": "front wheel", "rear": "rear wheel"}
        return {"front": f"axle {self.first_axle}", "rear": f"axle {self.first_axle + 1}"}

    @property
    def difference_name(self) -> str:
        """Name of the difference of both profiles."""
        if self.first_axle == 1:
            return "front − rear"
        return f"axle {self.first_axle} − axle {self.first_axle + 1}"

    @property
    def span_m(self) -> float:
        """Length of the bridge between its bearings, m."""
        return float(self.element_edges_m[-1])

    @property
    def resolved_ratio(self) -> Floats | None:
        """EI over nominal (n,), NaN for an unresolved element; None if rejected."""
        if self.rigidity_nm2 is None:
            return None
        return np.array(
            [
                np.nan if number in self.unresolved else ratio
                for number, ratio in enumerate(self.rigidity_nm2 / self.nominal_nm2, start=1)
            ]
        )

    @property
    def interval_has_meaning(self) -> bool:
        """Whether the method has a noise model, without which an interval means nothing."""
        return "no_noise_model" not in self.reasons

    @property
    def is_doubtful(self) -> bool:
        """Whether the result must not be relied upon."""
        return self.verdict != "good" or not self.interval_has_meaning


def front_axle_chainage(crossing: CrossingSpan, time_s: Floats) -> Floats:
    """Return the front axle's chainage (n,), m, at the mean speed: for display only."""
    travelled = crossing.speed_m_per_s * (time_s - crossing.entry_time_s)
    return travelled if crossing.forward else crossing.span_m - travelled


def summary_line(view: CrossingView) -> str:
    """Return vehicle, bridge, speed, method and goodness of fit in one line."""
    parts = [
        f"{view.vehicle} over {view.bridge}",
        f"{view.speed_m_per_s:.1f} m/s",
        f"method {view.method.replace('_', ' ')}",
    ]
    if view.chi2_per_dof is not None:
        parts.append(f"reduced chi-square {view.chi2_per_dof:.2f}")
    return " · ".join(parts)


def comparison_of(crossing: CrossingView, baseline: Estimate | None = None) -> Comparison | None:
    """Compare the elements of one crossing with the baseline or each other; None without any."""
    if crossing.rigidity_nm2 is None or crossing.interval_nm2 is None:
        return None
    if not crossing.interval_has_meaning:
        return None
    low, high = crossing.interval_nm2.T
    found = Estimate(crossing.rigidity_nm2, low, high, crossing.scale_error)
    return compare(found, crossing.nominal_nm2, crossing.element_edges_m, baseline)


def describe_crossing(crossing: CrossingView, found: Comparison | None) -> list[str]:
    """Return sentences on one crossing; only resolved ones can agree."""
    if found is None:
        return []
    if crossing.resolution is None:
        return sentences(found)
    return [
        *describe_clear_elements(found),
        f"{crossing.resolution.capitalize()}.",
    ]


def view_of_crossing(crossing: CrossingResult, bridge: ElementGeometry) -> CrossingView:
    """Return the view of a result; the bridge gives the lengths and nominal rigidities."""
    parameters = crossing.parameters
    rigidity = interval = None
    unresolved = frozenset[int]()
    if parameters is not None:
        elements = [parameters[f"EI_{number}"] for number in range(1, bridge.elements + 1)]
        rigidity = np.array([element.mean for element in elements])
        interval = np.array([(element.q025, element.q975) for element in elements])
        if crossing.derived is not None and crossing.derived.ei_level is not None:
            unresolved = unresolved_elements(elements)
    road = crossing.road
    return CrossingView(
        crossing_id=crossing.crossing_id,
        vehicle=crossing.vehicle,
        bridge=crossing.bridge,
        forward=crossing.direction == "start_to_end",
        entry_time_s=crossing.entry_time,
        exit_time_s=crossing.exit_time,
        speed_m_per_s=crossing.speed_m_per_s,
        method=crossing.method,
        verdict=crossing.verdict,
        reasons=tuple(reason.value for reason in crossing.reasons),
        reason_texts=crossing.reason_texts,
        chi2_per_dof=crossing.chi2_per_dof,
        element_edges_m=np.concatenate(([0.0], np.cumsum(bridge.lengths_m))),
        nominal_nm2=np.array(bridge.nominal_flexural_rigidity_nm2),
        rigidity_nm2=rigidity,
        interval_nm2=interval,
        road=None
        if road is None or not road.x_m
        else RoadView(np.array(road.x_m), np.array(road.front_m), np.array(road.rear_m)),
        parameters=tuple(
            ParameterRow(name, value.unit, value.mean, value.q025, value.q975, value.prior)
            for name, value in (parameters or {}).items()
        ),
        interior_supports_m=bridge.interior_supports_m,
        scale_error=crossing.scale_error or 0.0,
        resolution=unresolved_note(crossing),
        unresolved=unresolved,
        first_axle=first_compared_axle(crossing),
    )


def elements_of_result(crossing: CrossingResult) -> ResultElements | None:
    """Return the elements of a result's bridge, from its priors; None if it has none.

    Without their lengths the elements count as equal parts of the span that its road covers.
    """
    estimates = crossing.parameters or {}
    found = [value for name, value in estimates.items() if name.startswith("EI_")]
    nominal = tuple(value.prior.location for value in found if value.prior is not None)
    if not nominal or len(nominal) != len(found) or min(nominal) <= 0.0:
        return None
    likelihood = crossing.fusion_likelihood
    lengths = () if likelihood is None else tuple(likelihood.element_lengths_m)
    if len(lengths) != len(nominal):
        road = crossing.road
        # The grid lies in the middle of the span.
        span_m = float(len(nominal)) if road is None or not road.x_m else road.x_m[0] + road.x_m[-1]
        lengths = (span_m / len(nominal),) * len(nominal)
    return ResultElements(lengths, nominal)
