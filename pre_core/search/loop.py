"""The one loop that runs every search method, and how it ends.

A method is a State, an Info, `init` and `step`: `step(state) -> (state, info)` is a pure function
of the state, which holds all that the next step needs, its random numbers included. How a search
ended is a value, never an exception.
"""

from collections.abc import Callable
from enum import Enum
from typing import Generic, NamedTuple, Protocol, TypeVar


class Ending(Enum):
    """Why a search stopped, with a sentence for people."""

    CONVERGED = "The search converged."
    STEPS_DONE = "All the steps that were asked for were taken."
    STEPS_EXHAUSTED = "The search did not converge within the steps allowed."
    NOT_FINITE = "The objective is not a finite number anywhere near the start."
    STUCK = "No step makes the objective smaller, yet its slope is not zero."


class StepInfo(Protocol):
    """What every method's Info says; `ending` is None while the search goes on."""

    @property
    def ending(self) -> Ending | None:
        """Why the search is over, None while it is not."""

    @property
    def objective(self) -> float:
        """The smallest objective so far."""


Report = Callable[[str, float], None]
"""Is told the stage of a computation in words, and how much of all is done, 0 to 1."""

StateT = TypeVar("StateT")
InfoT = TypeVar("InfoT", bound=StepInfo)


class Solution(NamedTuple, Generic[StateT, InfoT]):
    """What a search gives, whatever its method: where it is, what its steps did, why it stopped."""

    state: StateT
    infos: list[InfoT]
    ending: Ending


def run(
    init: Callable[[], StateT],
    step: Callable[[StateT], tuple[StateT, InfoT]],
    max_steps: int,
    *,
    at_the_end: Ending = Ending.STEPS_EXHAUSTED,
    progress: Callable[[int, InfoT], None] | None = None,
) -> Solution[StateT, InfoT]:
    """Step until a method says that it has ended, or `max_steps` are taken (`at_the_end`)."""
    state = init()
    infos: list[InfoT] = []
    for count in range(1, max_steps + 1):
        state, info = step(state)
        infos.append(info)
        if progress is not None:
            progress(count, info)
        if info.ending is not None:
            return Solution(state, infos, info.ending)
    return Solution(state, infos, at_the_end)
