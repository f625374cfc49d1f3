"""Crossings that several results files hold, also under another realm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from schemas.results import CrossingResult, Results
from services.common.language import Language
from services.common.naming import first_of

_MAX_NAMED: Final = 3


class Repeat(NamedTuple):
    """A drive that was identified in two realms, such as an exported and imported one."""

    crossing_id: str
    realm: str
    """Realm of the result that counts."""
    other: str


def newest_of_each(
    bridge: str, files: Sequence[Results]
) -> tuple[dict[str, CrossingResult], list[Repeat]]:
    """Return the crossings of a bridge by identifier, and those of several realms.

    Of one realm the result of the last file counts; of several that of the realm with the most
    crossings of the bridge, so that a campaign is not divided, and of the last one if equal.
    """
    every = [one for results in files for one in results.crossings if one.bridge == bridge]
    sizes = Counter(realm for realm, _ in {(one.realm, one.crossing_id) for one in every})
    newest: dict[str, CrossingResult] = {}
    realms: dict[str, dict[str, None]] = {}
    for one in every:
        before = newest.get(one.crossing_id)
        realms.setdefault(one.crossing_id, {})[one.realm] = None
        if before is None or sizes[before.realm] <= sizes[one.realm]:
            newest[one.crossing_id] = one
    repeats = [
        Repeat(name, newest[name].realm, other)
        for name, known in realms.items()
        for other in known
        if other != newest[name].realm
    ]
    return newest, repeats


def repeated(repeats: Sequence[Repeat], language: Language) -> Iterator[str]:
    """Yield a sentence for each pair of realms that hold the same crossings."""
    for realm, other in dict.fromkeys((one.realm, one.other) for one in repeats):
        names = [one.crossing_id for one in repeats if (one.realm, one.other) == (realm, other)]
        listed = first_of(names, _MAX_NAMED)
        yield language.choice(
            "quality.repeated", len(names), realm=realm, other=other, crossings=listed
        )
