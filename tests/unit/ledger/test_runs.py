"""What earlier runs of the worker left on the disk, and what the next one makes of it."""

import os
import resource
import signal
from collections.abc import Iterable
from pathlib import Path

import pytest

from schemas.results import BridgeResult, CrossingResult, ResultHeader, load_results
from schemas.results_on_the_wire import bridge_to_protobuf, crossing_to_protobuf
from schemas.topics import Key, Message
from services.common.errors import FailureError
from services.identification.known import search_hash
from services.ledger.runs import EarlierRuns, MessageName, ResultFiles, read_earlier
from services.recordings.writer import RecordingOrigin, RecordingWriter

REALM = "live"
NOW_S = 1_800_000_000.0
HEADER = ResultHeader("0.1", NOW_S, "abc", {"method": "pre"}, 1)
SEARCH = search_hash(HEADER)
WHERE = Key(REALM, "bridge", "b", "estimate")


def result(number: int) -> CrossingResult:
    one = {"unit": "N·m²", "mean": number + 1.0, "std": 0.1, "q025": 0.8, "q50": 1, "q975": 1.2}
    return CrossingResult.model_validate(
        {
            "crossing_id": f"t.b.{number}",
            "realm": REALM,
            "vehicle": "t",
            "bridge": "b",
            "direction": "start_to_end",
            "entry_time": NOW_S + 100.0 * number,
            "exit_time": NOW_S + 100.0 * number + 3.0,
            "speed_m_per_s": 10.0,
            "method": "pre",
            "verdict": "good",
            "parameters": {"EI_1": one},
        }
    )


def estimate(number: int, boot_id: int = 1, time_s: float | None = None) -> Message:
    payload = crossing_to_protobuf(result(number), HEADER).SerializeToString(deterministic=True)
    moment_ns = round((NOW_S + 100.0 * number if time_s is None else time_s) * 1e9)
    return Message(WHERE, payload, boot_id, number, moment_ns, moment_ns)


def written(
    path: Path,
    *messages: Message,
    end: bool = False,
    previous: str | None = None,
    began_s: float | None = None,
) -> Path:
    """The file of a run; without `end` as a `kill -9` leaves it."""
    began_ns = None if began_s is None else round(began_s * 1e9)
    writer = RecordingWriter(
        path, reason="test", origin=RecordingOrigin(REALM), previous=previous, time_ns=began_ns
    )
    for message in messages:
        writer.write(message)
        writer.sync()
    if end:
        writer.finish("stopped by a signal")
    else:
        writer.abandon()
    os.utime(path, (NOW_S, NOW_S))
    return path


def sequences(messages: Iterable[Message | MessageName]) -> list[tuple[int, int]]:
    return [(message.boot_id, message.sequence) for message in messages]


def test_a_folder_that_is_not_there_holds_nothing(tmp_path: Path) -> None:
    assert read_earlier(tmp_path / "none", REALM, NOW_S, SEARCH) == EarlierRuns()


def test_the_last_minute_of_a_run_that_ended_well_is_unsure_too(tmp_path: Path) -> None:
    """The router may have been away when it was stopped: to put a message confirms nothing."""
    path = written(tmp_path / "results-1.mcap", estimate(0), estimate(1), end=True)
    found = read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    assert sequences(found.published) == [(1, 0), (1, 1)]
    assert sequences(found.unconfirmed) == [(1, 1)]  # the other is 100 s older
    assert found.previous == path.name
    assert not path.with_suffix(".json").exists()


def test_the_last_minute_of_a_run_that_was_killed_is_unsure(tmp_path: Path) -> None:
    written(
        tmp_path / "results-1.mcap",
        estimate(0, time_s=NOW_S),
        estimate(1, time_s=NOW_S + 45.0),
        estimate(2, time_s=NOW_S + 100.0),
    )
    found = read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    assert sequences(found.published) == [(1, 0), (1, 1), (1, 2)]
    assert sequences(found.unconfirmed) == [(1, 1), (1, 2)]


