"""An engine whose works are done at once: messages in, messages out."""

from collections.abc import Iterable, Iterator

from schemas.results import BridgeResult, ResultHeader
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.topics import Key
from services.execution.dispatch import CrossingExecutor, dispatch, drain
from services.execution.inline import InlineExecutor
from services.identification.engine import Engine
from services.identification.known import search_hash
from services.identification.outputs import Output
from tests.builders.ledger import known_crossings


def unhurried() -> InlineExecutor:
    """Identifies here, in no time: the seconds that it took are the only thing that varies."""
    return InlineExecutor(stopwatch=lambda: 0.0)


class WorkingEngine:
    def __init__(
        self,
        site: Site,
        settings: IdentificationSettings,
        header: ResultHeader,
        execution: CrossingExecutor | None = None,
    ) -> None:
        self.inner = Engine(site, settings, header)
        self._execution = execution or unhurried()
        self._header = header

    def resume(self, output: Iterable[tuple[Key, bytes]]) -> Iterator[Output]:
        known = known_crossings(output, search_hash(self._header))
        return dispatch(self.inner, self._execution, self.inner.resume(known))

    def expect(self, key: Key, payload: bytes, *, for_ever: bool = False) -> None:
        self.inner.expect(key, payload, for_ever=for_ever)

    def feed(self, key: Key, payload: bytes) -> Iterator[Output]:
        return dispatch(self.inner, self._execution, self.inner.feed(key, payload))

    def gone(self, realm: str, vehicle: str, *, for_good: bool = False) -> Iterator[Output]:
        output = self.inner.gone(realm, vehicle, for_good=for_good)
        return dispatch(self.inner, self._execution, output)

    def finish(self) -> Iterator[Output]:
        return dispatch(self.inner, self._execution, self.inner.finish())

    def has_undecided(self, realm: str, vehicle: str) -> bool:
        return self.inner.has_undecided(realm, vehicle)

    def bridges(self) -> dict[str, BridgeResult]:
        return self.inner.bridges()

    @property
    def unknown_vehicles(self) -> set[str]:
        return self.inner.unknown_vehicles


def feed_all(
    engine: Engine, execution: CrossingExecutor, messages: Iterable[tuple[Key, bytes]]
) -> Iterator[Output]:
    """Feed a whole recording, and finish."""
    for key, payload in messages:
        engine.expect(key, payload)
        yield from dispatch(engine, execution, engine.feed(key, payload))
    yield from dispatch(engine, execution, engine.finish())
    yield from drain(engine, execution)
