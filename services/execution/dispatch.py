"""Between the engine, which says what is to be identified and fused, and where that is done.

The engine's messages come through in their order; a crossing is handed to an `Execution`, and what
the engine says of its result follows when it has come. So are crossings that are to be fused.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, Protocol

from schemas.certificates import Pair
from schemas.reasons import Reason
from schemas.results import BridgeResult, Crossing
from schemas.topics import Key
from services.identification.crossing_data import Passing, rejected
from services.identification.engine import Engine
from services.identification.outputs import Fuse, Output, Said, Wanted, Work

_LOOK_AGAIN_S = 0.1
"""A wait is cut into pieces, so that Python hears signals between them."""


class Finished(NamedTuple):
    """A crossing with its result."""

    work: Work
    result: Crossing


class Fused(NamedTuple):
    """Crossings of a bridge with its state; None: they could not be fused."""

    fuse: Fuse
    state: BridgeResult | None


class Begun(NamedTuple):
    """A crossing that is being identified."""

    crossing_id: str
    seconds: float
    """Since it was begun, this time."""


class Execution(Protocol):
    """Where crossings are identified and fused. To be used from one thread."""

    @property
    def is_busy(self) -> bool:
        """Whether there is something that `finished` or `fused` has not given back yet."""

    @property
    def is_full(self) -> bool:
        """Whether more works should wait until some have been given back."""

    @property
    def has_room(self) -> bool:
        """Whether it would not be full after one more work."""

    @property
    def is_idle(self) -> bool:
        """Whether a work that is started now is begun at once, or as soon as an aside is over."""

    @property
    def waiting(self) -> int:
        """How many works have been started and not begun."""

    @property
    def under_way(self) -> list[Begun]:
        """The crossings that are being identified, the one that was begun first first."""

    def start(self, work: Work) -> None:
        """Take a work; it is done now, later or elsewhere."""

    def finished(self, timeout_s: float = 0.0) -> list[Finished]:
        """What has been done since the last call, each work once, in any order.

        If there is nothing yet, what has been done as soon as something has, or `timeout_s` is
        over.
        """

    def fuse(self, fuse: Fuse) -> None:
        """Take crossings to be fused, in place of older ones of their bridge that still wait."""

    def fused(self) -> list[Fused]:
        """The states that have been made since the last call, those of a bridge in their order.

        `finished` looks after them: it returns, too, as soon as there is one.
        """


def dispatched(
    engine: Engine,
    execution: Execution,
    said: Iterable[Said],
    want: Callable[[Pair], None] = lambda pair: None,
) -> Iterator[Output]:
    """What the engine says, its works executed; what comes back meanwhile is told, too.

    `want` is told of the pairs whose certificates are wanted.
    """
    for one in said:
        if isinstance(one, Output):
            yield one
            continue
        if isinstance(one, Wanted):
            want(one.pair)
            continue
        if isinstance(one, Fuse):
            execution.fuse(one)
            yield from collected(engine, execution)
            continue
        execution.start(one)
        yield from collected(engine, execution)
        while execution.is_full:
            yield from collected(engine, execution, _LOOK_AGAIN_S)


def collected(engine: Engine, execution: Execution, timeout_s: float = 0.0) -> Iterator[Output]:
    """What the engine says of the results and states that have come."""
    for work, result in execution.finished(timeout_s):
        yield from dispatched(engine, execution, engine.done(work, result))
    for fuse, state in execution.fused():
        yield from engine.fused(fuse, state)


def awaited(engine: Engine, execution: Execution) -> Iterator[Output]:
    """What the engine says of everything that is still being identified or fused."""
    while execution.is_busy:
        yield from collected(engine, execution, _LOOK_AGAIN_S)


def feed_all(
    engine: Engine, execution: Execution, messages: Iterable[tuple[Key, bytes]]
) -> Iterator[Output]:
    """Feed a whole recording, and finish."""
    for key, payload in messages:
        engine.expect(key, payload)
        yield from dispatched(engine, execution, engine.feed(key, payload))
    yield from dispatched(engine, execution, engine.finish())
    yield from awaited(engine, execution)


def failed(work: Work) -> Crossing:
    """The result of a crossing whose identification failed in a way that nobody foresaw."""
    data = work.data
    stay, way_m = data.stay, data.bridge.span_m + data.vehicle.wheelbase_m
    speed_m_per_s = way_m / (stay.exit_s - stay.entry_s) if stay.exit_s > stay.entry_s else 0.0
    passing = Passing(stay.entry_s, stay.exit_s, speed_m_per_s)
    return rejected(data, work.settings, passing, [Reason.FAILED])
