"""Cautions on a comparison with a baseline: shared, simulated, doubtful or later crossings."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Set

from schemas.results import BridgeResult
from schemas.topics import is_simulated
from services.common.language import ENGLISH, Language
from services.common.naming import entry_in_name

RealmsOfBridges = Mapping[str, Collection[str]]
"""Realms of crossings, by bridge."""


def shared_crossings(used: Set[str], before: Set[str], language: Language = ENGLISH) -> str | None:
    """Return a caution if crossings of a measurement are in its baseline, too; None without any."""
    common = used & before
    if not common:
        return None
    if common == used == before:
        return language.text("caution.same.all")
    return language.choice("caution.same", len(common))


def doubts_of_baseline(
    used: Set[str], before: Set[str], verdict: str | None, language: Language = ENGLISH
) -> Iterator[str]:
    """Yield why a comparison with a baseline misleads: its `verdict`, or crossings that are later.

    `used` and `before` are the crossings of the measurement and of the baseline.
    """
    if verdict not in (None, "good"):
        yield language.text("caution.baseline_suspect")
    entries = [[e for e in map(entry_in_name, of) if e is not None] for of in (before, used)]
    if all(entries) and max(entries[0]) > max(entries[1]):
        then, now = (f"{max(of):%Y-%m-%d}" for of in entries)
        yield language.text("caution.baseline_later", then=then, now=now)


def origin_caution(
    now: Iterable[str], then: Iterable[str], language: Language = ENGLISH
) -> str | None:
    """Return a caution if only one of a measurement and its baseline was simulated; else None.

    `now` and `then` are the realms of their crossings.
    """
    which = simulated_alone(now, then)
    return None if which is None else language.text(f"caution.simulated_{which}")


def simulated_alone(now: Iterable[str], then: Iterable[str]) -> str | None:
    """Return which of both was simulated, `baseline` or `crossings`, if the other was not."""
    kinds = [{is_simulated(realm) for realm in realms} for realms in (now, then)]
    if not all(kinds) or kinds[0] == kinds[1]:
        return None
    return "baseline" if True in kinds[1] else "crossings"


def baseline_cautions(
    states: Mapping[str, BridgeResult],
    baselines: Mapping[str, BridgeResult],
    now: RealmsOfBridges,
    then: RealmsOfBridges,
) -> Iterator[str]:
    """Yield a line for each baseline with shared crossings, and each of another kind.

    The kinds are simulated and real. `now` and `then` are the realms of the crossings and of those
    of the baselines.
    """
    for name, state in states.items():
        if name not in baselines:
            continue
        used, before = (frozenset(one.crossings_used) for one in (state, baselines[name]))
        for caution in (
            origin_caution(now.get(name, ()), then.get(name, ())),
            shared_crossings(used, before),
        ):
            if caution is not None:
                yield f"{name}: {caution}"
