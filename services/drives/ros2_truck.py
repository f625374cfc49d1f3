"""What a ROS 2 truck says, as one of ours would have said it: the same from a bus and from a file.

Times are those of `header.stamp`: when something was measured. When it was sent is used for one
thing: the two must be within `largest_delay_s` of each other, or the stamp is not believed.
"""

from typing import Final, NamedTuple

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from schemas.signals import NS_PER_S, Channel, GnssFix
from schemas.site import Site
from schemas.site_ros2 import Ros2, RosImu
from services.common.errors import InputError
from services.drives.ros2_complaints import Complaints
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
from services.drives.ros2_positions import FixWithSpeed, Positions
from services.drives.ros2_samples import EvenSamples, Piece
from services.identification.placed import rates_hz

_LEAST_SPEED_NOISE_M_PER_S: Final = 0.5
"""Of speeds that are slopes of positions: their errors are those of the positions once more, and
the same from fix to fix."""
_FASTEST_M_PER_S: Final = 200.0
_BEFORE_FIRST_NS: Final = 100 * NS_PER_S
"""The truck's own clock shows so much at its first message: others may be stamped before it."""
_HANDOVER_S: Final = 1.0
"""After so long without a message of a topic's sensor another one may speak there."""


class Accel(NamedTuple):
    """A batch of one channel; both times are of its first sample."""

    device_time_ns: int
    wall_time_ns: int
    channels: dict[str, Channel]


class _Source(NamedTuple):
    """Who spoke on a topic, and the stamp of what it said last."""

    publisher: bytes
    frame: str
    stamp_ns: int


