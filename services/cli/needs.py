"""Extras that the commands need beyond the program's own dependencies.

The table is checked before a command starts, and docs/commands.md shows it. Needs that depend on
the kind of a source (an address, a recording of ROS 2, a cluster's scheduler) are checked where it
is read.
"""

import argparse
from collections.abc import Mapping
from typing import Final, NamedTuple

from services.common.extras import check_extras


class Needs(NamedTuple):
    """Extras that a command needs."""

    always: tuple[str, ...] = ()
    by_option: Mapping[str, tuple[str, ...]] = {}
    """Extras that an option needs in addition; for one value only as in `format=parquet`."""


_NOTHING: Final = Needs()
_IDENTIFY: Final = ("identify",)
_VIEW: Final = ("view",)
_HISTORY: Final = ("history",)
NEEDS: Final[Mapping[str, Needs]] = {
    "survey": Needs(_IDENTIFY, {"figure": _VIEW}),
    "check": Needs(_IDENTIFY),
    "simulate": Needs(_IDENTIFY),
    "import": _NOTHING,
    "identify": Needs(_IDENTIFY, {"rrd": _VIEW, "figures": _VIEW, "into": _HISTORY}),
    "fuse": Needs(_IDENTIFY),
    "history": Needs(
        ("identify", "history"), {"figures": _VIEW, "rrd": _VIEW, "view": _VIEW, "web": _VIEW}
    ),
    "alarm": Needs(("identify", "history")),
    "info": _NOTHING,
    "catalog": Needs(_HISTORY),
    "export": Needs((), {"format=parquet": _HISTORY}),
    "report": Needs(_VIEW, {"history": ("identify", "history")}),
    "validate": Needs(_IDENTIFY, {"figures": _VIEW}),
    "recover": _NOTHING,
    "view": Needs(("identify", "view")),
    "demo": Needs(("identify", "view")),
    "logger": _NOTHING,
    "worker": Needs(_IDENTIFY),
    "truck": _NOTHING,
    "gateway": Needs(("ros2",)),
    "replay": _NOTHING,
    "watch": _NOTHING,
    "health": _NOTHING,
    "cluster": Needs(("identify", "cluster")),
    "certs": _NOTHING,
}
"""Needs by command, in the order of `driveby --help`."""


def check_needs(options: argparse.Namespace) -> None:
    """Raise InputError with the command of installation, where an extra is missing."""
    name = options.parser.prog.split()[-1]
    needs = NEEDS[name]
    extras = list(needs.always)
    for option, more in needs.by_option.items():
        if _is_given(options, option):
            extras += more
    check_extras(f"driveby {name}", dict.fromkeys(extras))


def _is_given(options: argparse.Namespace, option: str) -> bool:
    name, has_value, value = option.partition("=")
    given = getattr(options, name)
    return bool(given == value) if has_value else given not in (None, False)
