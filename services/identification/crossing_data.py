"""What is known of one crossing before it is identified, and what of a result it gives."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import unknowns
from pre_core.constants import NORMAL_975
from pre_core.physics.bridge import Beam
from pre_core.physics.models import beam_from
from pre_core.physics.road import Profile, iri_m_per_km, iso_8608_class, roughness_coefficient_m3
from pre_core.physics.simulate import Motion
from schemas import results
from schemas.reasons import Reason, texts
from schemas.settings import IdentificationSettings
from schemas.site import Bridge, Receiver, Sensor, Vehicle
from services.identification.stays import Stay
from services.identification.streams import Fixes, Samples

Floats = NDArray[np.float64]

_MARGIN_S = 1.0
"""Samples are needed at least this long before the entry and after the exit."""
APPROACH_M, BEHIND_M = 40.0, 25.0
"""Off the bridge the axles tell by how much their roads differ: to 15 % of its power on 50 m."""
LONGEST_MARGIN_S = 4.0
_ROAD_SPACING_M = 0.05
"""Finer than a tyre feels: its patch is some 0.2 m long."""
_LARGEST_ACCELERATION_M_PER_S2 = 0.3
"""From here on load transfer matters, which the height of the centre of gravity decides."""
LONGEST_SURE_OUTAGE_S = 1.5
"""A trajectory through fixes further apart is a guess, unless the axles' own signals confirm it."""


class CrossingData(NamedTuple):
    """One crossing. Times are seconds on the truck's clock."""

    crossing_id: str
    realm: str
    vehicle: Vehicle
    bridge: Bridge
    sensor: Sensor
    receiver: Receiver
    stay: Stay
    fixes: Fixes
    chainage_m: Floats  # (m,) of the antenna at the fixes
    samples: Samples | None  # around the crossing, with a margin
    wall_offset_s: float
    """What to add to a time on the truck's clock to get seconds since 1970 UTC."""
    against: tuple[Reason, ...] = ()
    """What is known against it beside its own signals: each forbids an estimate."""


class Passing(NamedTuple):
    """When and how fast the truck crossed."""

    entry_s: float
    exit_s: float
    speed_m_per_s: float


class Window(NamedTuple):
    """From when to when a crossing's data are looked at."""

    begin_s: float
    end_s: float


def part_of_elements(lengths_m: Floats, begin: float, end: float) -> Floats:
    """Shares (n,) of elements in the bridge between two parts of its length; they sum to one."""
    edges = np.concatenate([[0.0], np.cumsum(lengths_m)])
    edges /= edges[-1]
    within = np.maximum(np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin), 0.0)
    return np.asarray(within / within.sum())


def window(stay: Stay, bridge: Bridge, vehicle: Vehicle, method: str) -> Window:
    """Around a stay, on the same clock; the paper's methods look at the bridge alone."""
    if method != "pre":
        return Window(stay.entry_s - _MARGIN_S, stay.exit_s + _MARGIN_S)
    seconds_per_m = (stay.exit_s - stay.entry_s) / (bridge.span_m + vehicle.wheelbase_m)
    before, behind = (
        min(max(metres * seconds_per_m, _MARGIN_S), LONGEST_MARGIN_S)
        for metres in (APPROACH_M, BEHIND_M)
    )
    return Window(stay.entry_s - before, stay.exit_s + behind)


def header(
    data: CrossingData, settings: IdentificationSettings, passing: Passing
) -> dict[str, Any]:
    """The fields of a result that do not depend on what was found."""
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
    }


def rejected(
    data: CrossingData,
    settings: IdentificationSettings,
    passing: Passing,
    reasons: Iterable[Reason],
    about: Mapping[Reason, str] | None = None,
    **fields: Any,
) -> results.Crossing:
    """A crossing that cannot be used: reasons, and no number offered as an estimate.

    `about` names the channels that a reason is about.
    """
    once = tuple(dict.fromkeys(reasons))
    return results.Crossing(
        **header(data, settings, passing),
        verdict="rejected",
        reasons=once,
        reason_texts=tuple(texts(once, about)),
        parameters=None,
        **fields,
    )


def nominal_parameters(vehicle: Vehicle, bridge: Bridge) -> Floats:
    """The values of the site file in the order of `pre_core.unknowns`."""
    of = {unknowns.TRUCK: vehicle, unknowns.BRIDGE: bridge}
    return np.array(
        [of[row.part].nominal(row.key)[row.which] for row in unknowns.table(bridge.elements)]
    )


def caveats(data: CrossingData, motion: Motion) -> list[Reason]:
    """Reasons against any method's answer: what it neglects of this truck and this drive."""
    reasons: list[Reason] = []
    changing = np.abs(motion.acceleration_m_per_s2).max() > _LARGEST_ACCELERATION_M_PER_S2
    if changing and data.vehicle.cg_height_m is None:
        reasons.append(Reason.ACCELERATING_CG_UNKNOWN)
    stay = data.stay
    if longest_outage_s(data.fixes.time_s, stay.entry_s, stay.exit_s) > LONGEST_SURE_OUTAGE_S:
        reasons.append(Reason.POSITION_OUTAGE)
    return reasons


def longest_outage_s(times_s: Floats, entry_s: float, exit_s: float) -> float:
    """Longest time without a fix between the last one before the entry and the first after."""
    inside = times_s[(times_s > entry_s) & (times_s < exit_s)]
    before = times_s[times_s <= entry_s][-1:]
    after = times_s[times_s >= exit_s][:1]
    around = np.concatenate([before, inside, after])
    return float(np.diff(around).max()) if around.size > 1 else np.inf


def beam_of(data: CrossingData, theta: Floats) -> Beam:
    """The bridge that a vector of parameters (p,) describes."""
    bridge = data.bridge
    return beam_from(theta, np.array(bridge.lengths_m), bridge.interior_support_nodes)


def gaussian(unit: str, mean: float, std: float) -> results.Parameter:
    """A quantity whose uncertainty is taken for normal."""
    return results.Parameter(
        unit=unit,
        mean=mean,
        std=std,
        q025=mean - NORMAL_975 * std,
        q50=mean,
        q975=mean + NORMAL_975 * std,
    )


def detrended(x_m: Floats, height_m: Floats) -> Floats:
    """Heights less their straight line: integrated accelerations leave level and slope unknown."""
    line = np.polynomial.Polynomial.fit(x_m, height_m, 1)
    return np.asarray(height_m - line(x_m))


def road_result(data: CrossingData, x_m: Floats, front_m: Floats, rear_m: Floats) -> results.Road:
    """Profiles on an even grid of chainage, each without its own straight line."""
    order = np.argsort(x_m)
    x = np.arange(0.0, data.bridge.span_m + 0.5 * _ROAD_SPACING_M, _ROAD_SPACING_M)
    x = x[(x >= x_m.min()) & (x <= x_m.max())]
    front, rear, both = (
        detrended(x, np.interp(x, x_m[order], profile[order]))
        for profile in (front_m, rear_m, 0.5 * (front_m + rear_m))
    )
    profile = Profile(x, both)
    return results.Road(
        x_m=tuple(x.tolist()),
        front_m=tuple(front.tolist()),
        rear_m=tuple(rear.tolist()),
        mean_m=tuple(both.tolist()),
        std_m=None,
        iri_m_per_km=float(iri_m_per_km(profile)[0]),
        iso_class=iso_8608_class(roughness_coefficient_m3(profile)),
    )
