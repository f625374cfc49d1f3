"""The command `driveby replay`, and its summary."""

from typing import TYPE_CHECKING, Final

from services.cli.parser import Subcommand
from services.common.errors import InputError
from services.common.naming import count_of
from services.replay.settings import ReplaySettings

if TYPE_CHECKING:
    from services.replay.run import ReplayStatistics


def _replay(asked: ReplaySettings) -> int:
    from services.cli.terminal import has_terminal, terminal
    from services.replay.run import run

    if asked.paused and not has_terminal():
        raise InputError("--paused: cannot be resumed: neither input nor output is a terminal")
    return run(asked, display=terminal if has_terminal() else None, report=_print)


COMMAND: Final = Subcommand(
    ReplaySettings,
    "driveby replay run.mcap --speed 10",
    _replay,
)


def _print(found: "ReplayStatistics") -> None:
    print("\n".join(summary(found)))


def summary(found: "ReplayStatistics") -> list[str]:
    """Return a summary of the replay in lines; the pace covers played parts, no jumps."""
    streams = ", ".join(f"{stream} {n}" for stream, n in found.by_stream.items()) or "none"
    rounds = f", {found.rounds} rounds" if found.rounds > 1 else ""
    pace = ""
    if found.took_s > 0.0 and not found.jumped_over:
        factor = (found.drive_s - found.skipped_s) / found.took_s
        pace = (
            f", {factor:,.0f} times real speed"
            if factor >= 10
            else f", {factor:.2g} times real speed"
        )
    lines = [
        f"{count_of(found.messages, 'message')} published in realm {found.realm}: {streams}",
        f"{found.drive_s:.1f} s of the drive in {found.took_s:.2f} s{rounds}{pace}",
    ]
    if found.trucks:
        lines.append(f"trucks: {', '.join(found.trucks)}")
    if found.jumped_over:
        lines.append(f"{count_of(found.jumped_over, 'message')} left out by jumps")
    if found.skipped_s:
        lines.append(f"{found.skipped_s:.1f} s of silence skipped")
    on_disk = "a logger has them on disk" if found.is_confirmed else "no logger confirmed them"
    lines.append(on_disk)
    return lines