@pytest.mark.parametrize("end", [True, False])
@pytest.mark.parametrize("lived_s", [0.02, 59.0, 61.0])
def test_a_run_that_was_continued_long_enough_has_been_published_again(
    tmp_path: Path, *, end: bool, lived_s: float
) -> None:
    """Who is killed right after it has published that again has said it to nobody, either."""
    first = written(tmp_path / "results-1.mcap", estimate(0))
    second = written(
        tmp_path / "results-2.mcap",
        estimate(1, boot_id=2, time_s=NOW_S + lived_s),
        end=end,
        previous=first.name,
        began_s=NOW_S,
    )
    found = read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    assert sequences(found.published) == [(1, 0), (2, 1)]
    is_continued = end or lived_s > 60.0
    assert sequences(found.unconfirmed) == ([] if is_continued else [(1, 0)]) + [(2, 1)]
    assert found.previous == second.name


def test_a_run_that_goes_on_is_known_and_left_alone(tmp_path: Path) -> None:
    """Another worker with the same folder."""
    writer = RecordingWriter(
        tmp_path / "results-1.mcap", reason="test", origin=RecordingOrigin(REALM)
    )
    writer.write(estimate(0))
    writer.sync()
    os.utime(writer.path, (NOW_S, NOW_S))
    found = read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    assert (sequences(found.published), found.unconfirmed) == ([(1, 0)], ())
    assert not (tmp_path / "results-1.json").exists()
    writer.finish("test")


def test_other_realms_and_old_files_are_left_out(tmp_path: Path) -> None:
    other = estimate(0)._replace(key=WHERE._replace(realm="sim-other"))
    written(tmp_path / "results-1.mcap", other)
    old = written(tmp_path / "results-2.mcap", estimate(0))
    os.utime(old, (NOW_S - 3 * 86_400.0, NOW_S - 3 * 86_400.0))
    assert read_earlier(tmp_path, REALM, NOW_S, SEARCH) == EarlierRuns()


def test_a_recovered_copy_adds_nothing(tmp_path: Path) -> None:
    written(tmp_path / "results-1.mcap", estimate(0), estimate(1))
    written(tmp_path / "results-1.recovered.mcap", estimate(0), estimate(1), end=True)
    found = read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    assert sequences(found.published) == [(1, 0), (1, 1)]


@pytest.mark.parametrize("share", [0.0, 0.1, 0.75, 0.95])
def test_a_file_that_is_cut_off_is_read_as_far_as_it_goes(
    tmp_path: Path, share: float, caplog: pytest.LogCaptureFixture
) -> None:
    whole = written(tmp_path / "results-1.mcap", *(estimate(n) for n in range(8)))
    content = whole.read_bytes()
    whole.write_bytes(content[: round(share * len(content))])
    os.utime(whole, (NOW_S, NOW_S))
    written(tmp_path / "results-2.mcap", estimate(8), end=True)
    published = sequences(read_earlier(tmp_path, REALM, NOW_S, SEARCH).published)
    known = len(published) - 1
    assert published == [*((1, n) for n in range(known)), (1, 8)]
    assert (known > 0) == (share >= 0.75)
    assert known < 8
    assert "results-1.mcap" in caplog.text


