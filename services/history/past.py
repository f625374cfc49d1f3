"""A bridge's past: its periods, fused when somebody looks or ahead of it, and its alarms."""

from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from schemas.alarms import Alarm
from services.history.alarm_files import alarms_of
from services.history.archive import partition, read_partition
from services.history.periods import FusedPeriod, Unit, begin_of, fused_periods


class Driven(NamedTuple):
    """Where a crossing is in a history."""

    realm: str
    bridge: str
    entry_s: float


class Past(NamedTuple):
    """What a history holds of a bridge in one realm."""

    bridge: str
    realm: str
    unit: Unit
    periods: tuple[FusedPeriod, ...]
    alarms: tuple[Alarm, ...]


def past_of(folder: Path, realm: str, bridge: str, unit: Unit, say: Callable[[str], None]) -> Past:
    """Read a bridge of a history and fuse its periods; `say` is told what cannot be read."""
    read = read_partition(partition(folder, realm, bridge), ("likelihood",))
    alarms, problems = alarms_of(folder, realm, bridge)
    for problem in (*read.problems, *problems):
        say(problem)
    periods = fused_periods(folder, realm, bridge, read.crossings, unit, say)
    return Past(bridge, realm, unit, tuple(periods), tuple(alarms))


def fuse_ahead(
    folder: Path, added: Iterable[Driven], unit: Unit, say: Callable[[str], None]
) -> int:
    """Fuse the periods to which crossings were added, so that who looks need not wait; how many."""
    touched: defaultdict[tuple[str, str], set[float]] = defaultdict(set)
    for crossing in added:
        where = (crossing.realm, crossing.bridge)
        touched[where].add(begin_of(crossing.entry_s, unit))
    for (realm, bridge), begins in sorted(touched.items()):
        read = read_partition(partition(folder, realm, bridge), ("likelihood",))
        some = [one for one in read.crossings if begin_of(one.entry_s, unit) in begins]
        fused_periods(folder, realm, bridge, some, unit, say)
    return sum(map(len, touched.values()))
