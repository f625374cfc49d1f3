"""The command `driveby gateway`."""

from typing import Final

from services.cli.parser import Announce, ServiceCommand
from services.truck.settings import GatewaySettings


def _gateway(asked: GatewaySettings, announce: Announce) -> int:
    from services.truck.ros2 import run

    return run(asked, announce(f"ready, listening to ROS 2 at {asked.ros}"))


COMMAND: Final = ServiceCommand(
    GatewaySettings,
    "driveby gateway ros2 --ros tcp/127.0.0.1:7447 --endpoint tcp/office:7447 --site site.toml",
    _gateway,
)
