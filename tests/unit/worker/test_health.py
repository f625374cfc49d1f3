"""The worker's `health`: what it says stays true while the message is kept."""

import re
import time
from typing import NamedTuple, cast

import pytest

from schemas.proto import driveby_pb2 as pb
from services.execution.dispatch import CrossingExecutor, RunningCrossing
from services.worker.backfill import WaitingCounts
from services.worker.health import QueueLag, Workload, publish_health

NOW_S = 1_790_000_600.0  # 14:23:20 UTC


class Busy(NamedTuple):
    running: list[RunningCrossing]


def test_note_names_the_start_of_an_identification(monkeypatch: pytest.MonkeyPatch) -> None:
    """The message comes once a minute: an age in its text would be stale."""
    monkeypatch.setattr(time, "time", lambda: NOW_S)
    published: list[bytes] = []
    busy = Busy([RunningCrossing("a", 30.0), RunningCrossing("b", 4.0)])
    publish_health(
        published.append,
        "worker",
        cast("CrossingExecutor", busy),
        QueueLag(0, 0.0, refused=2),
        Workload(("a", "b"), 0, 0, WaitingCounts()),
        verdicts={},
        note="",
    )
    message = pb.Health.FromString(published[0])
    assert message.note == (
        "identifying a since 14:22:50 UTC; identifying b since 14:23:16 UTC; refused 2 invalid "
        "messages"
    )
    assert not re.search(r"for \d+ s", message.note)
    assert message.time_ns == round(1e9 * NOW_S)
    assert message.figures["identifying_longest_s"] == 30.0
    assert message.figures["refused"] == 2.0
