"""Reception from the bus in a thread of its own: an identification must not delay a publisher."""

import contextlib
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import zenoh

from schemas.signals import NS_PER_S, TRUCK_DECODERS, Identity
from schemas.topics import Key, is_from_recording, is_simulated, parse_key, selector
from services.bus.liveness import LivenessProbe, StaleConnectionError
from services.bus.realm_listener import OtherRealms
from services.bus.subscription import RawSample, SeenSequences, Subscription
from services.common.log_lines import about
from services.common.naming import offset_in_words
from services.worker.arrivals import LivenessToken, TruckMessage

_log = logging.getLogger(__name__)
POLL_S: Final = 0.1
"""Longest delay in s after which a stop, a token or a result is noticed without a message."""
_LONGEST_QUEUE: Final = 200_000
"""Messages, two hours of one truck or a minute of a hundred; beyond them publishers wait."""
_BEHIND_S: Final = 86_400.0
"""Age of a new sample in s that no delay explains."""
_AHEAD_S: Final = 60.0
"""Time in s by which a sample lies in the future when a clock is wrong."""
_MAX_CLOCKS: Final = 1000
"""Number of trucks with a line on their clock."""
ArrivalsQueue = queue.Queue[TruckMessage | LivenessToken]


class MessageReceiver:
    """The thread that receives, and the queue of what it has received and checked."""

    def __init__(
        self,
        bus: zenoh.Session,
        realm: str,
        at_end: Callable[[], None],
        refused: Counter[str] | None = None,
    ) -> None:
        """Prepare the thread, which calls `at_end` when it ends for whatever reason.

        It counts in `refused` what it refuses.
        """
        self.queued: ArrivalsQueue = queue.Queue(_LONGEST_QUEUE)
        self._bus, self._realm, self._at_end = bus, realm, at_end
        self._refused = Counter() if refused is None else refused
        self._closing, self._failed = threading.Event(), threading.Event()
        self._seen = SeenSequences()
        self._wrong_clocks: set[str] = set()
        """Trucks whose clocks were logged as wrong."""
        self._thread = threading.Thread(target=self._receive, name="receive", daemon=True)

    @property
    def has_failed(self) -> bool:
        """Whether nothing more could be received: such a worker must not look alive."""
        return self._failed.is_set()

    def start(self) -> None:
        """Start to receive."""
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    def _receive(self) -> None:
        try:
            self._receive_all()
        except Exception as error:  # whatever it is, nothing more would be received
            if not self._closing.is_set():
                self._failed.set()
                unforeseen = not isinstance(error, zenoh.ZError | StaleConnectionError)
                _log.error("the connection to the bus failed: %s", error, exc_info=unforeseen)
        finally:
            self._at_end()

    def _receive_all(self) -> None:
        bus, other_realms = self._bus, OtherRealms(self._bus, self._realm)
        is_hinted = False
        tokens = selector(self._realm, "vehicle", "alive")
        alive = bus.liveliness().declare_subscriber(
            tokens, zenoh.handlers.FifoChannel(1000), history=True
        )
        probe = LivenessProbe(bus, tokens, other_realms.alive)
        with Subscription(bus, selector(self._realm, "vehicle")) as vehicles:
            while not self._closing.is_set():
                received = vehicles.receive(POLL_S)
                token = alive.handler.try_recv()
                now_s = time.monotonic()
                try:
                    if token is not None:
                        one = _token(token, now_s)
                        probe.heard(now_s)
                        self._put(one)
                    if received is None:
                        other_realms.look()
                        probe.poll(now_s)
                        if not (is_hinted or self._seen.streams) and (line := other_realms.line()):
                            is_hinted = True
                            _log.warning("%s", line)
                        continue
                    probe.heard(now_s)
                    key, identity = received.key(), received.identity()
                except ValueError as error:
                    _log.warning("refused: %.200s", error)
                    self._refused["receiver"] += 1
                    continue
                self._take(received, key, identity, now_s)
        alive.undeclare()  # type: ignore[no-untyped-call]
        other_realms.close()

    def _take(self, received: RawSample, key: Key, identity: Identity, now_s: float) -> None:
        """Queue a message of a truck that is whole and new."""
        if key.stream not in TRUCK_DECODERS:
            return
        try:
            # A router that cuts off a reader in the middle of a message leaves the rest of it
            # to the next one. A good copy follows, which must not count as known.
            wall_time_ns = _check_whole(received.payload, key, identity)
        except ValueError as error:
            line = "refused %s of %s: %.200s"
            fields = about(vehicle=key.identifier)
            _log.warning(line, key.stream, key.identifier, error, extra=fields)
            self._refused["receiver"] += 1
            return
        if self._seen.add(key, identity):
            if not received.recovered:
                self._check_clock(key, time.time() - wall_time_ns / NS_PER_S)
            self._put(TruckMessage(key, *identity, received.payload, now_s))

    def _check_clock(self, key: Key, age_s: float) -> None:
        """Log once that a truck's new samples are impossibly old or in the future."""
        is_right = -_AHEAD_S <= age_s < _BEHIND_S
        if is_right or is_simulated(key.realm) or is_from_recording(key.realm):
            return
        if key.identifier not in self._wrong_clocks and len(self._wrong_clocks) < _MAX_CLOCKS:
            self._wrong_clocks.add(key.identifier)
            _log.warning(
                "the clock of %s is %s %s this machine's; its crossings get wrong dates",
                key.identifier,
                offset_in_words(abs(age_s), 0),
                "ahead of" if age_s < 0.0 else "behind",
                extra=about(vehicle=key.identifier),
            )

    def _put(self, item: TruckMessage | LivenessToken) -> None:
        """Wait for room in the queue, but not beyond the end of the service."""
        while not self._closing.is_set():
            with contextlib.suppress(queue.Full):
                self.queued.put(item, timeout=POLL_S)
                return


def _token(sample: Any, now_s: float) -> LivenessToken:
    """Return a truck's token; raise ValueError for a key of another form."""
    key = parse_key(str(sample.key_expr))
    return LivenessToken(key.realm, key.identifier, sample.kind == zenoh.SampleKind.PUT, now_s)


def _check_whole(payload: bytes, key: Key, identity: Identity) -> int:
    """Return the wall time of a message in ns.

    Raise ValueError for a malformed payload, or one that differs from its attachment.
    """
    message = TRUCK_DECODERS[key.stream](payload)
    if (message.boot_id, message.sequence) != identity:
        raise ValueError(
            f"claims to be {message.sequence} of boot {message.boot_id}, and came as "
            f"{identity.sequence} of boot {identity.boot_id}"
        )
    return int(message.wall_time_ns)
