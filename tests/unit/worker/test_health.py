"""The worker's `health`: what it says stays true while the message is kept."""

import re
import time
from typing import NamedTuple, cast

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.results import ResultHeader
from schemas.settings import IdentificationSettings
from schemas.signals import GnssFix, encode_gnss
from schemas.topics import Key
from services.execution.dispatch import CrossingExecutor, RunningCrossing
from services.execution.inline import InlineExecutor
from services.identification.engine import Engine
from services.simulation.drive import paper_site
from services.worker.backfill import WaitingCounts
from services.worker.health import QueueLag, Workload, publish_health, workload

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


def test_note_names_trucks_that_the_site_file_lacks() -> None:
    published: list[bytes] = []
    trucks = ("truck-5", "truck-6", "truck-7", "truck-8")
    publish_health(
        published.append,
        "worker",
        cast("CrossingExecutor", Busy([])),
        QueueLag(0, 0.0),
        Workload((), 0, 0, WaitingCounts(), trucks),
        verdicts={},
        note="",
    )
    wanted = "not in the site file, so without results: truck-5, truck-6, truck-7 …"
    assert pb.Health.FromString(published[0]).note == wanted


def test_workload_has_the_trucks_that_the_site_file_lacks() -> None:
    engine = Engine(paper_site(), IdentificationSettings(), ResultHeader("", 0.0, "", {}, 1))
    fix = GnssFix(1, 0, 0, round(1e9 * NOW_S), 50.0, 8.0, 0.0, 9.0)
    list(engine.feed(Key("live", "vehicle", "truck-9", "gnss"), encode_gnss(fix)))
    assert workload(engine, InlineExecutor(), None).unknown_vehicles == ("truck-9",)
