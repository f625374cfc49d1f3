"""Crossings in recordings: found by position, across files, with the data that live ones have."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.signals import NS_PER_S
from schemas.topics import Message
from services.finding.stays import Passage
from services.identification.engine import Engine
from services.identification.outputs import IdentificationTask
from services.ledger import recorded_crossings
from services.ledger.crossing_log import Ledger
from services.ledger.recorded_crossings import (
    FetchResult,
    RecordedStay,
    fetch_crossings,
    scan_stays,
)
from services.recordings.writer import write_recording
from tests.builders.ledger import known_crossings
from tests.unit.identification.test_engine_resume import (
    HEADER,
    REALM,
    SETTINGS,
    SITE,
    START_S,
    TWO,
    WHOLE,
    output_of,
)

Files = tuple[Path, ...]


def written(folder: Path, *parts: list[Message]) -> Files:
    """Recordings of these messages, one after the other."""
    paths = tuple(folder / f"truck-1-2026010{n + 1}T000000Z.mcap" for n in range(len(parts)))
    for path, messages in zip(paths, parts, strict=True):
        write_recording(path, iter(messages), site_toml=None, reason="test")
    return paths


def split(*seconds: float) -> list[list[Message]]:
    """There and back, cut where a logger began another file."""
    edges = [-np.inf, *seconds, np.inf]
    return [
        [m for m in TWO if low <= m.log_time_ns * 1e-9 - START_S < high]
        for low, high in pairwise(edges)
    ]


def looked(files: Files) -> list[RecordedStay]:
    return list(scan_stays(files, REALM, "truck-1", SITE).stays)


def taken(
    files: Files, stays: list[RecordedStay], *, is_final: bool = False, published: int = 0
) -> FetchResult:
    known = known_crossings(output_of(WHOLE[:published]))
    return fetch_crossings(files, REALM, stays, known, SITE, SETTINGS, is_final=is_final)


def live() -> list[IdentificationTask]:
    engine = Engine(SITE, SETTINGS, HEADER)
    sent = (one for m in TWO for one in engine.feed(m.key, m.payload))
    return [one for one in sent if isinstance(one, IdentificationTask)]


def same_data(one: IdentificationTask, other: IdentificationTask) -> None:
    """What is identified from, to the last bit."""
    a, b = one.data, other.data
    assert a._replace(samples=None, fixes=None, chainage_m=None) == b._replace(  # type: ignore[arg-type]
        samples=None,
        fixes=None,
        chainage_m=None,  # type: ignore[arg-type]
    )
    assert a.samples is not None
    assert b.samples is not None
    assert (a.samples.start_s, a.samples.rate_hz) == (b.samples.start_s, b.samples.rate_hz)
    for name, values in a.samples.channels.items():
        np.testing.assert_array_equal(values, b.samples.channels[name])
    near = [
        (work.data.fixes.time_s > a.stay.entry_s - 10.0)
        & (work.data.fixes.time_s < a.stay.exit_s + 1.0)
        for work in (one, other)
    ]
    for column, theirs in zip(a.fixes, b.fixes, strict=True):
        np.testing.assert_array_equal(column[near[0]], theirs[near[1]])


@pytest.mark.parametrize("cuts", [(), (7.7,), (6.0, 7.0, 8.0), (2.0, 25.0, 45.0)])
def test_what_is_found_is_what_a_worker_finds_that_listens(
    tmp_path: Path, cuts: tuple[float, ...]
) -> None:
    """Whichever files it is in: the truck is on the bridge from 6 to 9.5 s, and on the way back."""
    files = written(tmp_path, *split(*cuts))
    stays = looked(files)
    assert [stay.passage for stay in stays] == [Passage.THROUGH] * 2
    found = taken(files, stays)
    assert found.missing == ()
    assert [stay for stay, _ in found.found] == stays
    for (_, one), work in zip(found.found, live(), strict=True):
        assert one.pending.task.crossing_id == work.crossing_id
        same_data(one.pending.task, work)
        published = [pb.Crossing.FromString(o.payload).state for o in one.messages]
        assert published == [pb.DETECTED, pb.COMPLETE]
    payloads = [o.payload for _, one in found.found for o in one.messages]
    assert payloads == [o.payload for o in (*WHOLE[:2], *WHOLE[6:8])]


@pytest.mark.parametrize(("published", "left"), [(1, [pb.COMPLETE]), (2, []), (3, [])])
def test_only_unpublished_results_are_published(
    tmp_path: Path, published: int, left: list[pb.CrossingState]
) -> None:
    files = written(tmp_path, TWO)
    ((_, one),) = taken(files, looked(files)[:1], published=published).found
    assert [pb.Crossing.FromString(o.payload).state for o in one.messages] == left
    assert (one.pending.identifying is None) == (published == 3)


def test_what_may_still_come_is_waited_for(tmp_path: Path) -> None:
    """A second of accelerations on the bridge is missing, as when a spool is still to be read."""
    holed = [
        m for m in TWO if m.key.stream != "accel" or not 7.0 < m.log_time_ns / 1e9 - START_S < 8.0
    ]
    files = written(tmp_path, holed)
    stays = looked(files)
    found = taken(files, stays)
    assert [stay for stay, _ in found.found] == stays[1:]
    assert list(found.missing) == stays[:1]
    final = taken(files, stays, is_final=True)
    assert [stay for stay, _ in final.found] == stays
    assert final.missing == ()


def test_a_recording_that_is_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    (path,) = written(tmp_path, TWO)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    found = scan_stays((path,), REALM, "truck-1", SITE)
    assert len(found.stays) == 1
    (warning,) = found.warnings
    assert str(path) in warning
    assert "cut off" in warning


def test_what_is_no_recording_is_a_warning(tmp_path: Path) -> None:
    """And what is in the others counts."""
    (good,) = written(tmp_path, TWO)
    bad, empty = tmp_path / "bad.mcap", tmp_path / "empty.mcap"
    bad.write_bytes(b"no recording")
    empty.touch()
    found = scan_stays((bad, good, empty, tmp_path / "gone.mcap"), REALM, "truck-1", SITE)
    assert len(found.stays) == 2
    assert len(found.warnings) == 3


def test_others_and_other_realms_are_not_this_truck(tmp_path: Path) -> None:
    (path,) = written(tmp_path, TWO)
    assert scan_stays((path,), REALM, "truck-2", SITE).stays == ()
    assert scan_stays((path,), "live", "truck-1", SITE).stays == ()


def test_accelerations_far_from_bridges_are_not_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded_crossings, "AROUND_NS", NS_PER_S)
    held: list[int] = []
    decided = recorded_crossings._decided

    def counted(messages: list[Message], *others: object) -> object:
        held.append(sum(m.key.stream == "accel" for m in messages))
        return decided(messages, *others)  # type: ignore[arg-type]

    monkeypatch.setattr(recorded_crossings, "_decided", counted)
    files = written(tmp_path, TWO)
    taken(files, looked(files))
    assert len(held) == 2
    assert max(held) < 150  # seven seconds of twenty a second; there are a thousand in all


def test_ledger_knows_results_of_earlier_runs_and_this_one() -> None:
    ledger = Ledger(known_crossings(output_of(WHOLE[:3])), 100.0)
    whose = (REALM, "truck-1", "bridge-1")
    (one,) = ledger.about(*whose)
    assert not one.is_identified
    for output in WHOLE[3:9]:
        ledger.note(output.key, output.payload)
    ledger.commit(200.0)
    first, second = ledger.about(*whose)
    assert (first.is_identified, second.is_identified) == (True, False)
    assert first.states == {pb.DETECTED, pb.COMPLETE, pb.IDENTIFYING, pb.DONE}
    assert (first.last, first.usable) == (None, None)
    ledger.note(WHOLE[9].key, WHOLE[9].payload)
    ledger.commit(300.0)
    ledger.forget_before(250.0)
    (left,) = ledger.about(*whose)
    assert (left.crossing_id, left.is_identified) == (second.crossing_id, True)
