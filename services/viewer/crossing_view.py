"""What a picture of one crossing shows: bare arrays, whatever file or message they came from."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.results import Crossing, Prior, resolution
from services.identification.comparison import (
    Comparison,
    Estimate,
    compare,
    of_clear_elements,
    sentences,
    unresolved_elements,
)

FloatArray = NDArray[np.float64]

VEHICLE_COLOURS = {"front": "#0072B2", "rear": "#D55E00"}  # Okabe and Ito: told apart by all eyes
TRUTH_COLOUR = "#000000"
VERDICT_COLOURS = {"good": "#009E73", "suspect": "#B57A00", "rejected": "#C0392B"}


class OnBridge(Protocol):
    """Where a truck was on a bridge, and when: of a crossing, identified or not."""

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


class Elements(Protocol):
    """What of a bridge stands along its span; `schemas.site.Bridge` has it."""

    @property
    def elements(self) -> int: ...  # noqa: D102
    @property
    def lengths_m(self) -> tuple[float, ...]: ...  # noqa: D102
    @property
    def nominal_flexural_rigidity_nm2(self) -> tuple[float, ...]: ...  # noqa: D102
    @property
    def interior_supports_m(self) -> tuple[float, ...]: ...  # noqa: D102


class ToldElements(NamedTuple):
    """The elements of a bridge as a result tells them, where there is no site file."""

    lengths_m: tuple[float, ...]
    nominal_flexural_rigidity_nm2: tuple[float, ...]
    interior_supports_m: tuple[float, ...] = ()

    @property
    def elements(self) -> int:
        """How many there are."""
        return len(self.lengths_m)


class PassingView(NamedTuple):
    """A crossing that was seen in the positions and not identified; fields as in `CrossingView`."""

    vehicle: str
    bridge: str
    forward: bool
    entry_time_s: float
    exit_time_s: float
    speed_m_per_s: float
    span_m: float


class RoadView(NamedTuple):
    """Road profiles over chainage, all of one length; metres."""

    x_m: FloatArray
    front_m: FloatArray
    rear_m: FloatArray


class ParameterRow(NamedTuple):
    """One line of the table of parameters."""

    name: str
    unit: str
    mean: float
    low: float
    high: float
    prior: Prior | None = None


class ResidualCells(NamedTuple):
    """What a fit left over, in multiples of what the declared noise explains: 1 is expected."""

    mean_square: FloatArray
    """(3, 3, b): roads, front and rear body; before, on and behind the bridge; bands. NaN where
    there are no rows."""
    excess_std: FloatArray
    """(3, 3, b): how many standard deviations of chance that lies above 1."""
    edges_hz: tuple[float, ...]
    """b + 1, the last infinite."""


class CrossingView(NamedTuple):
    """One crossing as it is drawn.

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
    element_edges_m: FloatArray
    nominal_nm2: FloatArray
    rigidity_nm2: FloatArray | None
    interval_nm2: FloatArray | None  # (n, 2): 2.5 % and 97.5 % points
    road: RoadView | None
    parameters: tuple[ParameterRow, ...]
    interior_supports_m: tuple[float, ...] = ()
    scale_error: float = 0.0
    """Relative standard deviation that all elements have in common (mass, gain)."""
    resolution: str | None = None
    """In words what the crossing could not tell; None where it resolves every element."""
    residuals: ResidualCells | None = None
    """None where the samples are not at hand."""
    unresolved: frozenset[int] = frozenset()
    """Numbers of the elements of which too little is known to tell a loss of half of them."""

    @property
    def span_m(self) -> float:
        """Length of the bridge between its bearings."""
        return float(self.element_edges_m[-1])

    @property
    def resolved_ratio(self) -> FloatArray | None:
        """EI over nominal (n,), NaN where an element is not resolved; None if rejected."""
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
        """Whether the method knows the noise, without which an interval says nothing."""
        return "no_noise_model" not in self.reasons


def summary_line(view: CrossingView) -> str:
    """Vehicle, bridge, speed, method and goodness of fit in one line."""
    parts = [
        f"{view.vehicle} over {view.bridge}",
        f"{view.speed_m_per_s:.1f} m/s",
        f"method {view.method.replace('_', ' ')}",
    ]
    if view.chi2_per_dof is not None:
        parts.append(f"χ² per degree of freedom {view.chi2_per_dof:.2f}")
    return " · ".join(parts)


def comparison_of(crossing: CrossingView, baseline: Estimate | None = None) -> Comparison | None:
    """The elements of one crossing against the baseline or each other; None if it has none."""
    if crossing.rigidity_nm2 is None or crossing.interval_nm2 is None:
        return None
    if not crossing.interval_has_meaning:
        return None
    low, high = crossing.interval_nm2.T
    found = Estimate(crossing.rigidity_nm2, low, high, crossing.scale_error)
    return compare(found, crossing.nominal_nm2, crossing.element_edges_m, baseline)


def told_of_crossing(crossing: CrossingView, found: Comparison | None) -> list[str]:
    """What one crossing found, in words: only of what is resolved is said that it agrees."""
    if found is None:
        return []
    if crossing.resolution is None:
        return sentences(found)
    return [*of_clear_elements(found), f"Not all is resolved: {crossing.resolution}."]


def view_of_crossing(crossing: Crossing, bridge: Elements) -> CrossingView:
    """Gather what is drawn of a result; the bridge gives the lengths and nominal rigidities."""
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
        resolution=resolution(crossing),
        unresolved=unresolved,
    )


def elements_of_result(crossing: Crossing) -> ToldElements | None:
    """The elements of the bridge of a result, by its priors; None where it does not tell them.

    Where it does not tell their lengths they are taken as equal, of the span that its road covers.
    """
    estimates = crossing.parameters or {}
    found = [value for name, value in estimates.items() if name.startswith("EI_")]
    nominal = tuple(value.prior.location for value in found if value.prior is not None)
    if not nominal or len(nominal) != len(found) or min(nominal) <= 0.0:
        return None
    told = crossing.fusion_likelihood
    lengths = () if told is None else tuple(told.element_lengths_m)
    if len(lengths) != len(nominal):
        road = crossing.road
        # Its grid lies in the middle of the span.
        span_m = float(len(nominal)) if road is None or not road.x_m else road.x_m[0] + road.x_m[-1]
        lengths = (span_m / len(nominal),) * len(nominal)
    return ToldElements(lengths, nominal)
