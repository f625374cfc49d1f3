"""When a recording with pauses is published: what is waited for, what is said, what is stamped."""

import errno
import logging
import re
import time
from datetime import datetime
from pathlib import Path

import pytest

from schemas.signals import NS_PER_S
from schemas.topics import Key, Message
from services.bus import playback
from services.cli import main as cli
from services.logger.health_line import health_line
from services.truck.run import _driven_now, _log_timing, _times
from services.truck.spool import Spool
from tests.drives import SAMPLE
from tests.unit.bus.test_playback import Clock, Delivered
from tests.unit.identification.test_engine_resume import THERE, engine, fed, messages_of

WHERE = Key("live", "vehicle", "truck-1", "gnss")


def recorded(*times_s: float) -> dict[str, list[Message]]:
    return {
        "gnss": [
            Message(WHERE, b"", 1, number, round(time_s * 1e9), 0)
            for number, time_s in enumerate(times_s)
        ]
    }


TWO_RUNS = recorded(0.0, 1.0, 2.0, 602.0, 603.0)


def test_a_pause_is_waited_for_unless_it_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    for longest_gap_s, due_s in ((float("inf"), 603.0), (playback.GAP_S, 3.0)):
        clock = Clock()
        monkeypatch.setattr("services.bus.playback.time.monotonic", lambda clock=clock: clock.now_s)
        came_s: list[float] = []

        def put(message: Message, came_s: list[float] = came_s, clock: Clock = clock) -> None:
            came_s.append(clock.now_s - 1000.0)

        playback.publish_paced(
            TWO_RUNS["gnss"], put, Delivered(), speed=1.0, stop=clock,  # type: ignore[arg-type]
            longest_gap_s=longest_gap_s,
        )  # fmt: skip
        assert came_s[:3] == pytest.approx([0.0, 1.0, 2.0])
        assert came_s[-1] == pytest.approx(due_s)


@pytest.mark.parametrize(
    ("speed", "skip_gaps", "takes_s", "waits_s", "ahead_s"),
    [
        (1.0, False, 603.0, 600.0, 0.0),
        (1.0, True, 3.0, 0.0, 600.0),
        (10.0, False, 60.3, 60.0, 542.7),
        (10.0, True, 0.3, 0.0, 602.7),
        (0.5, False, 1206.0, 1200.0, 0.0),
        (0.0, False, 0.0, 0.0, 603.0),
    ],
)
def test_no_stamp_lies_in_the_future(
    speed: float, skip_gaps: bool, takes_s: float, waits_s: float, ahead_s: float
) -> None:
    times = _times(TWO_RUNS, speed, skip_gaps=skip_gaps)
    assert (times.takes_s, times.waits_s) == pytest.approx((takes_s, waits_s))
    assert times.ahead_ns == round(ahead_s * 1e9)
    assert times.longest_ns == (2_000_000_000, 602_000_000_000)


def test_runs_that_are_one_drive_now_are_as_many_crossings() -> None:
    """Twice there: nobody sees the truck come back, and it is one boot now."""
    there = messages_of(*THERE)
    later = [
        m._replace(boot_id=m.boot_id + 1, log_time_ns=m.log_time_ns + 600 * NS_PER_S) for m in there
    ]
    streams: dict[str, list[Message]] = {}
    for message in [*there, *later]:
        streams.setdefault(message.key.stream, []).append(message)
    times = _times(streams, 1.0, skip_gaps=True)
    drive = list(_driven_now(Path("two.mcap"), streams, "sim-now", 7, times))
    assert {message.boot_id for message in drive} == {7}
    one = engine()
    outputs = [*fed(one, drive), *one.finish()]
    results = [output.result for output in outputs if output.result is not None]
    assert [(r.direction, r.verdict) for r in results] == [("start_to_end", "good")] * 2


def printed(caplog: pytest.LogCaptureFixture, speed: float, *, skip_gaps: bool) -> str:
    caplog.clear()
    with caplog.at_level(logging.INFO):
        _log_timing(_times(TWO_RUNS, speed, skip_gaps=skip_gaps))
    return caplog.text


def test_waiting_time_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    text = printed(caplog, 1.0, skip_gaps=False)
    assert (
        "nothing was recorded for up to 600 s (between runs): of the 603 s that the drive takes, "
        "600 s are spent waiting; --skip-gaps skips them" in text
    )
    assert "times are shifted" not in text


def test_times_of_long_ago_are_explained(caplog: pytest.LogCaptureFixture) -> None:
    text = printed(caplog, 1.0, skip_gaps=True)
    assert "waiting" not in text
    found = re.search(
        r"the drive begins at (\S+ \S+) UTC, and its first samples are 600 s old", text
    )
    assert found
    begins_s = datetime.fromisoformat(f"{found[1]}+00:00").timestamp()
    assert begins_s == pytest.approx(time.time() - 600.0, abs=300.0)


def test_a_drive_as_it_was_says_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        _log_timing(_times(recorded(0.0, 1.0, 2.0), 1.0, skip_gaps=False))
    assert caplog.text == ""


def test_long_lag_is_explained_where_it_is_reported() -> None:
    assert "lag 0.20 s, queue 0" in health_line({"lag_s": 0.2})
    assert health_line({"lag_s": 0.2}).endswith("0 open files")  # the room is not known yet
    assert health_line({"disk_free_bytes": 8.28e10}).endswith("0 open files, 82.8 GB left")
    assert (
        "lag 1356.00 s (old samples: replayed faster than real time, sent late, or a clock is "
        "wrong), queue 0" in health_line({"lag_s": 1356.0})
    )


def test_messages_on_no_disk_and_with_no_router_are_reported_as_lost(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    endpoint: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    append = Spool.append

    def full(self: Spool, stream: str, sequence: int, payload: bytes) -> None:
        if stream == "gnss":
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, stream, sequence, payload)

    monkeypatch.setattr(Spool, "append", full)
    monkeypatch.setattr("services.bus.delivery.LINGER_S", 0.0)
    arguments = ["--spool", str(tmp_path / "spool"), "--endpoint", endpoint, "--speed", "50"]
    assert cli.main(["truck", str(SAMPLE), *arguments]) == 1
    [line] = [one for one in capsys.readouterr().err.splitlines() if one.startswith("driveby: ")]
    assert "90 of 360 messages of truck-1 are lost: no room in the spool" in line


def test_the_option_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["truck", str(tmp_path / "none.mcap"), "--skip-gaps"]) == 2
    assert "none.mcap" in capsys.readouterr().err
