"""`driveby view live` as a process: a viewer that comes late sees what there was before."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from schemas.results import ResultHeader
from schemas.results_on_the_wire import crossing_to_protobuf
from schemas.signals import CHANNELS, AccelBatch, AccelChannel, GnssFix, encode_accel, encode_gnss
from schemas.site_file import load_site
from services.bus.publisher import Publisher
from services.bus.session import open_session
from tests.endpoints import free_port
from tests.process_replay.starting import Start, start_logger
from tests.unit.viewer.found import results_of, some_crossing
from tests.unit.viewer.test_web import browser
from tests.viewer_screen import complaints, opened, pixels
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process

BEGIN_NS = 1_790_000_000_000_000_000
WEAK = np.array([230, 159, 0]) / 255.0


@pytest.fixture
def view(endpoint: str, project: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """It is started before there is a router."""
    command = [
        sys.executable, "-m", "driveby", "view", "live", "--serve", "--endpoint", endpoint,
        "--site", str(project / "docs/site.example.toml"),
    ]  # fmt: skip
    own = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        command, env=own, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def address_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    found = re.fullmatch(r"realm live, live at (\S+); more viewers: rerun \1\n", line)
    assert found, line + process.communicate()[1]
    return found[1]


def listening(port: int) -> set[str]:
    """The addresses, in hexadecimal, at which somebody listens at a port."""
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    lines += [line.split() for line in Path("/proc/net/tcp6").read_text().splitlines()[1:]]
    ends = [line[1].split(":") for line in lines if line[3] == "0A"]
    return {address for address, of in ends if int(of, 16) == port}


def drive(publisher: Publisher, project: Path) -> None:
    """Two seconds of a truck at the bridge, and a result."""
    for number in range(40):
        when = number * 50_000_000, BEGIN_NS + number * 50_000_000
        samples = np.sin(np.arange(50) / 5.0)
        channels = {name: AccelChannel(1000.0, samples) for name in CHANNELS}
        payload = encode_accel(AccelBatch(1, number, *when, channels))
        publisher.put("vehicle", "truck-1", "accel", payload)
        place = 36.1106 + 3e-6 * number, 140.1010 + 7e-6 * number
        payload = encode_gnss(GnssFix(1, number, *when, *place, 24.0, 10.0))
        publisher.put("vehicle", "truck-1", "gnss", payload)
    found = results_of(load_site(project / "docs/site.example.toml"), some_crossing("a"))
    message = crossing_to_protobuf(found.crossings[0], ResultHeader("0.1.0", 1.79e9, "hash", {}, 1))
    publisher.put("bridge", "bridge-1", "estimate", message.SerializeToString())


def test_a_late_viewer_sees_what_there_was(
    view: subprocess.Popen[str], start: Start, endpoint: str, tmp_path: Path, project: Path
) -> None:
    address = address_of(view)
    port = int(re.findall(r":(\d+)/", address)[0])
    assert listening(port) == {"0100007F"}  # 127.0.0.1, no other interface
    start_logger(start, endpoint, tmp_path / "live.mcap")
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as bus:
        publisher = Publisher(bus, "live")
        drive(publisher, project)
        with opened(address, tmp_path, size="1200x800") as viewer:

            def is_weak_element_seen() -> bool:
                seen = pixels(viewer.take_screenshot())
                return bool((np.abs(seen - WEAK).max(axis=2) < 0.1).sum() > 50)

            until(is_weak_element_seen, "the weak element")
            names = {one.name for one in viewer.get_state().views}
            assert {"Crossings", "Newest result"} < names
            assert any(name.startswith("Plan (m), ") for name in names), "with its legend"
            assert any(name.startswith("truck-1: Axle") for name in names)
            assert complaints(viewer) == []
        publisher.close()
    view.send_signal(signal.SIGINT)
    _, err = view.communicate(timeout=LONGEST_S)
    assert view.returncode == 0, err
    assert "Traceback" not in err


def test_it_ends_where_no_router_ever_was(view: subprocess.Popen[str]) -> None:
    address_of(view)
    assert view.stderr is not None
    assert "no router answers at" in view.stderr.readline()
    view.terminate()
    _, err = view.communicate(timeout=LONGEST_S)
    assert (view.returncode, err) == (0, "")


def test_query_of_the_wrong_realm_is_explained(
    view: subprocess.Popen[str], start: Start, endpoint: str, tmp_path: Path
) -> None:
    address_of(view)
    start_logger(start, endpoint, tmp_path / "live.mcap")
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as bus:
        publisher = Publisher(bus, "replay-monday")
        publisher.put("vehicle", "truck-1", "info", b"")
        assert view.stderr is not None
        output = ""
        deadline = time.monotonic() + LONGEST_S
        while "nothing in realm" not in output and time.monotonic() < deadline:
            output = view.stderr.readline()
        assert output.endswith(
            "nothing in realm live, but truck-1 in replay-monday; use --realm replay-monday\n"
        )
        publisher.close()


def test_in_a_browser_until_it_is_closed(endpoint: str, tmp_path: Path) -> None:
    """The program that serves the pages ends with the command, and the command with it."""
    own = {**os.environ, "HOME": str(tmp_path), "BROWSER": "true", "NO_COLOR": "1"}
    command = [sys.executable, "-m", "driveby", "view", "live", "--web", "--endpoint", endpoint]
    command += ["--port", str(free_port())]
    log = tmp_path / "view.log"
    for end in ("viewer", "command"):
        with log.open("wb") as output:
            view = subprocess.Popen(command, env=own, stdout=output, stderr=output)
        try:
            until(lambda: re.search(r"in a browser: http://127.0.0.1:\d+\?url=", log.read_text()))
            until(partial(children, view.pid), "the viewer")
            (viewer,) = children(view.pid)
            os.kill(viewer if end == "viewer" else view.pid, signal.SIGTERM)
            assert view.wait(timeout=LONGEST_S) == 0, log.read_text()
            until(partial(has_ended, viewer), "the viewer's end")
        finally:
            view.kill()
            view.wait()


def test_it_is_seen_in_a_browser(
    start: Start, endpoint: str, tmp_path: Path, project: Path
) -> None:
    start_logger(start, endpoint, tmp_path / "live.mcap")
    own = {**os.environ, "HOME": str(tmp_path), "BROWSER": "true", "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "driveby", "view", "live", "--web", "--endpoint", endpoint]
    command += ["--site", str(project / "docs/site.example.toml")]
    log = tmp_path / "view.log"
    with browser(tmp_path) as tab, open_session(connect=endpoint, timeout_s=LONGEST_S) as bus:
        publisher = Publisher(bus, "live")
        drive(publisher, project)
        with log.open("wb") as output:
            view = subprocess.Popen(command, env=own, stdout=output, stderr=output)
        try:
            until(lambda: "in a browser: " in log.read_text())
            page = re.findall(r"in a browser: (\S+)", log.read_text())[0]
            port = int(re.findall(r":(\d+)\?", page)[0])
            until(lambda: listening(port) == {"0100007F"}, "the page")
            tab.open(f"{page}&renderer=webgl")

            def is_weak_element_seen() -> bool:
                seen = tab.screenshot()
                return bool((np.abs(seen - WEAK).max(axis=2) < 0.1).sum() > 50)

            until(is_weak_element_seen, "the weak element")
            assert tab.screenshot().mean() < 0.3  # dark, as its words want it
        finally:
            view.terminate()
            view.wait(timeout=LONGEST_S)
        publisher.close()


def has_ended(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


def children(pid: int) -> list[int]:
    """Processes that a process has started and that run the viewer."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
            line = (entry / "cmdline").read_bytes()
        except (OSError, IndexError):
            continue
        if parent == str(pid) and b"--serve-web" in line:
            found.append(int(entry.name))
    return found
