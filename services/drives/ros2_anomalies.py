"""Counts of invalid ROS 2 messages, with a line for each kind."""

from collections import Counter
from typing import Final, NamedTuple

from services.common.naming import count_of

UNREADABLE: Final = "messages left out"
TOO_LARGE: Final = "messages too large for a sensor, left out"
UNKNOWN_TYPE: Final = "messages of another type, left out"
FAR_STAMPS: Final = "stamps too far from the time of sending"
OTHER_FRAME: Final = "messages of another frame, left out"
SECOND_SENSOR: Final = "messages of a second sensor, left out"
WRONG_RATE: Final = "messages at a wrong rate, left out"
UNPUBLISHED: Final = "messages that cannot be published, left out"
DROPPED: Final = "messages dropped from a full queue"
_REFUSED: Final = (
    *(UNREADABLE, TOO_LARGE, UNKNOWN_TYPE, FAR_STAMPS, OTHER_FRAME, SECOND_SENSOR, WRONG_RATE),
    UNPUBLISHED,
)
"""Kinds by which a publisher is refused: no sensor of the truck, or wrongly configured."""


class TopicRefusals(NamedTuple):
    """Messages of a topic that were refused or dropped since the last report."""

    topic: str
    refused: int
    dropped: int
    text: str
    """Lines with the numbers of this report."""


class AnomalyCounts:
    """Counts by topic and kind; the number of kinds is bounded."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()
        self._published: Counter[tuple[str, str]] = Counter()
        self._reported: Counter[tuple[str, str]] = Counter()
        self._examples: dict[tuple[str, str], str] = {}

    def add(self, topic: str, kind: str, number: int = 1, example: str = "") -> None:
        """Count messages; the first `example` of a kind represents all."""
        if number:
            self._counts[topic, kind] += number
            if example:
                self._examples.setdefault((topic, kind), example)

    def count(self, topic: str, kind: str) -> int:
        """Return the number of messages of a kind."""
        return self._counts[topic, kind]

    def news(self) -> list[str]:
        """Return a line for each kind with new messages since the last call."""
        lines = []
        for name, number in sorted(self._counts.items()):
            if number > self._published[name]:
                lines.append(self._line(*name, number))
        self._published = self._counts.copy()
        return lines

    def refusals(self) -> list[TopicRefusals]:
        """Return the refused or dropped messages since `reported`, one entry for each topic."""
        found = []
        for topic in sorted({topic for topic, _ in self._counts}):
            new = {
                kind: number
                for kind in (*_REFUSED, DROPPED)
                if (number := self._counts[topic, kind] - self._reported[topic, kind]) > 0
            }
            if new:
                dropped = new.get(DROPPED, 0)
                text = "; ".join(self._line(topic, kind, number) for kind, number in new.items())
                found.append(TopicRefusals(topic, sum(new.values()) - dropped, dropped, text))
        return found

    def reported(self, topic: str) -> None:
        """Mark all refusals of a topic up to now as reported."""
        self._reported |= Counter({name: n for name, n in self._counts.items() if name[0] == topic})

    def _line(self, topic: str, kind: str, number: int) -> str:
        example = self._examples.get((topic, kind), "")
        things, _, rest = kind.partition(" ")
        one = things.removesuffix("es") if things == "fixes" else things.removesuffix("s")
        counted = f"{count_of(number, one, things)} {rest}".rstrip()
        return f"{topic}: {counted}{example and f' ({example})'}"
