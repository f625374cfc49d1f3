"""Parts of results that several methods share."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pre_core import parameters
from pre_core.constants import NORMAL_975
from pre_core.physics.bridge import Beam
from pre_core.physics.models import beam_from
from pre_core.physics.road import Profile, iri_m_per_km, iso_8608_class, roughness_coefficient_m3
from pre_core.physics.simulate import Motion
from schemas import results
from schemas.reasons import Reason, texts
from schemas.settings import IdentificationSettings
from schemas.site import Bridge, Vehicle
from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData
from services.identification.methods import LONGEST_SURE_OUTAGE_S

_ROAD_SPACING_M = 0.05
"""Spacing in m, finer than a tyre's patch of some 0.2 m."""
_LARGEST_ACCELERATION_M_PER_S2 = 0.3
"""Acceleration above which load transfer and the height of the centre of gravity matter."""


class CrossingTimes(NamedTuple):
    """Entry, exit and speed of a crossing; times in s on the truck's clock."""

    entry_s: float
    exit_s: float
    speed_m_per_s: float


class CrossingSamples(NamedTuple):
    """Samples of a crossing, with the truck's positions at them."""

    acceleration: Floats
    """Accelerations (m, n) of the vehicle's channels, in its order; (4, n) once reduced."""
    start_s: float
    motion: Motion


def element_shares(lengths_m: Floats, begin: float, end: float) -> Floats:
    """Return the shares (n,), of sum one, of elements between two fractions of the length."""
    edges = np.concatenate([[0.0], np.cumsum(lengths_m)])
    edges /= edges[-1]
    within = np.maximum(np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin), 0.0)
    return np.asarray(within / within.sum())


def header(
    data: CrossingData, settings: IdentificationSettings, passing: CrossingTimes
) -> dict[str, Any]:
    """Return the fields of a result that do not depend on the estimate."""
    return {
        "crossing_id": data.crossing_id,
        "realm": data.realm,
        "vehicle": data.vehicle.id,
        "bridge": data.bridge.id,
        "direction": "start_to_end" if data.stay.direction > 0 else "end_to_start",
        "entry_time": data.wall_offset_s + passing.entry_s,
        "exit_time": data.wall_offset_s + passing.exit_s,
        "speed_m_per_s": passing.speed_m_per_s,
        "method": settings.method,
        "element_edges_m": element_edges_m(data.bridge.lengths_m),
        "nominal_ei_nm2": tuple(data.bridge.nominal_flexural_rigidity_nm2),
    }


def element_edges_m(lengths_m: Sequence[float] | Floats) -> tuple[float, ...]:
    """Return the chainages in m of the elements' ends, one more than lengths (n,)."""
    return tuple(np.concatenate([[0.0], np.cumsum(lengths_m)]).tolist())


def rejected(
    data: CrossingData,
    settings: IdentificationSettings,
    passing: CrossingTimes,
    reasons: Iterable[Reason],
    about: Mapping[Reason, str] | None = None,
    **fields: Any,
) -> results.CrossingResult:
    """Return the result of an unusable crossing: reasons, and no estimate.

    `about` names the channels of a reason.
    """
    once = tuple(dict.fromkeys(reasons))
    return results.CrossingResult(
        **header(data, settings, passing),
        verdict="rejected",
        reasons=once,
        reason_texts=tuple(texts(once, about)),
        parameters=None,
        **fields,
    )


def nominal_parameters(vehicle: Vehicle, bridge: Bridge) -> Floats:
    """Return the values of the site file (p,) in the order of `pre_core.parameters`."""
    of = {parameters.TRUCK: vehicle, parameters.BRIDGE: bridge}
    tandem = vehicle.tandem
    of_axles: tuple[str, ...] = () if tandem is None else parameters.PAIRS
    if tandem is not None and not tandem.is_equalised:
        of_axles += parameters.SPRINGS
    return np.array(
        [
            getattr(tandem.axles[row.pair_index], row.key)
            if tandem is not None and row.key in of_axles
            else of[row.part].nominal(row.key)[row.pair_index]
            for row in parameters.table(bridge.elements)
        ]
    )


def caveats(data: CrossingData, motion: Motion) -> list[Reason]:
    """Return reasons against any method's answer: neglected effects of this truck and drive."""
    reasons: list[Reason] = []
    changing = np.abs(motion.acceleration_m_per_s2).max() > _LARGEST_ACCELERATION_M_PER_S2
    if changing and data.vehicle.cg_height_m is None:
        reasons.append(Reason.ACCELERATING_CG_UNKNOWN)
    stay = data.stay
    if longest_outage_s(data.fixes.time_s, stay.entry_s, stay.exit_s) > LONGEST_SURE_OUTAGE_S:
        reasons.append(Reason.POSITION_OUTAGE)
    return reasons


def longest_outage_s(times_s: Floats, entry_s: float, exit_s: float) -> float:
    """Return the longest time without a fix around the crossing; times (n,) in s."""
    inside = times_s[(times_s > entry_s) & (times_s < exit_s)]
    before = times_s[times_s <= entry_s][-1:]
    after = times_s[times_s >= exit_s][:1]
    around = np.concatenate([before, inside, after])
    return float(np.diff(around).max()) if around.size > 1 else np.inf


def beam_of(data: CrossingData, theta: Floats) -> Beam:
    """Return the bridge that a vector of parameters (p,) describes."""
    bridge = data.bridge
    return beam_from(theta, np.array(bridge.lengths_m), bridge.interior_support_nodes)


def summary_of(unit: str, draws: Floats, prior: results.Prior | None) -> results.Parameter:
    """Return a quantity's statistics over its draws (n,)."""
    low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975])
    return results.Parameter(
        unit=unit,
        mean=float(draws.mean()),
        std=float(draws.std()),
        q025=float(low),
        q50=float(middle),
        q975=float(high),
        prior=prior,
    )


def gaussian(unit: str, mean: float, std: float) -> results.Parameter:
    """Return a quantity with a normal uncertainty."""
    return results.Parameter(
        unit=unit,
        mean=mean,
        std=std,
        q025=mean - NORMAL_975 * std,
        q50=mean,
        q975=mean + NORMAL_975 * std,
    )


def detrended(x_m: Floats, height_m: Floats, degree: int = 1) -> Floats:
    """Return heights (n,) less their straight line, or less a polynomial of a higher degree.

    Level and slope of a road are unknown; a parabola (degree 2) removes its bend, too.
    """
    trend = np.polynomial.Polynomial.fit(x_m, height_m, degree)
    return np.asarray(height_m - trend(x_m))


def road_result(
    data: CrossingData, x_m: Floats, front_m: Floats, rear_m: Floats
) -> results.RoadResult:
    """Return profiles on an even grid of chainage, each without its own straight line."""
    order = np.argsort(x_m)
    x = np.arange(0.0, data.bridge.span_m + 0.5 * _ROAD_SPACING_M, _ROAD_SPACING_M)
    x = x[(x >= x_m.min()) & (x <= x_m.max())]
    front, rear, both = (
        detrended(x, np.interp(x, x_m[order], profile[order]))
        for profile in (front_m, rear_m, 0.5 * (front_m + rear_m))
    )
    profile = Profile(x, both)
    return results.RoadResult(
        x_m=tuple(x.tolist()),
        front_m=tuple(front.tolist()),
        rear_m=tuple(rear.tolist()),
        mean_m=tuple(both.tolist()),
        std_m=None,
        iri_m_per_km=float(iri_m_per_km(profile)[0]),
        iso_class=iso_8608_class(roughness_coefficient_m3(profile)),
    )
