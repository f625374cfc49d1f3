"""`driveby alarm serve` as a process: latched on the bus, over a restart, until acknowledged; and
what those see of it who watch."""

import contextlib
import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zenoh
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from schemas.alarms import Alarm
from schemas.proto import driveby_pb2 as pb
from schemas.topics import key
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.cli import main as cli
from services.common.files import make_folder, write_atomically
from services.history.alarm_files import alarms_folder
from services.history.history_store import add_results
from services.viewer.view import viewer_program
from tests import prepared
from tests.endpoints import free_port
from tests.fleet import losses_of
from tests.process_replay.starting import Start, start_logger
from tests.process_replay.test_view_live import drive
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process
KEY = key("sim-fleet", "bridge", "bridge-2", "alarm")
ALARM = Alarm(
    alarm_id="20250428-4-weaker",
    realm="sim-fleet",
    bridge="bridge-2",
    element=4,
    direction="weaker",
    since=datetime(2025, 4, 14, tzinfo=UTC).timestamp(),
    raised=datetime(2025, 4, 28, tzinfo=UTC).timestamp(),
    sum=10.5,
    threshold=9.3,
    ratio=0.8,
    ratio_q025=0.78,
    ratio_q975=0.82,
)


def serving(history: Path, endpoint: str) -> "subprocess.Popen[bytes]":
    words = ["alarm", "serve", "--history", str(history), "--endpoint", endpoint]
    return subprocess.Popen([sys.executable, "-m", "services", *words])


def alarms_on_bus(session: zenoh.Session) -> list[pb.Alarm]:
    """What a late subscriber gets."""
    replies = session.get(KEY, target=zenoh.QueryTarget.ALL, timeout=LONGEST_S)
    return [pb.Alarm.FromString(r.ok.payload.to_bytes()) for r in replies if r.ok is not None]


def ended(process: "subprocess.Popen[bytes]") -> None:
    process.send_signal(signal.SIGTERM)
    assert process.wait(LONGEST_S) == 0


def test_an_alarm_stands_on_the_bus_until_it_is_acknowledged(tmp_path: Path, endpoint: str) -> None:
    history = tmp_path / "history"
    make_folder(history / "crossings")
    where = alarms_folder(history, "sim-fleet", "bridge-2")
    make_folder(where)
    make_folder(history / "crossings/realm=sim-fleet/bridge=bridge-2")
    write_atomically(where / f"{ALARM.alarm_id}.json", ALARM.model_dump_json())
    processes = []
    with open_session(listen=endpoint) as router:
        try:
            for _ in range(2):  # and again behind a restart
                processes.append(serving(history, endpoint))
                until(lambda: alarms_on_bus(router), "the alarm")
                (message,) = alarms_on_bus(router)
                assert (message.alarm_id, message.is_acknowledged) == (ALARM.alarm_id, False)
                assert message.text == ALARM.sentence()
                ended(processes[-1])
            processes.append(serving(history, endpoint))
            until(lambda: alarms_on_bus(router), "the alarm")
            words = ["alarm", "ack", "bridge-2", "--by", "owner", "--note", "props were put in"]
            assert cli.main([*words, "--history", str(history)]) == 0
            until(
                lambda: [m for m in alarms_on_bus(router) if m.is_acknowledged],
                "its acknowledgement",
            )
            (message,) = alarms_on_bus(router)
            assert (message.acknowledged_by, message.note) == ("owner", "props were put in")
            ended(processes[-1])
        finally:
            for process in processes:
                process.kill()
                process.wait()


class RunningCommand:
    """A command that runs until its end is wanted, and the lines that it has said."""

    def __init__(self, *words: str) -> None:
        self.lines: list[str] = []
        self._process = prepared.Popen(
            [sys.executable, "-m", "driveby", *words],
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        self._reading = threading.Thread(target=self._read)
        self._reading.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line.rstrip("\n"))

    def says(self, pattern: str) -> str:
        """Wait for a line that matches; return it."""
        wanted = re.compile(pattern)
        found: list[str] = []

        def has_come() -> bool:
            found[:] = [line for line in self.lines if wanted.search(line)]
            return bool(found) or self._process.poll() is not None

        until(has_come, pattern)
        assert found, self.lines
        return found[0]

    def __enter__(self) -> "RunningCommand":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._reading.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def ends_well(self) -> None:
        self._process.send_signal(signal.SIGTERM)
        assert self._process.wait(LONGEST_S) == 0
        self._reading.join()
        assert "Traceback" not in "\n".join(self.lines)


def texts_of(address: str, path: Path) -> list[str]:
    """Texts of the bridge that a viewer which comes now receives, one text after the other."""
    command: list[str | Path] = [
        viewer_program(),
        address,
        "--save",
        str(path),
        "--port",
        str(free_port()),
    ]
    path.unlink(missing_ok=True)
    saving = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    texts: list[str] = []

    def has_come() -> bool:
        with contextlib.suppress(OSError, RuntimeError, ValueError):  # half a file
            texts[:] = _texts_in(path)
        return bool(texts)

    try:
        until(has_come, "the text of the bridge")
    finally:
        saving.kill()
        saving.wait()
    return texts


