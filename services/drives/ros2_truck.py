"""Conversion of a ROS 2 truck's messages to ours, equally from a bus and from a file.

Times are those of `header.stamp`, the time of measurement. The time of sending serves one purpose:
the two must be within `largest_delay_s` of each other, otherwise the message is refused.
"""

from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple, NoReturn

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from schemas.signals import NS_PER_S, AccelChannel, GnssFix
from schemas.site import Site
from schemas.site_ros2 import Ros2, RosImu
from services.common.errors import InputError
from services.drives.ros2_anomalies import (
    FAR_STAMPS,
    OTHER_FRAME,
    SECOND_SENSOR,
    UNREADABLE,
    WRONG_RATE,
    AnomalyCounts,
)
from services.drives.ros2_messages import (
    FIX,
    IMU,
    VELOCITIES,
    Fix,
    Imu,
    RosType,
    Velocity,
    decode,
)
from services.drives.ros2_positions import FixWithSpeed, SpeedEstimator
from services.drives.ros2_samples import RateError, Resampler, SampleBlock
from services.finding.placed import rates_hz

_LEAST_SPEED_NOISE_M_PER_S: Final = 0.5
"""Smallest noise of speeds that are slopes of positions.

Their errors are those of the positions again, and correlated from fix to fix.
"""
_FASTEST_M_PER_S: Final = 200.0
_BEFORE_FIRST_NS: Final = 100 * NS_PER_S
"""Reading of the truck's own clock at its first message: others may have earlier stamps."""
_HANDOVER_S: Final = 1.0
"""Silence in s of a topic's sensor after which another one may continue there."""
_REFUSED_S: Final = 10.0
"""Time in s by stamps for which a sensor with a wrong rate is excluded before a new measurement."""
_MAX_REFUSED: Final = 1000
"""Maximum number of remembered sensors with a wrong rate; the oldest is dropped first."""


class Accel(NamedTuple):
    """A batch of one channel; both times are of its first sample."""

    device_time_ns: int
    wall_time_ns: int
    channels: dict[str, AccelChannel]


class _TopicPublisher(NamedTuple):
    """Publisher of a topic, and the stamp of its last message."""

    publisher: bytes
    frame: str
    stamp_ns: int


