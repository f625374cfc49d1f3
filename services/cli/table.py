"""Table of the commands: summary, module, and the extras that each needs.

`driveby --help` reads it alone; the module of a command is imported when the command is parsed.
Extras are checked before a command starts, and docs/commands.md shows them. Needs that depend on
the kind of a source (an address, a recording of ROS 2, a cluster's scheduler) are checked where it
is read.
"""

import argparse
from collections.abc import Mapping
from typing import Final, NamedTuple

from services.common.extras import check_extras


class ListedCommand(NamedTuple):
    """A command: its line in the help, its module, and the extras that it needs."""

    summary: str
    always: tuple[str, ...] = ()
    by_option: Mapping[str, tuple[str, ...]] = {}
    """Extras that an option needs in addition; for one value only as in `format=parquet`."""
    module: str = ""
    """Module in `commands`; empty: the command's name."""


_IDENTIFY: Final = ("identify",)
_VIEW: Final = ("view",)
_HISTORY: Final = ("history",)
COMMANDS: Final[Mapping[str, ListedCommand]] = {
    "survey": ListedCommand(
        "plan a survey: expected accuracy, detection probability, best improvements",
        _IDENTIFY,
        {"figure": _VIEW},
    ),
    "check": ListedCommand(
        "check site file, sensors, receiver and bridge coordinates before a survey", _IDENTIFY
    ),
    "simulate": ListedCommand("write the recording of a simulated crossing", _IDENTIFY),
    "import": ListedCommand(
        "convert CSV files or ROS 2 recordings of a drive to a recording", module="import_drive"
    ),
    "identify": ListedCommand(
        "estimate the flexural rigidity of each element from recordings",
        _IDENTIFY,
        {"rrd": _VIEW, "figures": _VIEW, "into": _HISTORY},
    ),
    "fuse": ListedCommand(
        "fuse the results of many crossings into one estimate of each bridge", _IDENTIFY
    ),
    "history": ListedCommand(
        "store results over years and show EI of each element over time",
        ("identify", "history"),
        {"figures": _VIEW, "rrd": _VIEW, "view": _VIEW, "web": _VIEW},
    ),
    "alarm": ListedCommand(
        "detect changed bridges; list, acknowledge and publish alarms", ("identify", "history")
    ),
    "info": ListedCommand("summarise recordings: trucks, times, rates, gaps, crossings"),
    "catalog": ListedCommand(
        "build or repair the catalogue of a folder of recordings and find crossings in it", _HISTORY
    ),
    "export": ListedCommand(
        "write recordings and results as CSV or Parquet tables and GeoJSON",
        (),
        {"format=parquet": _HISTORY},
    ),
    "report": ListedCommand(
        "write results as a printable HTML file or PDF",
        _VIEW,
        {"history": ("identify", "history")},
    ),
    "validate": ListedCommand(
        "identify simulated crossings and compare results with the truth and the paper",
        _IDENTIFY,
        {"figures": _VIEW},
    ),
    "recover": ListedCommand("recover a damaged or truncated recording into a new file"),
    "view": ListedCommand(
        "open a recording, a result or the live bus in the Rerun viewer", ("identify", "view")
    ),
    "demo": ListedCommand(
        "simulate, publish, record, identify and draw one crossing", ("identify", "view")
    ),
    "logger": ListedCommand("record all messages of a realm and host the bus router"),
    "worker": ListedCommand("identify crossings as they happen and publish the results", _IDENTIFY),
    "truck": ListedCommand("publish a recording as if the truck were driving now"),
    "gateway": ListedCommand("publish the data of a ROS 2 truck on the bus", ("ros2",)),
    "replay": ListedCommand("publish recorded messages again, unchanged, in a realm of their own"),
    "watch": ListedCommand("show trucks, crossings and results in the terminal as they arrive"),
    "health": ListedCommand("query the health of a logger or worker over the bus"),
    "cluster": ListedCommand(
        "run a Dask scheduler and workers on this machine, for `identify --scheduler`",
        ("identify", "cluster"),
    ),
    "certs": ListedCommand("make certificates and access control for a bus between machines"),
}
"""Entries by command, in the order of `driveby --help`."""


def check_needs(options: argparse.Namespace) -> None:
    """Raise InputError with the command of installation, where an extra is missing."""
    name = name_of(options)
    entry = COMMANDS[name]
    extras = list(entry.always)
    for option, more in entry.by_option.items():
        if _is_given(options, option):
            extras += more
    check_extras(f"driveby {name}", dict.fromkeys(extras))


def name_of(options: argparse.Namespace) -> str:
    """Return the name of the parsed command."""
    return str(options.parser.prog.split()[-1])


def _is_given(options: argparse.Namespace, option: str) -> bool:
    name, has_value, value = option.partition("=")
    given = getattr(options, name)
    return bool(given == value) if has_value else given not in (None, False)
