"""`driveby demo`, as a newcomer runs it: what it prints, what it leaves, how it fails."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.request import urlopen

import numpy as np
import pytest
from matplotlib.image import imread
from rerun.chunk import RrdReader

from schemas.results import load_results
from schemas.signals import CHANNELS, decode_accel
from services.cli import main as cli
from services.drives.runs import run_to_messages
from services.recordings.recording import read_info, read_messages
from services.simulation.drive import DrivenRoad, Measurement, paper_site, simulate_drive
from tests.builders.commands import run
from tests.waiting import LONGEST_S, until

# They share one demo.
pytestmark = [pytest.mark.process, pytest.mark.xdist_group("demo")]

RATIOS = [1.0, 1.0, 1.0, 0.4, 1.0, 1.0, 1.0]
NOISE_UG = 25.0
FILES = ["demo.png", "demo.rrd", "recording.mcap", "results.json", "results.mcap"]


class Demo(NamedTuple):
    folder: Path
    code: int
    out: str
    err: str


def command(folder: Path) -> list[str]:
    return [sys.executable, "-m", "services", "demo", "--out", str(folder), "--speed", "8"]


def processes_of(folder: Path) -> dict[int, str]:
    """Ids and command lines of the processes that were started for a demo."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:  # it has ended meanwhile
                continue
            if str(folder) in line and int(entry.name) != os.getpid():
                found[int(entry.name)] = line
    return found


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory, project: Path) -> Demo:
    folder = tmp_path_factory.mktemp("demo") / "new" / "demo"
    environment = {**os.environ, "PYTHONPATH": str(project), "COLUMNS": "120"}
    done = subprocess.run(
        command(folder),
        cwd=folder.parents[1],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST_S,
    )
    return Demo(folder, done.returncode, done.stdout, done.stderr)


ROW = re.compile(r"EI_(\d) \D*([\d.]+) \D*([\d.]+) \D*([\d.]+) … ([\d.]+) \D*(yes|no)")


def test_demo_prints_truth_estimate_and_interval(demo: Demo) -> None:
    assert (demo.code, demo.err) == (0, "")
    rows = ROW.findall(demo.out)
    assert [(number, float(truth)) for number, truth, *_ in rows] == [
        (str(n), 0.4 if n == 4 else 1.0) for n in range(1, 8)
    ]
    for _, truth, estimate, low, high, holds in rows:
        assert float(low) < float(estimate) < float(high)
        assert (holds == "yes") == (float(low) <= float(truth) <= float(high))
    assert rows[3][-1] == "yes"
    assert "A 95 % interval contains the truth in 95 of 100 cases.\n" in demo.out
    assert "verdict good" in demo.out
    assert all(name in demo.out for name in FILES)


def test_the_numbers_are_those_of_the_bridge(demo: Demo) -> None:
    """With the noise of real sensors: the weak element within its interval, all within reason."""
    found = load_results(demo.folder / "results.json")
    (crossing,) = found.crossings
    assert (crossing.method, crossing.verdict, crossing.reasons) == ("pre", "good", ())
    assert crossing.parameters is not None
    weak = crossing.parameters["EI_4"]
    assert weak.q025 < 0.4 * 1.56e10 < weak.q975
    assert weak.q975 - weak.q025 < 0.1 * 1.56e10
    for number, ratio in enumerate(RATIOS, start=1):
        p = crossing.parameters[f"EI_{number}"]
        assert abs(p.mean - ratio * 1.56e10) < 4.0 * p.std, number
    assert (crossing.realm, crossing.vehicle, crossing.bridge) == (
        "sim-demo",
        "truck-1",
        "bridge-1",
    )
    assert crossing.speed_m_per_s == pytest.approx(10.0, rel=0.01)


def test_nothing_else_is_left(demo: Demo) -> None:
    assert sorted(path.name for path in demo.folder.iterdir()) == FILES
    root = demo.folder.parents[1]
    assert sorted(p.name for p in root.rglob("*") if p.is_file()) == FILES
    assert processes_of(demo.folder) == {}


def test_the_recording_is_what_the_truck_measured(demo: Demo) -> None:
    """Noise and errors of the receiver come from the seed, so the drive can be driven again."""
    drive = simulate_drive(
        paper_site(),
        np.array(RATIOS),
        DrivenRoad("A", 1),
        Measurement(NOISE_UG, has_receiver_errors=True),
    )
    messages = list(read_messages(demo.folder / "recording.mcap"))
    sent = list(run_to_messages([drive.run], paper_site(), "x", "truck-1"))
    ours = [m for m in messages if m.key.owner == "vehicle"]
    assert sorted(m.key.stream for m in ours) == sorted(m.key.stream for m in sent)
    for one, other in zip(
        sorted((m for m in ours if m.key.stream == "accel"), key=lambda m: m.sequence),
        (m for m in sent if m.key.stream == "accel"),
        strict=True,
    ):
        recorded, measured = decode_accel(one.payload), decode_accel(other.payload)
        for name in CHANNELS:
            # The coupled iteration stops at a tolerance: sums in another order show there.
            np.testing.assert_allclose(
                recorded.channels[name].samples,
                measured.channels[name].samples,
                rtol=0,
                atol=1e-6,
            )
    # The results went over the same bus.
    assert {"crossing", "estimate", "state"} <= {m.key.stream for m in messages}
    info = read_info(demo.folder / "recording.mcap")
    assert info.end is not None
    assert (info.truncated, info.damaged_chunks, info.end["lost"]) == (False, 0, "0")
    estimate = [m.payload for m in messages if m.key.stream == "estimate"]
    results = list(read_messages(demo.folder / "results.mcap"))
    assert [m.payload for m in results if m.key.stream == "estimate"] == estimate


