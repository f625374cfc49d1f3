"""The command `driveby view`: a file, or the live bus, in the Rerun viewer."""

from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.viewer.settings import ViewSettings


def _view(asked: ViewSettings) -> int:
    if asked.target == "live":
        from services.viewer.live import live_command

        return live_command(asked, lambda line: print(line, flush=True))
    from services.viewer.view import view_command

    return view_command(target=asked.target, web=asked.web, console=a_console())


COMMAND: Final = Subcommand(
    ViewSettings,
    "driveby view run.mcap --web",
    _view,
)
