"""`[ros2]` of a site file: the topics of a ROS 2 truck and the channels that they feed."""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, Strict, StrictBool, StringConstraints

from schemas.site_errors import error_at
from schemas.strict_model import StrictModel
from schemas.topics import IDENTIFIER

RosTopic = Annotated[
    str,
    StringConstraints(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$", max_length=255),
]
"""A fully qualified ROS name: absolute, without `~` and substitutions."""


class RosImu(StrictModel):
    """One accelerometer: a topic of sensor_msgs/Imu and its upward axis."""

    topic: RosTopic
    axis: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    """Vertical axis of the sensor: z if it points up, -z if it points down."""
    gravity_included: StrictBool = True
    """Whether an upward axis reads +g at rest, as REP 145 demands."""
    frame: Annotated[str, StringConstraints(min_length=1, max_length=255)] | None = None
    """Required `frame_id` of its messages; None: that of the first one."""


class RosImus(StrictModel):
    """The accelerometers of a truck by channel."""

    # [[vehicle.sensors]] may name channels in addition to the four.
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, RosImu]

    sprung_front: RosImu | None = None
    sprung_rear: RosImu | None = None
    unsprung_front: RosImu | None = None
    unsprung_rear: RosImu | None = None

    def by_channel(self) -> dict[str, RosImu]:
        """Return the accelerometers that are given, by channel."""
        named = {name: getattr(self, name) for name in type(self).model_fields}
        named |= self.__pydantic_extra__
        return {name: imu for name, imu in named.items() if imu is not None}


class Ros2(StrictModel):
    """A truck with ROS 2."""

    vehicle: Annotated[str, StringConstraints(pattern=f"^{IDENTIFIER}$")]
    """The `id` of its `[vehicle]`."""
    gnss: RosTopic
    """Topic of sensor_msgs/NavSatFix."""
    velocity: RosTopic | None = None
    """Topic of geometry_msgs/TwistStamped or TwistWithCovarianceStamped; without one, speeds are
    slopes of positions."""
    imu: RosImus
    domain: Annotated[int, Strict(), Field(ge=0, le=232)] = 0
    """ROS_DOMAIN_ID."""
    largest_delay_s: Annotated[float, Strict(), Field(gt=0, le=60)] = 1.0
    """Largest delay between the stamp of a message and its transmission."""

    def topics(self) -> list[str]:
        """Return all topics, those of accelerometers first."""
        others = [self.gnss] if self.velocity is None else [self.gnss, self.velocity]
        return [imu.topic for imu in self.imu.by_channel().values()] + others


def check_ros2(tables: tuple[Ros2, ...], vehicles: Mapping[str, tuple[str, ...]]) -> None:
    """Raise if a truck or channel is unknown, or a truck or topic occurs twice.

    `vehicles` are the channel names of each vehicle.
    """
    seen: set[str] = set()
    for index, table in enumerate(tables):
        where = f"ros2.{index}"
        if table.vehicle not in vehicles:
            known = ", ".join(sorted(vehicles)[:10])
            raise error_at(f"{where}.vehicle", f'is "{table.vehicle}", it must be one of {known}')
        if table.vehicle in seen:
            raise error_at(
                f"{where}.vehicle", f'is "{table.vehicle}" again, a truck has one [ros2]'
            )
        seen.add(table.vehicle)
        topics = table.topics()
        if not table.imu.by_channel():
            raise error_at(
                f"{where}.imu", "names no channel, at least one accelerometer is expected"
            )
        channels = vehicles[table.vehicle]
        for name in table.imu.by_channel():
            if name not in channels:
                raise error_at(
                    f"{where}.imu.{name}",
                    f"is not a known field, it must be a channel of {table.vehicle}: "
                    f"{', '.join(channels)}",
                )
        for topic in topics:
            if topics.count(topic) > 1:
                raise error_at(where, f'has the topic "{topic}" twice, each is one thing only')
