"""Data of one crossing before its identification."""

from collections.abc import Callable
from typing import NamedTuple

from schemas.reasons import Reason
from schemas.site import Bridge, Receiver, Sensor, Vehicle
from services.common.arrays import Floats
from services.finding.stays import Stay
from services.finding.streams import Fixes, Samples

_MARGIN_S = 1.0
"""Time in s before the entry and after the exit for which samples are required."""
APPROACH_M, AFTER_M = 40.0, 25.0
"""Length of road in m before and after the bridge; 50 m determine the mismatch power to ±15 %."""
LONGEST_MARGIN_S = 4.0


class CrossingData(NamedTuple):
    """Data of one crossing; times in s on the truck's clock."""

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
    """Offset from the truck's clock to seconds since 1970 UTC."""
    against: tuple[Reason, ...] = ()
    """Known faults other than in its own signals: each forbids an estimate."""


class Detection(NamedTuple):
    """A truck's stay on a bridge, as known at some time; times in ns since 1970 UTC."""

    crossing_id: str
    """Name from bridge and time of detection, unless an earlier run named it otherwise."""
    realm: str
    vehicle: str
    bridge: str
    stay: Stay
    entry_ns: int
    exit_ns: int
    """Time of the last fix, where the truck has not left the bridge."""


class Complete(NamedTuple):
    """A crossing whose data are complete, or whose missing data will not arrive."""

    detection: Detection
    data: CrossingData


class Window(NamedTuple):
    """Stretch of time around a stay, on the truck's clock."""

    begin_s: float
    end_s: float


WindowOf = Callable[[Stay, Bridge, Vehicle], Window]
"""Type of a function that returns the stretch of a drive whose samples belong to a stay."""


def close_window(stay: Stay, bridge: Bridge, vehicle: Vehicle) -> Window:
    """Return the stay itself, with a margin."""
    return Window(stay.entry_s - _MARGIN_S, stay.exit_s + _MARGIN_S)


def wide_window(stay: Stay, bridge: Bridge, vehicle: Vehicle) -> Window:
    """Return the stay with the road before and after the bridge, at most `LONGEST_MARGIN_S`."""
    seconds_per_m = (stay.exit_s - stay.entry_s) / (bridge.span_m + vehicle.length_m)
    before, behind = (
        min(max(metres * seconds_per_m, _MARGIN_S), LONGEST_MARGIN_S)
        for metres in (APPROACH_M, AFTER_M)
    )
    return Window(stay.entry_s - before, stay.exit_s + behind)
