"""The command `driveby logger`."""

from typing import Final

from services.cli.parser import Announce, ServiceCommand
from services.common.endpoints import DEFAULT_ENDPOINT
from services.logger.settings import LoggerSettings


def _logger(asked: LoggerSettings, announce: Announce) -> int:
    from services.logger.run import run

    return run(asked, announce(f"ready, listening at {asked.address}"))


COMMAND: Final = ServiceCommand(
    LoggerSettings,
    f"driveby logger --listen {DEFAULT_ENDPOINT} --folder recordings --site site.toml",
    _logger,
)
