"""A connection that stands and brings nothing is found out; silence is not taken for it."""

import time

import pytest
import zenoh

from services.bus.liveness import _MISSES, _SILENCE_S, LivenessProbe, StaleConnectionError
from tests.waiting import LONGEST_S

ALIVE = "driveby/v1/sim/vehicle/*/alive"


def asked(hearing: LivenessProbe, times: int) -> None:
    """Look until so many questions have been answered or missed; each comes after a silence."""
    now_s, deadline = 1000.0, time.monotonic() + LONGEST_S
    hearing.heard(now_s)
    for _ in range(times):
        now_s += _SILENCE_S
        hearing.poll(now_s)
        assert hearing._replies is not None
        while hearing._replies is not None:
            assert time.monotonic() < deadline
            hearing.poll(now_s)
            time.sleep(0.01)


def test_silent_expected_process_raises(client: zenoh.Session) -> None:
    hearing = LivenessProbe(client, ALIVE, {"truck-1"})
    hearing.heard(0.0)
    with pytest.raises(StaleConnectionError, match="truck-1 should answer and do not"):
        asked(hearing, _MISSES)


def test_present_but_silent_truck_raises_nothing(
    client: zenoh.Session, router: zenoh.Session
) -> None:
    token = router.liveliness().declare_token("driveby/v1/sim/vehicle/truck-1/alive")
    hearing = LivenessProbe(client, ALIVE, {"truck-1"})
    hearing.heard(0.0)
    asked(hearing, 1)
    # Whatever was missed before, for the router may not know of it at once, is forgiven by then.
    deadline = time.monotonic() + LONGEST_S
    while hearing._missed:
        assert time.monotonic() < deadline
        asked(hearing, 1)
    asked(hearing, _MISSES + 1)
    token.undeclare()


def test_nobody_is_asked_for_nobody(client: zenoh.Session) -> None:
    there = {"truck-1"}
    hearing = LivenessProbe(client, ALIVE, there)
    hearing.heard(0.0)
    there.clear()
    for now_s in range(2, 2000, 7):
        hearing.poll(float(now_s))
        assert hearing._replies is None


def test_a_message_ends_a_question(client: zenoh.Session) -> None:
    hearing = LivenessProbe(client, ALIVE, {"truck-1"})
    hearing.heard(0.0)
    for n in range(1, 4 * _MISSES):
        hearing.poll(n * _SILENCE_S)
        assert hearing._replies is not None
        hearing.heard(n * _SILENCE_S)
        assert hearing._replies is None