def _texts_in(path: Path) -> Iterator[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RerunWarning)  # that the file has no end yet
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if chunk.entity_path == "/newest/bridge-1" and name.endswith("TextDocument:text"):
                    yield from (one[0] for one in batch.column(name).to_pylist())


@contextlib.contextmanager
def terminal(*words: str) -> Iterator[int]:
    """A command on a terminal; what it draws is read from the descriptor."""
    ours, theirs = pty.openpty()
    own = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", "LINES": "30"}
    command = [sys.executable, "-m", "driveby", *words]
    process = subprocess.Popen(command, stdout=theirs, stderr=theirs, env=own)
    os.close(theirs)
    try:
        yield ours
    finally:
        process.kill()
        process.wait()
        os.close(ours)


def drawn(screen: int, pattern: str) -> str:
    """Wait until something is drawn; return all that was until then."""
    text, deadline = "", time.monotonic() + LONGEST_S
    while not re.search(pattern, text):
        assert time.monotonic() < deadline, text
        if select.select([screen], [], [], 1.0)[0]:
            text += os.read(screen, 65536).decode(errors="replace")
    return text


def test_history_reaches_the_watchers(
    start: Start, endpoint: str, tmp_path: Path, project: Path
) -> None:
    """Processes and a router as they are: it is raised, seen, acknowledged, and seen no more."""
    history, realm = tmp_path / "history", ["--endpoint", endpoint, "--realm", "sim-fleet"]
    begin_s = datetime(2025, 1, 6, tzinfo=UTC).timestamp()
    lost = losses_of({"bridge-1": 14, "bridge-2": None}, begin_s, 24)
    add_results(history, lost, {one.crossing_id: 10.0 for one in lost.crossings})
    start_logger(start, endpoint, tmp_path / "live.mcap")
    site = ["--site", str(project / "docs/site.example.toml")]
    serve = ["alarm", "serve", "--history", str(history), "--endpoint", endpoint]
    stands = r"alarm of bridge-1, active: element 4 is \d+ % less stiff than before 2025-04.*$"
    noted = r"alarm of bridge-1, acknowledged by the owner: element 4 is .*$"
    with (
        RunningCommand("watch", *realm) as early,
        RunningCommand("view", "live", "--serve", *realm, *site) as view,
        open_session(connect=endpoint, timeout_s=LONGEST_S) as bus,
    ):
        address = view.says("live at ").split()[4].rstrip(";")
        publisher = Publisher(bus, "sim-fleet")
        drive(publisher, project)
        early.says("truck-1 drives")

        def shown() -> list[bool]:
            """Of each text of the bridge in the viewer whether an alarm is at its head."""
            found = texts_of(address, tmp_path / "shown.rrd")
            return [text.startswith("### Alarm\n\n**Element 4 is ") for text in found]

        assert not any(shown())
        with RunningCommand(*serve) as serving:
            serving.says("alarm of bridge-1, active: element 4 is")
            early.says(stands)
            with RunningCommand("watch", *realm) as late:
                late.says(stands)
            with terminal("watch", *realm) as screen:
                drawn(screen, r"\x1b\[1;31malarm of bridge-1, active: element 4 is")
            until(lambda: shown()[-1], "the alarm in the viewer")
            words = ["alarm", "ack", "bridge-1", "--by", "the owner", "--note", "props"]
            done = subprocess.run(
                [sys.executable, "-m", "driveby", *words, "--history", str(history)],
                capture_output=True, text=True, check=True, timeout=LONGEST_S,
            )  # fmt: skip
            assert "acknowledged by the owner on" in done.stdout
            early.says(noted)
            with RunningCommand("watch", *realm) as late:
                late.says(noted)
                assert not any(", active: " in line for line in late.lines)
            until(
                lambda: any(texts := shown()) and not texts[-1],
                "the viewer without it",
            )
            serving.ends_well()
        with (
            RunningCommand(*serve) as serving,
            RunningCommand("watch", *realm) as late,
        ):  # over a restart, too
            late.says(noted)
            serving.ends_well()
        assert not any("bridge-2" in line for line in early.lines)
        publisher.close()
        early.ends_well()
        view.ends_well()


def test_a_history_that_is_away_for_a_while_ends_nothing(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    """As a folder of another machine is."""
    history = tmp_path / "history"
    make_folder(history / "crossings")
    start_logger(start, endpoint, tmp_path / "live.mcap")
    serve = ["alarm", "serve", "--history", str(history), "--endpoint", endpoint]
    with RunningCommand(*serve, "--every", "0.01") as serving:
        assert serving.says("^ready").endswith(" every 0.01 min")
        until((history / "alarms/checked.json").exists, "the first look")
        history.rename(tmp_path / "away")
        serving.says(r"history: no such folder.*; checking again in 1 s$")
        (tmp_path / "away/alarms/checked.json").unlink()
        (tmp_path / "away").rename(history)
        until((history / "alarms/checked.json").exists, "the next look")
        serving.ends_well()
