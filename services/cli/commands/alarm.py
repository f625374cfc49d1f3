"""The command `driveby alarm`: detect, list, acknowledge and publish changes of bridges."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.alarm_line import alarm_line
from services.cli.parser import Subcommand
from services.common.endpoints import BusOptions
from services.common.errors import InputError
from services.common.naming import count_of
from services.common.options import (
    count_option,
    endpoint_option,
    flag,
    history_option,
    number,
    opt,
    positional,
    tls_option,
    whole,
)

if TYPE_CHECKING:
    from services.history.alarms import AlarmCheck, AlarmSettings
    from services.history.periods import Unit

_WHAT = ("check", "list", "ack", "serve")
_MAX_LINES = 20
"""Maximum number of listed bridges without monitoring."""
_EXIT_UNCHECKED: Final = 3
"""Exit code of --exit-code where files or bridges could not be read or compared."""
_EXIT_ALARM: Final = 4
"""Exit code of --exit-code while an alarm is active."""
_HOW = (
    "an alarm compares periods; identify and fuse combine all crossings, which hides a change\n"
    "draw it with driveby history BRIDGE --period {period} --figures DIR, inspect the bridge, then "
    "acknowledge the alarm with driveby alarm ack BRIDGE --by NAME --note TEXT"
)


@dataclass(frozen=True, kw_only=True)
class AlarmOptions(BusOptions):
    """Options of `driveby alarm`: the action, and how changes are detected."""

    what: str = positional(
        "detect changes, list alarms, acknowledge one (ack BRIDGE), or check and publish regularly",
        choices=_WHAT,
        metavar=f"{{{','.join(_WHAT)}}}",
    )
    bridge: str | None = positional("bridge whose alarm is acknowledged", nargs="?")
    history: Path = history_option()
    realm: str | None = opt("realm of the bridge, if it is in several")
    by: str | None = opt("with ack: name of the person who acknowledges", metavar="NAME")
    note: str = opt("with ack: finding or action, as a note", default="", metavar="TEXT")
    period: "Unit" = opt(
        "length of the periods whose crossings are fused (default: week)",
        default="week",
        choices=("day", "week", "month"),
    )
    false_alarms: float = opt(
        "tolerated false alarms per bridge and year (default: 0.01)",
        number("false alarms of a bridge in a year", low=1e-6, high=10.0),
        default=0.01,
        metavar="N",
    )
    training: int = opt(
        "number of training periods before monitoring starts (default: 8)",
        whole("a number of periods", 2, 1000),
        default=8,
        metavar="PERIODS",
    )
    at_least: float = opt(
        "smallest change of EI of interest in per cent; an alarm also requires that the change "
        "exceeds it with 97.5 %% probability (default: 5)",
        number("a change in per cent", low=0.0, high=50.0),
        default=5.0,
        metavar="PERCENT",
    )
    all: bool = flag("check all bridges, not only those with new crossings or periods")
    exit_code: bool = flag(
        f"with check and list: end with exit code {_EXIT_ALARM} while an alarm is active, else "
        f"with {_EXIT_UNCHECKED} if a file or a bridge could not be checked"
    )
    processes: int = count_option("number of processes", "a number", 1, 1, 256)
    every: float = opt(
        "with serve: minutes between two checks (default: 60)",
        number("minutes", low=0.01, high=1e5),
        default=60.0,
        metavar="MINUTES",
    )
    endpoint: str | None = endpoint_option()
    tls: Path | None = tls_option()


def _alarm(options: AlarmOptions) -> int:
    what, bridge = options.what, options.bridge
    if (bridge is None) == (what == "ack"):
        raise InputError("alarm: ack needs the name of a bridge; check, list and serve take none")
    if options.exit_code and what not in ("check", "list"):
        raise InputError("--exit-code: needs check or list")
    if bridge is not None:
        return _acknowledge(options, bridge)
    if what == "list":
        return _list(options)
    if what == "serve":
        return _serve(options)
    checked = _checked(options)
    checks, alarms = count_of(checked.bridges, "bridge"), count_of(len(checked.raised), "new alarm")
    print(f"{checks} checked, {alarms}")
    for alarm in checked.active:
        print(alarm_line(alarm))
    is_complete = _print_watches(options.history) and not checked.problems
    return _ended(options, has_alarm=bool(checked.active), is_complete=is_complete)


def _ended(options: AlarmOptions, *, has_alarm: bool, is_complete: bool) -> int:
    """Print what to do after an alarm; return the exit code."""
    if has_alarm:
        print(_HOW.format(period=options.period))
    if not options.exit_code:
        return 0
    if has_alarm:
        return _EXIT_ALARM
    return 0 if is_complete else _EXIT_UNCHECKED


def _settings(options: AlarmOptions) -> "AlarmSettings":
    from services.history.alarms import AlarmSettings

    return AlarmSettings(
        options.period, options.false_alarms, options.training, options.at_least / 100.0
    )


def _checked(options: AlarmOptions) -> "AlarmCheck":
    from services.execution.blas import one_blas_thread
    from services.history.alarms import check

    with one_blas_thread():
        checked = check(
            options.history,
            _settings(options),
            time.time(),
            processes=options.processes,
            everything=options.all,
        )
    for problem in checked.problems:
        print(problem)
    return checked


def _list(options: AlarmOptions) -> int:
    from services.history.alarm_files import alarms_of, bridges_with_alarms
    from services.history.history_store import bridges_of

    folder = options.history
    bridges_of(folder)  # it raises where there is no such folder
    number = active = unread = 0
    for realm, bridge in bridges_with_alarms(folder):
        alarms, problems = alarms_of(folder, realm, bridge)
        for line in (*problems, *map(alarm_line, alarms)):
            print(line)
        unread += len(problems)
        number += len(alarms)
        active += sum(alarm.acknowledged is None for alarm in alarms)
    if not number:
        print("no alarms")
    is_complete = _print_watches(folder) and not unread
    return _ended(options, has_alarm=bool(active), is_complete=is_complete)


def _print_watches(folder: Path) -> bool:
    """Print how many bridges are monitored, and why others are not; return whether all was read."""
    from services.history.alarms import monitoring_states

    found, problems = monitoring_states(folder, time.time())
    for problem in problems:
        print(problem)
    if not found:
        return not problems
    others = {name: one for name, one in found.items() if one.state not in ("watched", "alarm")}
    print(_how_many_monitored(len(found) - len(others), len(found)))
    for realm, bridge in list(others)[:_MAX_LINES]:
        print(f"{bridge} in realm {realm}: {others[(realm, bridge)].sentence}")
    if len(others) > _MAX_LINES:
        print(f"and {count_of(len(others) - _MAX_LINES, 'more bridge')} not monitored")
    return not problems


def _how_many_monitored(monitored: int, bridges: int) -> str:
    if bridges == 1:
        return f"the bridge is {'' if monitored else 'not '}monitored"
    return f"{monitored} of {bridges} bridges are monitored"


def _acknowledge(options: AlarmOptions, bridge: str) -> int:
    from services.history.alarm_files import acknowledge, alarms_of

    if not options.by:
        raise InputError("alarm ack: name the person who acknowledges with --by NAME")
    realm = _realm_of(options.history, bridge, options.realm)
    alarms, problems = alarms_of(options.history, realm, bridge)
    for problem in problems:
        print(problem)
    active = [alarm for alarm in alarms if alarm.acknowledged is None]
    if not active:
        raise InputError(f"{options.history}: {bridge} has no active alarm")
    for alarm in active:
        noted = acknowledge(options.history, alarm, options.by, options.note, time.time())
        print(alarm_line(noted))
    return 0


def _realm_of(folder: Path, bridge: str, realm: str | None) -> str:
    """Return the realm of a bridge's alarms; they outlive its crossings."""
    from services.history.alarm_files import bridges_with_alarms
    from services.history.history_store import realm_of

    realms = [r for r, b in bridges_with_alarms(folder) if b == bridge and realm in (None, r)]
    return realms[0] if len(realms) == 1 else realm_of(folder, bridge, realm)


def _serve(options: AlarmOptions) -> int:
    from services.cli.alarm_service import serve

    every_s = 60.0 * options.every
    return serve(options.history, lambda: _checked(options), options.address, options.tls, every_s)


COMMAND: Final = Subcommand(
    AlarmOptions,
    "driveby alarm check --history history",
    _alarm,
)
