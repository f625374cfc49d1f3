"""The command `driveby demo`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.common.options import flag, noise_option, output_folder_option, speed_option


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Options of `driveby demo`: how it runs, and the folder that it writes."""

    out: Path | None = output_folder_option(
        "new folder for the outputs (default: recordings/demo-TIME)"
    )
    speed: float = speed_option(4.0)
    noise: float = noise_option(
        "accelerometers' noise density in µg/√Hz; 0: exact sensors and method least-squares "
        "(default: 25)",
        25.0,
    )
    live: bool = flag("show the demo live in the viewer")
    web: bool = flag("show the demo live in the browser")


def _demo(asked: DemoOptions) -> int:
    from services.cli.demo import demo_command

    return demo_command(
        out=asked.out,
        speed=asked.speed,
        noise=asked.noise,
        console=a_console(),
        live="web" if asked.web else "window" if asked.live else None,
    )


COMMAND: Final = Subcommand(
    DemoOptions,
    "driveby demo --speed 4",
    _demo,
)
