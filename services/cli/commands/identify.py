"""The command `driveby identify`."""

from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.cli.settings import IdentifyOptions


def _identify(asked: IdentifyOptions) -> int:
    from services.cli.identify import identify_command
    from services.cli.identify_archive import archive_command
    from services.cli.scheduler import check_scheduler, execution_of

    check_scheduler(asked)
    if asked.into is not None:
        return archive_command(asked, asked.into, execution_of(asked), a_console())
    executing = None if asked.scheduler is None else execution_of(asked)
    return identify_command(asked, executing, a_console())


COMMAND: Final = Subcommand(
    IdentifyOptions,
    "driveby identify run.mcap --json result.json --rrd result.rrd",
    _identify,
)
