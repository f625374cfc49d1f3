"""Parts of a crossing's result that count in the state of its bridge, without mathematics.

A logger uses them before it deletes a recording, so neither numba nor SciPy is imported.
"""

import logging
from bisect import insort
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from schemas.fusion import FusionLikelihood
from schemas.results import CrossingResult, ElementState, RoadResult, Verdict

_log = logging.getLogger(__name__)

ONE_REALM: Final = (
    "fuse one realm at a time (import --realm NAME puts the drives of a campaign into one realm; "
    "so also simulated drives, after export)"
)
LISTED_AT_MOST = 100
"""Maximum number of fused crossings, the newest, and of named excluded ones.

The state stays below 20 kB, while a message on the bus may have 1 MiB. The others are counted.
"""


class Source(NamedTuple):
    """Input of a fusion from a crossing."""

    crossing_id: str
    vehicle: str
    direction: int
    likelihood: FusionLikelihood
    road: RoadResult | None = None
    """Profile that aligns runs with each other."""


class FusableCrossing(NamedTuple):
    """Part of a crossing with an estimate that a state needs."""

    entry_time: float
    """Entry in s since 1970 UTC, as for `exit_time`."""
    exit_time: float
    crossing_id: str
    verdict: Verdict
    elements: dict[str, ElementState]
    source: Source | None


class RecentCrossings(NamedTuple):
    """Usable crossings of a bridge."""

    newest: tuple[FusableCrossing, ...] = ()
    """Newest crossings in order of their entries, at most `LISTED_AT_MOST` and one more."""
    number: int = 0
    """Number of crossings, including those no longer kept."""


def usable(result: CrossingResult) -> FusableCrossing | None:
    """Return the part of a result that a state needs; None without an estimate."""
    if result.parameters is None:
        return None
    elements = {
        name: ElementState(mean=p.mean, std=p.std, q025=p.q025, q975=p.q975)
        for name, p in result.parameters.items()
        if name.startswith("EI_")
    }
    return FusableCrossing(
        result.entry_time,
        result.exit_time,
        result.crossing_id,
        result.verdict,
        elements,
        source_of(result),
    )


def add_crossings(
    counted: RecentCrossings, crossings: Iterable[FusableCrossing]
) -> RecentCrossings:
    """Return the crossings with more added; the latest is the one that entered last."""
    newest, number = list(counted.newest), counted.number
    for crossing in crossings:
        insort(newest, crossing, key=lambda one: (one.entry_time, one.crossing_id))
        del newest[: -LISTED_AT_MOST - 1]
        number += 1
    return RecentCrossings(tuple(newest), number)


def latest_realms(counted: Mapping[tuple[str, str], RecentCrossings]) -> dict[str, str]:
    """Return the realm of the last crossing of each bridge, by the bridge's name.

    `counted` are the crossings by realm and bridge. Log a warning for each bridge with crossings in
    several realms, which are not fused with each other.
    """
    realms: dict[str, list[str]] = {}
    for (realm, bridge), crossings in counted.items():
        if crossings.newest:
            realms.setdefault(bridge, []).append(realm)
    latest = {}
    for bridge, some in realms.items():
        last = max(some, key=lambda realm: counted[realm, bridge].newest[-1].entry_time)
        latest[bridge] = last
        if len(some) > 1:
            listed = ", ".join(sorted(some))
            text = "%s: has crossings of realms %s; only those of %s are fused; %s"
            _log.warning(text, bridge, listed, last, ONE_REALM)
    return latest


def source_of(result: CrossingResult) -> Source | None:
    """Return the input of a fusion from a result; None without a likelihood."""
    if result.fusion_likelihood is None:
        return None
    direction = 1 if result.direction == "start_to_end" else -1
    likelihood = result.fusion_likelihood
    return Source(result.crossing_id, result.vehicle, direction, likelihood, result.road)
