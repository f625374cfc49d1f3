"""The command `driveby simulate`."""

from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.simulation.settings import SimulateOptions


def _simulate(asked: SimulateOptions) -> int:
    from services.simulation.command import simulate_command

    return simulate_command(asked, a_console())


COMMAND: Final = Subcommand(
    SimulateOptions,
    "driveby simulate --scenario 6 --noise 25 -o run.mcap",
    _simulate,
)
