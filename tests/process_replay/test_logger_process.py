"""The logger as a process: bad messages, signals, disks that are full, files that exist."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
import zenoh

from schemas.events import EventKind, decode_event
from schemas.proto import driveby_pb2 as pb
from schemas.signals import GnssFix, encode_gnss, encode_identity
from schemas.topics import Message, selector
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.recordings.recording import read_info, read_messages
from services.recordings.writer import write_recording
from tests.process_replay.starting import End, Start, start_logger
from tests.receiving import get_latest
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process

PREFIX = "driveby/v1"


def test_bad_messages_are_refused_reported_and_never_written(
    start: Start, finish: End, terminate: End, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    good = next(m for m in read_messages(recording) if m.key.stream == "gnss").payload
    identity = encode_identity(1, 0)
    bad: list[tuple[str, bytes, bytes | None]] = [
        (f"{PREFIX}/live/vehicle/truck-1/nonsense", good, identity),
        (f"{PREFIX}/live/vehicle/truck-1/gnss", good, None),
        (f"{PREFIX}/live/vehicle/truck-1/gnss", good, b"12"),
        (f"{PREFIX}/live/vehicle/truck-1/gnss", good[:10], identity),
        (f"{PREFIX}/live/vehicle/truck-1/gnss", b"\x00" * 1_000_000, identity),
        (f"{PREFIX}/live/vehicle/truck-1/accel", good, identity),
        (f"{PREFIX}/live/vehicle/../gnss", good, identity),
        (f"{PREFIX}/live/vehicle/TRUCK/gnss", good, identity),
        (f"{PREFIX}/life/vehicle/truck-1/gnss", good, identity),
        (f"{PREFIX}/live/vehicle/{'a' * 10_000}/gnss", good, identity),
        (f"{PREFIX}/live/vehicle/a\nb/gnss", good, identity),
        (f"{PREFIX}/live", good, identity),
    ]
    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S) as stranger,
        Subscription(stranger, selector(None, "service", "event")) as outcome,
    ):
        for where, payload, attachment in bad:
            stranger.put(
                where,
                payload,
                attachment=attachment,
                congestion_control=zenoh.CongestionControl.BLOCK,  # by default it may drop
            )
        replay = {"endpoint": endpoint, "speed": 0.0, "name": "x"}
        finish(start("services.replay", recordings=[str(recording)], **replay))
        reported = 0

        def all_are_reported() -> bool:
            nonlocal reported
            if (one := outcome.receive(0.1)) is not None:
                event = decode_event(one.payload)
                reported += event.messages if event.kind == EventKind.REFUSED else 0
            return reported >= len(bad)

        until(all_are_reported, "the reports of what was refused")
    terminate(logger)
    found = list(read_messages(tmp_path / "live.mcap"))
    data = [m for m in found if m.key.owner == "vehicle"]
    assert len(data) == 401
    assert {m.key.realm for m in data} == {"replay-x"}
    events = [decode_event(m.payload) for m in found if m.key.stream == "event"]
    refused = [event for event in events if event.kind == EventKind.REFUSED]
    assert sum(event.messages for event in refused) == len(bad)
    info = read_info(tmp_path / "live.mcap")
    assert info.end is not None
    assert info.end["refused"] == str(len(bad))


def test_a_realm_keeps_out_the_others(
    start: Start, finish: End, terminate: End, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "live.mcap", realms=["replay-y"])
    for name in ("x", "y"):
        arguments = {"endpoint": endpoint, "speed": 0.0, "name": name}
        arguments["subscriber_timeout_s"] = 1 if name == "x" else LONGEST_S
        process = start("services.replay", recordings=[str(recording)], **arguments)
        if name == "x":
            _, log = process.communicate(timeout=LONGEST_S)
            assert process.returncode == 1
            assert "no subscriber to realm replay-x" in log.splitlines()[-1]
        else:
            finish(process)
    terminate(logger)
    messages = list(read_messages(tmp_path / "live.mcap"))
    assert {m.key.realm for m in messages} == {"replay-y"}
    assert len(messages) == 401
    assert read_info(tmp_path / "live.mcap").about["realm"] == "replay-y"


def test_the_site_file_goes_into_the_recording(
    start: Start, terminate: End, endpoint: str, csv_example: Path, tmp_path: Path
) -> None:
    site = csv_example / "site.toml"
    terminate(start_logger(start, endpoint, tmp_path / "live.mcap", site=site))
    assert read_info(tmp_path / "live.mcap").site_toml == site.read_text()


def test_interrupt_finishes_the_file(start: Start, endpoint: str, tmp_path: Path) -> None:
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    logger.send_signal(signal.SIGINT)
    _, log = logger.communicate(timeout=LONGEST_S)
    assert logger.returncode == 0, log
    info = read_info(tmp_path / "live.mcap")
    assert info.end is not None
    assert not info.truncated


def is_on_disk(session: zenoh.Session, number: int) -> bool:
    output = get_latest(session, selector("live", "service", "durable"), LONGEST_S)
    streams = [one for payload in output for one in pb.Durable.FromString(payload).streams]
    return sum(one.count for one in streams if one.stream == "gnss") >= number


def test_how_it_is_stands_in_the_log_as_text_and_as_json(endpoint: str, tmp_path: Path) -> None:
    for form in ("text", "json"):
        arguments = ["--log-format", form, "logger", "--listen", endpoint, "--folder", tmp_path]
        logger = subprocess.Popen(
            [sys.executable, "-m", "services", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert logger.stdout is not None
        assert "ready" in logger.stdout.readline()
        # The room on the disk is looked at after what came is written: before the second message.
        with open_session(connect=endpoint, timeout_s=LONGEST_S) as session:
            publisher = Publisher(session, "live")
            for number in range(2):
                fix = GnssFix(publisher.boot_id, number, 5, time.time_ns(), 50.0, 8.0, 100.0, 10.0)
                publisher.put("vehicle", "truck-1", "gnss", encode_gnss(fix))
                until(partial(is_on_disk, session, number + 1), "a message on the disk")
            publisher.close()
        logger.send_signal(signal.SIGTERM)
        _, log = logger.communicate(timeout=LONGEST_S)
        assert logger.returncode == 0, log
        line = log.splitlines()[-1]
        if form == "json":
            outcome = [json.loads(line) for line in log.splitlines()]
            figures = [line["figures"] for line in outcome if "figures" in line][-1]
            assert {"rate_per_s", "lag_s", "queue", "lost", "recovered", "duplicates"} <= {*figures}
            assert figures["disk_free_bytes"] > 0
        else:
            assert re.search(r"0 trucks, \d+ messages/s, lag .* s, queue 0, lost 0", line)
            assert line.endswith(" GB left")


def test_an_existing_file_is_left_alone(
    endpoint: str, tmp_path: Path, project: Path, start: Start
) -> None:
    file = tmp_path / "live.mcap"
    file.write_bytes(b"precious")
    with pytest.raises(pytest.fail.Exception, match="exists, and recordings are never overwritten"):
        start_logger(start, endpoint, file)
    assert file.read_bytes() == b"precious"


def test_full_disk_is_reported_and_ends_the_logger(
    start: Start,
    endpoint: str,
    drive_messages: Callable[..., Iterator[Message]],
    tmp_path: Path,
) -> None:
    """A limit on the size of files stands for the full disk: writing fails in the same way.

    It is the first large batch that exceeds the limit, so END has room wherever chunks end.
    """
    import resource

    recording = tmp_path / "drive.mcap"
    write_recording(recording, drive_messages(large_from=15), site_toml=None, reason="test")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limit[1]))  # the child inherits it
    try:
        logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S) as session,
        Subscription(session, selector("live", "service")) as services,
    ):
        arguments = {"endpoint": endpoint, "realm": "live", "speed": 50.0, "vehicle": None}
        start("services.truck", recording=recording, **arguments)
        _, log = logger.communicate(timeout=LONGEST_S)
        assert logger.returncode == 1
        assert log.splitlines()[-1] == "recording stopped: File too large"
        assert "Traceback" not in log
        output: list[RawSample] = []

        def is_reported() -> bool:
            if (received := services.receive(0.1)) is not None:
                output.append(received)
            return any(
                r.key_text.endswith("health") and not pb.Health.FromString(r.payload).ok
                for r in output
            )

        until(is_reported, "that it is not well")
        while (received := services.receive(0.1)) is not None:
            output.append(received)
    health = [pb.Health.FromString(r.payload) for r in output if r.key_text.endswith("health")]
    assert not health[-1].ok
    assert health[-1].ended
    events = [decode_event(r.payload) for r in output if r.key_text.endswith("event")]
    assert EventKind.WRITE_ERROR in [event.kind for event in events]
    info = read_info(tmp_path / "live.mcap")
    assert (info.truncated, info.damaged_chunks) == (False, 0)
    assert info.end is not None
    assert info.end["reason"] == "recording stopped: File too large"
    assert int(info.end["not_written"]) > 0
    found = list(read_messages(tmp_path / "live.mcap"))
    assert info.end["messages"] == str(len(found))
    [event] = [decode_event(m.payload) for m in found if m.key.stream == "event"]
    assert event.kind == EventKind.WRITE_ERROR
    assert (tmp_path / "live.mcap").stat().st_size <= 100_000


def test_late_subscriber_receives_durable(
    start: Start, finish: End, terminate: End, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    arguments = {"endpoint": endpoint, "speed": 0.0, "name": "x"}
    finish(start("services.replay", recordings=[str(recording)], **arguments))
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as session:
        [payload] = get_latest(session, selector("replay-x", "service", "durable"))
    streams = {s.stream: s for s in pb.Durable.FromString(payload).streams}
    assert {name: (s.sequence, s.count) for name, s in streams.items()} == {
        "info": (0, 1),
        "accel": (199, 200),
        "gnss": (99, 100),
        "location": (99, 100),
    }
    assert {s.boot_id for s in streams.values()} == {77}
    terminate(logger)


def test_a_second_signal_ends_it_at_once(start: Start, endpoint: str, tmp_path: Path) -> None:
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    os.kill(logger.pid, signal.SIGTERM)
    os.kill(logger.pid, signal.SIGTERM)
    logger.communicate(timeout=LONGEST_S)
    assert logger.returncode in (0, 130)  # 0: it was faster than the second signal