def test_the_pictures_open(demo: Demo) -> None:
    picture = imread(demo.folder / "demo.png")
    assert picture.shape[0] > 400
    assert picture.shape[1] > 600
    assert np.std(picture[..., :3]) > 0.05
    paths = {str(chunk.entity_path) for chunk in RrdReader(demo.folder / "demo.rrd").stream()}
    for part in ("acceleration/sprung_front", "road/front", "rigidity"):
        assert any(part in path for path in paths), paths


def test_its_recording_is_identified_again_to_the_same(
    demo: Demo, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = tmp_path / "again.json"
    recording = demo.folder / "recording.mcap"
    assert cli.main(["identify", str(recording), "--json", str(again)]) == 0
    before, after = load_results(demo.folder / "results.json"), load_results(again)
    (one,), (other,) = before.crossings, after.crossings
    assert one.parameters == other.parameters
    assert (one.crossing_id, one.entry_time) == (other.crossing_id, other.entry_time)
    assert before.site_hash == after.site_hash


def test_a_folder_that_exists_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "kept").write_text("kept")
    done = run(capsys, "demo", "--out", tmp_path)
    assert done.code == 2
    assert done.err == f"driveby: {tmp_path}: exists, the demo needs a new folder\n"
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


@pytest.fixture
def running(tmp_path: Path, project: Path) -> Iterator[subprocess.Popen[str]]:
    """A demo whose worker is about to start or has started."""
    folder = tmp_path / "demo"
    process = subprocess.Popen(
        command(folder), cwd=project, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:

        def has_a_worker() -> bool:
            assert process.poll() is None, process.communicate()
            return any(" services worker " in line for line in processes_of(folder).values())

        # Looking through all processes takes a processor: only when it is about to start.
        log = folder / "worker.log"
        until(lambda: log.exists() or process.poll() is not None, "the log of the worker")
        until(has_a_worker, "the demo's worker")
        yield process
    finally:
        for pid in (process.pid, *processes_of(folder)):
            if pid != process.pid or process.poll() is None:
                os.kill(pid, signal.SIGKILL)
        process.communicate()


def test_a_worker_that_is_killed(running: subprocess.Popen[str], tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    (worker,) = [pid for pid, line in processes_of(folder).items() if " services worker " in line]
    os.kill(worker, signal.SIGKILL)
    _, err = running.communicate(timeout=LONGEST_S)
    assert running.returncode == 1
    assert re.fullmatch(r"driveby: the worker ended early: [^\n]+\n", err)
    assert processes_of(folder) == {}
    # What may explain it is left.
    assert (folder / "worker.log").is_file()


def test_demo_ends_on_request(running: subprocess.Popen[str], tmp_path: Path) -> None:
    running.terminate()
    _, err = running.communicate(timeout=LONGEST_S)
    assert (running.returncode, err) == (130, "driveby: interrupted\n")
    assert processes_of(tmp_path / "demo") == {}


def test_demo_with_open_viewer_stays_until_it_is_ended(tmp_path: Path, project: Path) -> None:
    """By exact sensors and least squares: how long the view stays depends on no method."""
    folder, log = tmp_path / "demo", tmp_path / "demo.log"
    # BROWSER: none of the machine's is to open.
    own = {**os.environ, "HOME": str(tmp_path), "BROWSER": "true", "PYTHONUNBUFFERED": "1"}
    address = re.compile(r"The live view stays until Ctrl-C, at (http://127\.0\.0\.1:\S+)\n")
    with log.open("wb") as output:
        arguments = [*command(folder), "--noise", "0", "--web"]
        demo = subprocess.Popen(arguments, cwd=project, env=own, stdout=output)
    try:
        until(lambda: address.search(log.read_text()) or demo.poll() is not None)
        found = address.search(log.read_text())
        assert found, log.read_text()
        with urlopen(found[1], timeout=LONGEST_S) as page:  # noqa: S310 - it begins with http
            assert b"Rerun" in page.read()
        demo.send_signal(signal.SIGINT)
        assert demo.wait(timeout=LONGEST_S) == 0
        until(lambda: processes_of(folder) == {}, "the end of all its processes")
        assert sorted(path.name for path in folder.iterdir()) == FILES
    finally:
        demo.kill()
        demo.wait()
