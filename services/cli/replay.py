"""The command `driveby replay`: its options, and its summary."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.cli.parsing import (
    add_endpoint,
    add_site,
    add_speed,
    command,
    names,
    number,
)

if TYPE_CHECKING:
    from services.replay.run import ReplayStatistics
from services.common.endpoints import default_endpoint


def add_replay(commands: Any) -> None:
    """Add `driveby replay`: publish recorded messages again, unchanged, in a separate realm."""
    p = command(
        commands,
        "replay",
        _replay,
        "publish recorded messages again, unchanged, in a realm of their own",
        "driveby replay run.mcap --speed 10",
    )
    p.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="REC.mcap|DIR",
        help="recordings, or folders of them: one drive, in the order of time",
    )
    add_endpoint(p)
    p.add_argument("--name", help="realm replay-NAME (default: name of the first recording)")
    add_site(p, "site file of the bridges, for jumps to crossings (default: that of the recording)")
    when = p.add_argument_group("when")
    add_speed(when, 1.0, zero="0 for as fast as possible")
    when.add_argument(
        "--start",
        metavar="S|TIME",
        help="start in seconds into the drive, or as a time in UTC (2026-09-21T22:33:20)",
    )
    until = when.add_mutually_exclusive_group()
    until.add_argument("--end", metavar="S|TIME", help="end, given as for --start")
    until.add_argument(
        "--duration",
        type=number("seconds", low=1e-3, high=1e9),
        metavar="S",
        help="duration in seconds of the drive",
    )
    when.add_argument("--skip-gaps", action="store_true", help="skip gaps of more than 2 s")
    when.add_argument(
        "--loop",
        action="store_true",
        help="repeat without end (loggers and workers take the first pass only)",
    )
    when.add_argument("--paused", action="store_true", help="begin paused; needs a terminal")
    what = p.add_argument_group("what")
    patterns = "patterns with * and ?, commas between, of STREAM or OWNER/ID/STREAM"
    for option, text in (
        ("--topics", f"only these: {patterns} (accel,gnss or vehicle/*/accel)"),
        ("--exclude", "topics to leave out, given as for --topics"),
        ("--vehicle", "publish the messages of these trucks only, and no results"),
    ):
        metavar = "ID" if option == "--vehicle" else "PATTERN"
        what.add_argument(
            option, type=names, action="extend", default=[], metavar=metavar, help=text
        )
    what.add_argument(
        "--rename",
        action="append",
        default=[],
        metavar="OLD=NEW",
        help="publish a truck under another name (the messages themselves stay as they are)",
    )


def _replay(options: argparse.Namespace) -> int:
    from services.cli.terminal import has_terminal, terminal
    from services.common.errors import InputError
    from services.common.naming import checked_identifier, identifier_from
    from services.replay.choice import ReplaySelection, parsed_rename
    from services.replay.run import run

    if options.paused and not has_terminal():
        raise InputError("--paused: cannot be resumed: neither input nor output is a terminal")
    name = options.name
    return run(
        recordings=options.recordings,
        endpoint=options.endpoint or default_endpoint(options.tls),
        speed=options.speed,
        name=(
            identifier_from(options.recordings[0].stem)
            if name is None
            else checked_identifier(name, "--name")
        ),
        choice=ReplaySelection(
            options.start,
            options.end,
            options.duration,
            tuple(options.topics),
            tuple(options.exclude),
            tuple(options.vehicle),
            tuple(parsed_rename(text) for text in options.rename),
        ),
        skip_gaps=options.skip_gaps,
        loop=options.loop,
        start_paused=options.paused,
        site=options.site,
        display=terminal if has_terminal() else None,
        report=_print,
        tls=options.tls,
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
        f"{found.messages} messages published in realm {found.realm}: {streams}",
        f"{found.drive_s:.1f} s of the drive in {found.took_s:.2f} s{rounds}{pace}",
    ]
    if found.trucks:
        lines.append(f"trucks: {', '.join(found.trucks)}")
    if found.jumped_over:
        lines.append(f"{found.jumped_over} messages left out by jumps")
    if found.skipped_s:
        lines.append(f"{found.skipped_s:.1f} s of silence skipped")
    on_disk = "a logger has them on disk" if found.is_confirmed else "no logger confirmed them"
    lines.append(on_disk)
    return lines
