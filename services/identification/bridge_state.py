"""What a bridge's crossings say of it together: today its latest one; they are not fused yet.

Only as much is kept as the state of a bridge says, so that the thousandth crossing costs what the
first did.
"""

from bisect import insort
from collections.abc import Iterable
from typing import NamedTuple

from schemas.results import BridgeResult, Crossing, ElementState, LeftOut

LISTED_AT_MOST = 100
"""So many crossings that are left out are named: the state stays below 10 kB, while a message on
the bus may have 1 MiB. The others are counted."""


class Usable(NamedTuple):
    """What a state needs to know of a crossing that gave parameters."""

    entry_time: float
    """Seconds since 1970 UTC, as `exit_time`."""
    exit_time: float
    crossing_id: str
    elements: dict[str, ElementState]


class Counted(NamedTuple):
    """The usable crossings of a bridge."""

    newest: tuple[Usable, ...] = ()
    """In order of their entries, `LISTED_AT_MOST` and one more at most."""
    number: int = 0
    """How many there are, with those that are no longer kept."""


def usable(result: Crossing) -> Usable | None:
    """What a state needs of a result; None if it gave no parameters."""
    if result.parameters is None:
        return None
    elements = {
        name: ElementState(mean=p.mean, std=p.std, q025=p.q025, q975=p.q975)
        for name, p in result.parameters.items()
        if name.startswith("EI_")
    }
    return Usable(result.entry_time, result.exit_time, result.crossing_id, elements)


def count_in(counted: Counted, crossings: Iterable[Usable]) -> Counted:
    """The same with more crossings; who entered last counts as the latest, not who came last."""
    newest, number = list(counted.newest), counted.number
    for crossing in crossings:
        insort(newest, crossing, key=lambda one: one.entry_time)
        del newest[: -LISTED_AT_MOST - 1]
        number += 1
    return Counted(tuple(newest), number)


def latest_state(counted: Counted) -> BridgeResult | None:
    """The bridge as its latest usable crossing sees it, the others left out; None without any."""
    if not counted.newest:
        return None
    *others, last = counted.newest
    return BridgeResult(
        between_crossing_std=None,
        crossings_used=(last.crossing_id,),
        crossings_left_out=tuple(
            LeftOut(crossing_id=crossing.crossing_id, reason="not_fused") for crossing in others
        ),
        crossings_left_out_count=counted.number - 1,
        **last.elements,  # type: ignore[arg-type]
    )
