"""The command `driveby truck`."""

from typing import Final

from services.cli.parser import Announce, ServiceCommand
from services.truck.settings import TruckSettings


def _truck(asked: TruckSettings, announce: Announce) -> int:
    from services.truck.run import run

    return run(asked)


COMMAND: Final = ServiceCommand(
    TruckSettings,
    "driveby truck run.mcap --speed 4",
    _truck,
)
