"""One thing that was looked at, and what is to be done about it."""

from enum import Enum
from typing import NamedTuple


class State(Enum):
    """How it is with it."""

    OK = "ok"
    WRONG = "wrong"
    OPEN = "open"
    """What was given does not tell."""


class Finding(NamedTuple):
    """A line of `driveby check`."""

    name: str
    """In snake_case, for programs."""
    state: State
    text: str
    """What was measured, against what is declared or needed."""
    advice: str = ""
    """What to do; empty where it is in order."""


def judged(name: str, text: str, advice: str, *, is_wrong: bool) -> Finding:
    """Wrong, with its advice, or in order."""
    return Finding(name, State.WRONG, text, advice) if is_wrong else Finding(name, State.OK, text)
