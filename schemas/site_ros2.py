"""`[ros2]` of a site file: which topics of a ROS 2 truck are which of its channels."""

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, StrictBool, StringConstraints

from schemas.site_errors import at
from schemas.topics import IDENTIFIER

RosTopic = Annotated[
    str,
    StringConstraints(pattern=r"^(/[A-Za-z_][A-Za-z0-9_]*)+$", max_length=255),
]
"""A fully qualified name of ROS: absolute, without `~` and substitutions."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RosImu(_Table):
    """One accelerometer: a topic of sensor_msgs/Imu, and what of it is up."""

    topic: RosTopic
    axis: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    """Of the sensor's own axes the one that points up; with a minus sign, down."""
    gravity_included: StrictBool = True
    """Whether the axis reads +g at rest if it points up, as REP 145 wants it."""
    frame: Annotated[str, StringConstraints(min_length=1, max_length=255)] | None = None
    """The `frame_id` that its messages must have; None: that of the first one."""


class RosImus(_Table):
    """The accelerometers of a truck by the channel that each is."""

    # Channels that [[vehicle.sensors]] names stand beside the four.
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, RosImu]

    sprung_front: RosImu | None = None
    sprung_rear: RosImu | None = None
    unsprung_front: RosImu | None = None
    unsprung_rear: RosImu | None = None

    def by_channel(self) -> dict[str, RosImu]:
        """Those that there are."""
        named = {name: getattr(self, name) for name in type(self).model_fields}
        named |= self.__pydantic_extra__
        return {name: imu for name, imu in named.items() if imu is not None}


class Ros2(_Table):
    """A truck that speaks ROS 2."""

    vehicle: Annotated[str, StringConstraints(pattern=f"^{IDENTIFIER}$")]
    """The `id` of its `[vehicle]`."""
    gnss: RosTopic
    """Of sensor_msgs/NavSatFix."""
    velocity: RosTopic | None = None
    """Of geometry_msgs/TwistStamped or TwistWithCovarianceStamped; without one speeds are slopes
    of positions."""
    imu: RosImus
    domain: Annotated[int, Strict(), Field(ge=0, le=232)] = 0
    """ROS_DOMAIN_ID."""
    largest_delay_s: Annotated[float, Strict(), Field(gt=0, le=60)] = 1.0
    """Between the time that a message is stamped with and the time at which it was sent."""

    def topics(self) -> list[str]:
        """All of them, those of accelerometers first."""
        others = [self.gnss] if self.velocity is None else [self.gnss, self.velocity]
        return [imu.topic for imu in self.imu.by_channel().values()] + others


def check_ros2(tables: tuple[Ros2, ...], vehicles: Mapping[str, tuple[str, ...]]) -> None:
    """Raise if a truck or a channel is unknown, or a truck or a topic is there twice.

    `vehicles` are the names of the channels of each.
    """
    seen: set[str] = set()
    for index, table in enumerate(tables):
        where = f"ros2.{index}"
        if table.vehicle not in vehicles:
            known = ", ".join(sorted(vehicles)[:10])
            raise at(f"{where}.vehicle", f'is "{table.vehicle}", it must be one of {known}')
        if table.vehicle in seen:
            raise at(f"{where}.vehicle", f'is "{table.vehicle}" again, a truck has one [ros2]')
        seen.add(table.vehicle)
        topics = table.topics()
        if not table.imu.by_channel():
            raise at(f"{where}.imu", "names no channel, at least one accelerometer is expected")
        channels = vehicles[table.vehicle]
        for name in table.imu.by_channel():
            if name not in channels:
                raise at(
                    f"{where}.imu.{name}",
                    f"is not a known field, it must be a channel of {table.vehicle}: "
                    f"{', '.join(channels)}",
                )
        for topic in topics:
            if topics.count(topic) > 1:
                raise at(where, f'has the topic "{topic}" twice, each is one thing only')
