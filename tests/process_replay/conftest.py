"""Real processes with real Zenoh sessions on loopback."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.signals import (
    CHANNELS,
    AccelBatch,
    AccelChannel,
    GnssFix,
    VehicleInfo,
    encode_accel,
    encode_gnss,
    encode_info,
    encode_location,
)
from schemas.site_file import site_toml
from schemas.topics import Key, Message
from services.recordings.writer import write_recording
from services.simulation.drive import paper_site
from tests import prepared
from tests.process_replay.starting import End, Process, Start
from tests.waiting import LONGEST_S

# Runs one entry function as the command line would: exit code 2 for bad input, 1 for a failure.
_RUNNER = """
import importlib, json, logging, sys
from pathlib import Path
from services.common.errors import FailureError, InputError
logging.basicConfig(level=logging.INFO, stream=sys.stderr)
module, arguments = sys.argv[1], json.loads(sys.argv[2])
for name in ("folder", "file", "site", "recording"):
    if arguments.get(name) is not None:
        arguments[name] = Path(arguments[name])
if "recordings" in arguments:
    arguments["recordings"] = [Path(path) for path in arguments["recordings"]]
SETTINGS = {
    "services.logger": "LoggerSettings",
    "services.replay": "ReplaySettings",
    "services.truck": "TruckSettings",
    "services.worker": "WorkerSettings",
}
if module == "services.logger":
    arguments["ready"] = lambda: print("ready", flush=True)
try:
    run = importlib.import_module(f"{module}.run").run
    if module in SETTINGS:
        made_of = getattr(importlib.import_module(f"{module}.settings"), SETTINGS[module])
        asked = {n: arguments.pop(n) for n in made_of.__dataclass_fields__ if n in arguments}
        sys.exit(run(made_of(**asked), **arguments))
    sys.exit(run(**arguments))
except InputError as error:
    sys.exit(print(error, file=sys.stderr) or 2)
except FailureError as error:
    sys.exit(print(error, file=sys.stderr) or 1)
"""


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a service in a process of its own; all are ended with the test."""
    started: list[Process] = []

    def start_one(module: str, **arguments: Any) -> Process:
        process = prepared.Popen(
            [sys.executable, "-c", _RUNNER, module, json.dumps(arguments, default=str)],
            has_server=module == "services.worker",
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        started.append(process)
        if module == "services.logger":
            assert process.stdout is not None
            line = process.stdout.readline()
            if line != "ready\n":
                pytest.fail(f"logger did not start: {process.communicate()[1]}")
        return process

    yield start_one
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def finish() -> End:
    """Wait for a process that ends by itself; fail with its log if it did not end well."""

    def wait(process: Process) -> None:
        _, log = process.communicate(timeout=LONGEST_S)
        assert process.returncode == 0, log

    return wait


@pytest.fixture
def terminate() -> End:
    """End a service as an operator would."""

    def end(process: Process) -> None:
        os.kill(process.pid, signal.SIGTERM)
        _, log = process.communicate(timeout=LONGEST_S)
        assert process.returncode == 0, log

    return end


def drive(
    batches: int = 200, vehicle: str = "truck-1", boot_id: int = 77, large_from: int | None = None
) -> Iterator[Message]:
    """A truck with every vehicle stream: 50 ms batches of four channels, a fix every 100 ms.

    From batch `large_from` on at 50 kHz instead of 1 kHz: 80 KB each.
    """
    rng = np.random.default_rng(1)
    start_ns = 1_700_000_000_000_000_000

    def message(stream: str, payload: bytes, sequence: int, time_ns: int) -> Message:
        where = Key("sim-test", "vehicle", vehicle, stream)
        return Message(where, payload, boot_id, sequence, time_ns, time_ns)

    info = VehicleInfo(boot_id, 0, 5, start_ns, vehicle, '[vehicle]\nid = "truck-1"\n')
    yield message("info", encode_info(info), 0, start_ns)
    for number in range(batches):
        device_ns = 5 + number * 50_000_000
        time_ns = start_ns + number * 50_000_000
        count = 50 if large_from is None or number < large_from else 2500
        channels = {
            name: AccelChannel(20.0 * count, rng.standard_normal(count)) for name in CHANNELS
        }
        batch = AccelBatch(boot_id, number, device_ns, time_ns, channels)
        yield message("accel", encode_accel(batch), number, time_ns)
        if number % 2 == 0:
            fix = GnssFix(
                boot_id, number // 2, device_ns, time_ns, 50 + number * 5e-6, 8.0, 100.0, 10.0
            )
            yield message("gnss", encode_gnss(fix), number // 2, time_ns)
            yield message("location", encode_location(fix), number // 2, time_ns)


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Of the paper's truck and bridge."""
    path = tmp_path / "site.toml"
    path.write_text(site_toml(paper_site()))
    return path


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """10 s of one truck: 1 info, 200 accel, 100 gnss, 100 location."""
    path = tmp_path / "drive.mcap"
    write_recording(path, drive(), site_toml=None, reason="test")
    return path


@pytest.fixture
def drive_messages() -> Callable[..., Iterator[Message]]:
    return drive