class Ros2Truck:
    """Converter of a truck's messages, in the order of each topic."""

    def __init__(
        self,
        site: Site,
        site_name: str,
        vehicle: str,
        wrong_rate: Callable[[RateError], None] | None = None,
    ) -> None:
        """Prepare the conversion; InputError without a valid `[ros2]` of that truck in the site.

        `wrong_rate` is called where the rate of a sensor differs from the site file's. Without it
        `convert` and `finish` raise that RateError.
        """
        self._wrong_rate = _raise if wrong_rate is None else wrong_rate
        self.table = ros2_of(site, site_name, vehicle)
        self.anomalies = AnomalyCounts()
        self._imus = {imu.topic: imu for imu in self.table.imu.by_channel().values()}
        self._channels = {imu.topic: name for name, imu in self.table.imu.by_channel().items()}
        declared_hz = rates_hz(site.sensor, site.vehicle(vehicle))
        self._samples = {
            topic: Resampler(topic, declared_hz[name], site_name, self.anomalies)
            for topic, name in self._channels.items()
        }
        self._positions = SpeedEstimator(self.table.gnss, self.table.velocity, self.anomalies)
        self._sources: dict[str, _TopicPublisher] = {}
        self._refused: dict[str, dict[tuple[bytes, str], int]] = {}
        """Sensors with a wrong rate by topic, each with the stamp of its detection."""
        self._zero_ns: int | None = None
        self._latest_device_ns = 0

    def types(self, topic: str) -> tuple[RosType, ...]:
        """Return the types that the messages of a topic may have."""
        if topic in self._imus:
            return (IMU,)
        return (FIX,) if topic == self.table.gnss else VELOCITIES

    def convert(
        self, topic: str, ros_type: RosType, payload: bytes, sent_ns: int, publisher: bytes = b""
    ) -> list[Accel | GnssFix]:
        """Convert a message; return what can be published now, without identities.

        `publisher` is its sender, where that is known. Invalid messages are counted in
        `anomalies`.
        """
        try:
            message = decode(ros_type, payload)
        except ValueError as error:
            self.anomalies.add(topic, UNREADABLE, example=f"the first {error}")
            return []
        if abs(message.stamp_ns - sent_ns) > self.table.largest_delay_s * NS_PER_S:
            apart = f"the first by {(sent_ns - message.stamp_ns) / NS_PER_S:.3f} s"
            self.anomalies.add(topic, FAR_STAMPS, example=apart)
            return []
        frame = message.frame if isinstance(message, Imu) else ""
        source = _TopicPublisher(publisher, frame, message.stamp_ns)
        if not self._is_of_its_sensor(topic, source):
            return []
        left = self._handed_over(topic, source)
        if self._zero_ns is None:
            self._zero_ns = message.stamp_ns - _BEFORE_FIRST_NS
        match message:
            case Imu():
                return left + self._accelerations(topic, message)
            case Fix():
                return self._fix(message)
            case Velocity():
                return self._fixes(self._positions.add_velocity(message))

    def finish(self) -> list[Accel | GnssFix]:
        """Return the remaining messages at the end of the input; RateError as for `convert`."""
        found: list[Accel | GnssFix] = []
        for topic, samples in self._samples.items():
            found += self._batches(topic, self._at_right_rate(samples.finish))
        return found + self._fixes(self._positions.finish())

    def _is_of_its_sensor(self, topic: str, source: _TopicPublisher) -> bool:
        """Return whether a message is of the sensor that has the topic; count the others.

        Samples of two sensors are no signal. So a topic belongs to the first one, by publisher and
        frame, until it has been silent for a while, as a restarted node is another publisher, or
        until its rate is known and differs from the declared one.
        """
        publisher, frame, stamp_ns = source
        imu = self._imus.get(topic)
        if imu is not None and imu.frame is not None and frame != imu.frame:
            other = f"the first {frame[:60]!r}, not {imu.frame!r}"
            self.anomalies.add(topic, OTHER_FRAME, example=other)
            return False
        before = self._sources.get(topic)
        if (
            before is not None
            and source[:2] != before[:2]
            and abs(stamp_ns - before.stamp_ns) <= _HANDOVER_S * NS_PER_S
        ):
            other = f"the first of frame {frame[:60]!r}" if frame != before.frame else ""
            self.anomalies.add(topic, SECOND_SENSOR, example=other)
            return False
        refused_ns = self._refused.get(topic, {}).get((publisher, frame))
        if refused_ns is not None and abs(stamp_ns - refused_ns) <= _REFUSED_S * NS_PER_S:
            self.anomalies.add(topic, WRONG_RATE)
            return False
        return True

    def _handed_over(self, topic: str, source: _TopicPublisher) -> list[Accel | GnssFix]:
        """Record the sensor of a topic; return the remaining samples of its predecessor.

        The rate of each sensor is measured; otherwise samples of another one would be put on the
        grid of the truck's own.
        """
        left: list[Accel | GnssFix] = []
        before = self._sources.get(topic)
        if before is not None and source[:2] != before[:2]:
            self.anomalies.add(topic, "changes to another sensor")
            if topic in self._samples:
                left = self._batches(topic, self._at_right_rate(self._samples[topic].restart))
        self._sources[topic] = source
        return left

    def _at_right_rate(self, blocks_of: Callable[[], list[SampleBlock]]) -> list[SampleBlock]:
        """Return the blocks; none, and free the topic, if the sensor's rate is wrong."""
        try:
            return blocks_of()
        except RateError as error:
            source = self._sources.pop(error.topic, None)
            if source is not None:
                refused = self._refused.setdefault(error.topic, {})
                refused[source.publisher, source.frame] = source.stamp_ns
                if len(refused) > _MAX_REFUSED:
                    del refused[next(iter(refused))]
            reason = str(error).removeprefix(f"{error.topic}: ")
            self.anomalies.add(error.topic, WRONG_RATE, error.samples, example=reason)
            self._wrong_rate(error)
            return []

    def _accelerations(self, topic: str, message: Imu) -> list[Accel | GnssFix]:
        if message.acceleration_m_per_s2 is None:
            self.anomalies.add(topic, "messages declared to be without acceleration, left out")
            return []
        up = _up(self._imus[topic], message.acceleration_m_per_s2)
        add = partial(self._samples[topic].add, message.stamp_ns, up)
        return self._batches(topic, self._at_right_rate(add))

    def _batches(self, topic: str, blocks: list[SampleBlock]) -> list[Accel | GnssFix]:
        name = self._channels[topic]
        return [
            Accel(
                self._device_ns(block.wall_time_ns),
                block.wall_time_ns,
                {name: AccelChannel(block.rate_hz, block.samples)},
            )
            for block in blocks
        ]

    def _fix(self, fix: Fix) -> list[Accel | GnssFix]:
        if not fix.is_fix:
            self.anomalies.add(self.table.gnss, "messages without a fix, left out")
            return []
        # A receiver with three satellites gives no altitude (NaN), and a poor position.
        for what, value, low, high in (
            ("an altitude", fix.altitude_m, -1000.0, 20_000.0),
            ("a latitude", fix.latitude_deg, -90.0, 90.0),
            ("a longitude", fix.longitude_deg, -180.0, 180.0),
        ):
            if not low <= value <= high:  # it is true for NaN
                self.anomalies.add(self.table.gnss, f"fixes without {what}, left out")
                return []
        return self._fixes(self._positions.add_fix(fix))

    def _fixes(self, fixes: list[FixWithSpeed]) -> list[Accel | GnssFix]:
        found: list[Accel | GnssFix] = []
        for fix, speed in fixes:
            if speed > _FASTEST_M_PER_S:
                self.anomalies.add(self.table.gnss, "fixes with an impossible speed, left out")
                continue
            device_ns = self._device_ns(fix.stamp_ns)
            found.append(
                GnssFix(
                    *(0, 0, device_ns, fix.stamp_ns),
                    *(fix.latitude_deg, fix.longitude_deg, fix.altitude_m, speed),
                    horizontal_accuracy_m=fix.horizontal_accuracy_m,
                    vertical_accuracy_m=fix.vertical_accuracy_m,
                )
            )
        return found

    def _device_ns(self, wall_time_ns: int) -> int:
        """Return the time on the truck's own clock: ROS time from the first message on.

        Where ROS time was set back to before the beginning, the truck's own clock continues.
        """
        zero_ns = wall_time_ns if self._zero_ns is None else self._zero_ns
        if wall_time_ns < zero_ns:
            zero_ns = self._zero_ns = wall_time_ns - self._latest_device_ns - NS_PER_S
        self._latest_device_ns = max(self._latest_device_ns, wall_time_ns - zero_ns)
        return wall_time_ns - zero_ns


def ros2_of(site: Site, site_name: str, vehicle: str) -> Ros2:
    """Return the `[ros2]` of a truck; InputError without one, or if its speeds are too precise."""
    for table in site.ros2:
        if table.vehicle == vehicle:
            break
    else:
        raise InputError(
            f'{site_name}: has no [ros2] with vehicle = "{vehicle}", which names the topics'
        )
    noise = site.receiver.speed_noise_m_per_s
    if table.velocity is None and noise < _LEAST_SPEED_NOISE_M_PER_S:
        raise InputError(
            f"{site_name}: receiver.speed_noise_m_per_s is {noise:g}, it must be at least "
            f"{_LEAST_SPEED_NOISE_M_PER_S:g} where [ros2] names no velocity: speeds are "
            "then slopes of positions"
        )
    return table


def _raise(error: RateError) -> NoReturn:
    raise error


def _up(imu: RosImu, measured: dict[str, float]) -> float:
    """Return the acceleration upward without gravity, m/s²."""
    value = measured[imu.axis[-1]]
    up = -value if imu.axis.startswith("-") else value
    return up - STANDARD_GRAVITY_M_PER_S2 if imu.gravity_included else up
