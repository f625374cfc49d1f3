"""Findings of a check, with advice."""

import re
from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple


class CheckStatus(Enum):
    """Status of a checked item."""

    OK = "ok"
    WRONG = "wrong"
    OPEN = "open"
    """Status of an item that the input does not determine."""


class CheckFinding(NamedTuple):
    """A line of `driveby check`."""

    name: str
    """Name in snake_case, for programs."""
    state: CheckStatus
    text: str
    """Measured value, against the declared or required one."""
    advice: str = ""
    """Advice; empty where the item is in order."""


_OF_ONE = re.compile(r"([^\s,:]+): (.+)")
"""Text of a finding on one channel, truck or bridge."""


def without_repetition(findings: Iterable[CheckFinding]) -> list[CheckFinding]:
    """Return findings with one sentence for all channels to which it applies, in their order.

    Equal texts list their channels; texts with the same advice are joined before it.
    """
    channels: dict[tuple[str, CheckStatus, str, str], list[str]] = {}
    for one in findings:
        match = _OF_ONE.fullmatch(one.text)
        of, words = match.groups() if match else ("", one.text)
        channels.setdefault((one.name, one.state, one.advice, words), []).append(of)
    texts: dict[tuple[str, CheckStatus, str, str], list[str]] = {}
    for (name, state, advice, words), names in channels.items():
        listed = ", ".join(filter(None, dict.fromkeys(names)))
        text = f"{listed}: {words}" if listed else words
        texts.setdefault((name, state, advice, "" if advice else text), []).append(text)
    return [
        CheckFinding(name, state, "; ".join(some), advice)
        for (name, state, advice, _), some in texts.items()
    ]


def check_finding(name: str, text: str, advice: str, *, is_wrong: bool) -> CheckFinding:
    """Return a finding that is wrong, with its advice, or in order."""
    return (
        CheckFinding(name, CheckStatus.WRONG, text, advice)
        if is_wrong
        else CheckFinding(name, CheckStatus.OK, text)
    )