@pytest.mark.parametrize("position", range(0, 100, 7))
def test_no_damage_is_a_failure(tmp_path: Path, position: int) -> None:
    path = written(tmp_path / "results-1.mcap", *(estimate(n) for n in range(4)))
    content = bytearray(path.read_bytes())
    content[len(content) * position // 100] ^= 0x55
    path.write_bytes(content)
    os.utime(path, (NOW_S, NOW_S))
    written(tmp_path / "results-2.mcap", estimate(4), end=True)
    assert (1, 4) in sequences(read_earlier(tmp_path, REALM, NOW_S, SEARCH).published)


def test_a_damaged_time_of_the_start_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Metadata have no checksum of their own that would show it."""
    path = written(tmp_path / "results-1.mcap", estimate(0))
    content = bytearray(path.read_bytes())
    place = content.index(b"time_ns") + len(b"time_ns") + 4  # behind the length of the value
    assert content[place : place + 1].isdigit()
    content[place] ^= 0x40
    path.write_bytes(content)
    os.utime(path, (NOW_S, NOW_S))
    written(tmp_path / "results-2.mcap", estimate(1), end=True)
    assert sequences(read_earlier(tmp_path, REALM, NOW_S, SEARCH).published) == [(1, 1)]
    assert "skipping the results of an earlier run" in caplog.text


@pytest.mark.parametrize("stale", [False, True])
def test_results_that_stand_in_the_recording_only_get_into_the_json_file(
    tmp_path: Path, *, stale: bool
) -> None:
    """Killed between the two: the JSON file is missing, or lacks the last result."""
    written(tmp_path / "results-0.mcap", estimate(0), end=True)
    path = tmp_path / "results-1.mcap"
    if stale:
        files = ResultFiles(path, "site", HEADER._replace(created=5.0), None)
        files.write(estimate(1), result(1), {})
        files.finish()
        path.unlink()
    written(path, estimate(1), estimate(2))
    read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    found = load_results(path.with_suffix(".json"))
    assert [crossing.crossing_id for crossing in found.crossings] == ["t.b.1", "t.b.2"]
    assert (found.site_hash, found.settings, found.seed) == ("abc", {"method": "pre"}, 1)
    assert (found.created == 5.0) == stale
    assert found.created > 0.0
    (bridge,) = found.bridges.values()
    assert bridge.crossings_used == ("t.b.2",)
    assert [out.crossing_id for out in bridge.crossings_left_out] == ["t.b.0", "t.b.1"]
    before = path.with_suffix(".json").read_bytes()
    read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    assert path.with_suffix(".json").read_bytes() == before


def test_the_latest_state_of_each_bridge_is_latched(tmp_path: Path) -> None:
    def state(bridge: str, number: int) -> Message:
        return estimate(number)._replace(key=Key(REALM, "bridge", bridge, "state"), payload=b"x")

    written(tmp_path / "results-1.mcap", state("a", 0), state("b", 1), state("b", 2), end=True)
    written(tmp_path / "results-2.mcap", state("b", 3), estimate(4), end=True)
    found = read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    assert [(m.key.identifier, m.sequence) for m in found.latched] == [("a", 0), ("b", 3)]


def test_states_of_earlier_runs_are_read_from_their_messages(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    outcome = BridgeResult(verdict="rejected", crossings_left_out_count=3)  # type: ignore[call-arg]

    def state(bridge: str, payload: bytes) -> Message:
        return estimate(0)._replace(key=Key(REALM, "bridge", bridge, "state"), payload=payload)

    payload = bridge_to_protobuf("a", 1, outcome).SerializeToString()
    written(tmp_path / "results-1.mcap", state("a", payload), state("b", b"x"), end=True)
    found = read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    assert found.states() == {(REALM, "a"): outcome}
    assert "skipping a state of b" in caplog.text


def test_a_run_whose_results_could_not_be_written_has_no_end(tmp_path: Path) -> None:
    """The next one must publish what this one did not."""
    files = ResultFiles(tmp_path / "results-1.mcap", "site", HEADER, None)
    (tmp_path / "results-1.json").mkdir()
    with pytest.raises(Exception, match=r"results-1\.json"):
        files.write(estimate(0), result(0), {})
    files.abandon()
    os.utime(files.path, (NOW_S, NOW_S))
    assert sequences(read_earlier(tmp_path, REALM, NOW_S, SEARCH).unconfirmed) == [(1, 0)]


def test_a_disk_that_is_full_at_the_end_is_a_failure_in_one_line(tmp_path: Path) -> None:
    """What was written before is whole."""
    files = ResultFiles(tmp_path / "results-1.mcap", "site", HEADER, None)
    files.write(estimate(0), result(0), {})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (files.path.stat().st_size, before[1]))
    try:
        with pytest.raises(FailureError, match=r"results-1\.mcap: cannot be ended: File too large"):
            files.finish()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    os.utime(files.path, (NOW_S, NOW_S))
    assert sequences(read_earlier(tmp_path, REALM, NOW_S, SEARCH).unconfirmed) == [(1, 0)]
