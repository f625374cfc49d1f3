"""What was not right with messages of ROS 2: counted, and told a line for each kind."""

from collections import Counter


class Complaints:
    """Counts by topic and kind; the kinds are few whatever comes."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()
        self._told: Counter[tuple[str, str]] = Counter()
        self._examples: dict[tuple[str, str], str] = {}

    def add(self, topic: str, kind: str, number: int = 1, example: str = "") -> None:
        """Count; the first `example` of a kind stands for all."""
        if number:
            self._counts[topic, kind] += number
            if example:
                self._examples.setdefault((topic, kind), example)

    def count(self, topic: str, kind: str) -> int:
        """How many there were so far."""
        return self._counts[topic, kind]

    def news(self) -> list[str]:
        """A line for each kind of which there have been more since it was asked last."""
        lines = []
        for name, number in sorted(self._counts.items()):
            if number > self._told[name]:
                topic, kind = name
                example = self._examples.get(name, "")
                lines.append(f"{topic}: {number} {kind}{example and f' ({example})'}")
        self._told = self._counts.copy()
        return lines
