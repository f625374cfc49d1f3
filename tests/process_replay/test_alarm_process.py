"""`driveby alarm serve` as a process: latched on the bus, over a restart, until acknowledged."""

import signal
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zenoh

from schemas.alarms import Alarm
from schemas.proto import driveby_pb2 as pb
from schemas.topics import key
from services.bus.session import open_session
from services.cli import main as cli
from services.common.files import make_folder, write_atomically
from services.history.alarm_files import alarms_folder
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


def told(session: zenoh.Session) -> list[pb.Alarm]:
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
                until(lambda: told(router), "the alarm")
                (message,) = told(router)
                assert (message.alarm_id, message.is_acknowledged) == (ALARM.alarm_id, False)
                assert message.text == ALARM.sentence()
                ended(processes[-1])
            processes.append(serving(history, endpoint))
            until(lambda: told(router), "the alarm")
            words = ["alarm", "ack", "bridge-2", "--by", "owner", "--note", "props were put in"]
            assert cli.main([*words, "--history", str(history)]) == 0
            until(lambda: [m for m in told(router) if m.is_acknowledged], "its acknowledgement")
            (message,) = told(router)
            assert (message.acknowledged_by, message.note) == ("owner", "props were put in")
            ended(processes[-1])
        finally:
            for process in processes:
                process.kill()
                process.wait()
