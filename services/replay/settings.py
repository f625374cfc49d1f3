"""Options of `driveby replay`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from services.common.endpoints import BusOptions
from services.common.options import (
    endpoint_option,
    flag,
    names,
    number,
    opt,
    positional,
    site_option,
    speed_option,
    tls_option,
)

_PATTERNS = "patterns with * and ?, separated by commas, of STREAM or OWNER/ID/STREAM"


def _selection(text: str, metavar: str) -> Any:
    return opt(text, names, group="selection", default=(), action="extend", metavar=metavar)


@dataclass(frozen=True, kw_only=True)
class ReplaySettings(BusOptions):
    """Options of `driveby replay`: a drive, its published part, and the pace."""

    recordings: tuple[Path, ...] = positional(
        "recordings, or folders of them: one drive, replayed in time order",
        Path,
        nargs="+",
        metavar="REC.mcap|DIR",
    )
    endpoint: str | None = endpoint_option()
    tls: Path | None = tls_option()
    name: str | None = opt("NAME of the realm replay-NAME (default: name of the first recording)")
    site: Path | None = site_option(
        "site file of the bridges, for jumps to crossings (default: that of the recording)"
    )
    speed: float = speed_option(1.0, zero="0 for as fast as possible", group="time")
    start: str | None = opt(
        "start in seconds into the drive, or as a time in UTC (2026-09-21T22:33:20)",
        group="time",
        metavar="S|TIME",
    )
    end: str | None = opt(
        "end, given as for --start", group="time", alternatives="end", metavar="S|TIME"
    )
    duration: float | None = opt(
        "length in s of the part of the drive to replay",
        number("seconds", low=1e-3, high=1e9),
        group="time",
        alternatives="end",
        metavar="S",
    )
    skip_gaps: bool = flag("skip gaps of more than 2 s", group="time")
    loop: bool = flag(
        "repeat until stopped (loggers and workers use the first pass only)", group="time"
    )
    paused: bool = flag("begin paused; needs a terminal", group="time")
    topics: tuple[str, ...] = _selection(
        f"topics to publish: {_PATTERNS} (accel,gnss or vehicle/*/accel)", "PATTERN"
    )
    exclude: tuple[str, ...] = _selection("topics to leave out, given as for --topics", "PATTERN")
    vehicle: tuple[str, ...] = _selection(
        "publish the messages of these trucks only, and no results", "ID"
    )
    rename: tuple[str, ...] = opt(
        "publish a truck under another name (the messages themselves stay as they are)",
        group="selection",
        default=(),
        action="append",
        metavar="OLD=NEW",
    )

    @property
    def realm_name(self) -> str:
        """Name behind `replay-`; InputError if it is not an identifier."""
        from services.common.naming import checked_identifier, identifier_from

        if self.name is None:
            return identifier_from(self.recordings[0].stem)
        return checked_identifier(self.name, "--name")
