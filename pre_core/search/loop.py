"""The loop that runs every search method, and its outcomes.

A method is a State, an Info, `init` and `step`: `step(state) -> (state, info)` is a pure function
of the state, which holds everything for the next step, including its random numbers. The outcome of
a search is a value, never an exception.
"""

from collections.abc import Callable
from enum import Enum
from typing import Generic, NamedTuple, Protocol, TypeVar


class Termination(Enum):
    """Reason for the end of a search, with a sentence for users."""

    CONVERGED = "The search converged."
    STEPS_DONE = "All the steps that were asked for were taken."
    STEPS_EXHAUSTED = "The search did not converge within the steps allowed."
    NOT_FINITE = "The objective is not a finite number anywhere near the start."
    STUCK = "No step makes the objective smaller, yet its slope is not zero."


class StepInfo(Protocol):
    """The fields that every method's Info has; `ending` is None while the search continues."""

    @property
    def ending(self) -> Termination | None:
        """The reason for the end of the search, None while it continues."""

    @property
    def objective(self) -> float:
        """The smallest objective so far."""


Report = Callable[[str, float], None]
"""Callback with the stage of a computation in words and the completed fraction, 0 to 1."""

StateT = TypeVar("StateT")
InfoT = TypeVar("InfoT", bound=StepInfo)


class SearchResult(NamedTuple, Generic[StateT, InfoT]):
    """The final state of a search, the statistics of its steps, and the reason for its end."""

    state: StateT
    infos: list[InfoT]
    ending: Termination


def run_search(
    init: Callable[[], StateT],
    step: Callable[[StateT], tuple[StateT, InfoT]],
    max_steps: int,
    *,
    at_limit: Termination = Termination.STEPS_EXHAUSTED,
    progress: Callable[[int, InfoT], None] | None = None,
) -> SearchResult[StateT, InfoT]:
    """Run `step` until the method ends, or end with `at_limit` after `max_steps` steps."""
    state = init()
    infos: list[InfoT] = []
    for count in range(1, max_steps + 1):
        state, info = step(state)
        infos.append(info)
        if progress is not None:
            progress(count, info)
        if info.ending is not None:
            return SearchResult(state, infos, info.ending)
    return SearchResult(state, infos, at_limit)