class Ros2Truck:
    """Takes messages of a truck's topics in the order in which each topic's came."""

    def __init__(self, site: Site, site_name: str, vehicle: str) -> None:
        """InputError: the site has no `[ros2]` of that truck, or one that cannot be right."""
        self.table = ros2_of(site, site_name, vehicle)
        self.complaints = Complaints()
        self._imus = {imu.topic: imu for imu in self.table.imu.by_channel().values()}
        self._channels = {imu.topic: name for name, imu in self.table.imu.by_channel().items()}
        declared_hz = rates_hz(site.sensor, site.vehicle(vehicle))
        self._samples = {
            topic: EvenSamples(topic, declared_hz[name], site_name, self.complaints)
            for topic, name in self._channels.items()
        }
        self._positions = Positions(self.table.gnss, self.table.velocity, self.complaints)
        self._sources: dict[str, _Source] = {}
        self._zero_ns: int | None = None
        self._latest_device_ns = 0

    def types(self, topic: str) -> tuple[RosType, ...]:
        """The types that the messages of a topic may have."""
        if topic in self._imus:
            return (IMU,)
        return (FIX,) if topic == self.table.gnss else VELOCITIES

    def take(
        self, topic: str, of: RosType, payload: bytes, sent_ns: int, publisher: bytes = b""
    ) -> list[Accel | GnssFix]:
        """Take a message; return what can be published now. Identities are for others to set.

        `publisher` is who sent it, where that is known. What is wrong with a message is counted in
        `complaints`. InputError: the rate of a channel is not the one that the site file declares.
        """
        try:
            message = decode(of, payload)
        except ValueError as error:
            self.complaints.add(topic, "messages left out", example=f"the first {error}")
            return []
        if abs(message.stamp_ns - sent_ns) > self.table.largest_delay_s * NS_PER_S:
            apart = f"the first by {(sent_ns - message.stamp_ns) / NS_PER_S:.3f} s"
            self.complaints.add(topic, "stamps too far from when they were sent", example=apart)
            return []
        if not self._is_of_its_sensor(topic, message, publisher):
            return []
        if self._zero_ns is None:
            self._zero_ns = message.stamp_ns - _BEFORE_FIRST_NS
        match message:
            case Imu():
                return self._accelerations(topic, message)
            case Fix():
                return self._fix(message)
            case Velocity():
                return self._fixes(self._positions.add_velocity(message))

    def finish(self) -> list[Accel | GnssFix]:
        """What is left when no more messages come; InputError as `take`."""
        found: list[Accel | GnssFix] = []
        for topic, samples in self._samples.items():
            found += self._batches(topic, samples.finish())
        return found + self._fixes(self._positions.finish())

    def _is_of_its_sensor(
        self, topic: str, message: Imu | Fix | Velocity, publisher: bytes
    ) -> bool:
        """Whether a message is of the sensor that has the topic; what others say is counted.

        Samples of two are no signal. So a topic is the first one's, by publisher and frame, until
        it has been silent for a while: a node that was started anew is another publisher.
        """
        frame = message.frame if isinstance(message, Imu) else ""
        imu = self._imus.get(topic)
        if imu is not None and imu.frame is not None and frame != imu.frame:
            other = f"the first {frame[:60]!r}, not {imu.frame!r}"
            self.complaints.add(topic, "messages of another frame, left out", example=other)
            return False
        now, before = _Source(publisher, frame, message.stamp_ns), self._sources.get(topic)
        if before is not None and (publisher, frame) != (before.publisher, before.frame):
            if abs(now.stamp_ns - before.stamp_ns) <= _HANDOVER_S * NS_PER_S:
                other = f"the first of frame {frame[:60]!r}" if frame != before.frame else ""
                self.complaints.add(topic, "messages of a second sensor, left out", example=other)
                return False
            self.complaints.add(topic, "times that another sensor went on")
        self._sources[topic] = now
        return True

    def _accelerations(self, topic: str, message: Imu) -> list[Accel | GnssFix]:
        if message.acceleration_m_per_s2 is None:
            self.complaints.add(topic, "messages that say they have no acceleration, left out")
            return []
        up = _up(self._imus[topic], message.acceleration_m_per_s2)
        return self._batches(topic, self._samples[topic].add(message.stamp_ns, up))

    def _batches(self, topic: str, pieces: list[Piece]) -> list[Accel | GnssFix]:
        name = self._channels[topic]
        return [
            Accel(
                self._device_ns(piece.wall_time_ns),
                piece.wall_time_ns,
                {name: Channel(piece.rate_hz, piece.samples)},
            )
            for piece in pieces
        ]

    def _fix(self, fix: Fix) -> list[Accel | GnssFix]:
        if not fix.is_fix:
            self.complaints.add(self.table.gnss, "messages without a fix, left out")
            return []
        # A receiver that sees three satellites gives no altitude (NaN), and a poor place.
        for what, value, low, high in (
            ("an altitude", fix.altitude_m, -1000.0, 20_000.0),
            ("a latitude", fix.latitude_deg, -90.0, 90.0),
            ("a longitude", fix.longitude_deg, -180.0, 180.0),
        ):
            if not low <= value <= high:  # of a NaN it is false, too
                self.complaints.add(self.table.gnss, f"fixes without {what}, left out")
                return []
        return self._fixes(self._positions.add_fix(fix))

    def _fixes(self, fixes: list[FixWithSpeed]) -> list[Accel | GnssFix]:
        found: list[Accel | GnssFix] = []
        for fix, speed in fixes:
            if speed > _FASTEST_M_PER_S:
                self.complaints.add(self.table.gnss, "fixes with an impossible speed, left out")
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
        """ROS stamps with one clock; the truck's own is that one from the first message on.

        Where that was set back to before the beginning, the truck's own goes on from where it was.
        """
        zero_ns = wall_time_ns if self._zero_ns is None else self._zero_ns
        if wall_time_ns < zero_ns:
            zero_ns = self._zero_ns = wall_time_ns - self._latest_device_ns - NS_PER_S
        self._latest_device_ns = max(self._latest_device_ns, wall_time_ns - zero_ns)
        return wall_time_ns - zero_ns


def ros2_of(site: Site, site_name: str, vehicle: str) -> Ros2:
    """The `[ros2]` of a truck; InputError if it has none, or its speeds would be overrated."""
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
            f"{_LEAST_SPEED_NOISE_M_PER_S:g} where [ros2] names no velocity: speeds are slopes "
            "of positions then"
        )
    return table


def _up(imu: RosImu, measured: dict[str, float]) -> float:
    """The acceleration upward without gravity, m/s²."""
    value = measured[imu.axis[-1]]
    up = -value if imu.axis.startswith("-") else value
    return up - STANDARD_GRAVITY_M_PER_S2 if imu.gravity_included else up
