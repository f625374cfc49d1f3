"""Findings of a check, with advice."""

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


def check_finding(name: str, text: str, advice: str, *, is_wrong: bool) -> CheckFinding:
    """Return a finding that is wrong, with its advice, or in order."""
    return (
        CheckFinding(name, CheckStatus.WRONG, text, advice)
        if is_wrong
        else CheckFinding(name, CheckStatus.OK, text)
    )
