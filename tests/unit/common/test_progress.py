"""Bars: what they receive, and that there are sparse lines instead without a terminal."""

import io
import logging
from pathlib import Path

import pytest
from rich.console import Console

from schemas.settings import IdentificationSettings
from schemas.site_file import load_site
from services.catalogue.contents import summarise_recording
from services.common.log_lines import configure_logging, progress_log
from services.common.progress import parts_bar, reading_bar, steps_bar
from services.drives.importing import import_command
from services.drives.settings import ImportOptions
from services.drives.signals import signals_of_recording
from services.execution.offline import site_of
from services.identification.bridge_state import RecentCrossings, add_crossings, state_of, usable
from services.recordings.recovery import recover_recording
from services.recordings.writer import write_recording
from services.report.bridge import bridge_reports
from services.report.page import page
from services.report.pdf import write_pdf
from services.viewer.pictures import write_pictures
from services.viewer.view import convert
from tests.identifications import identify_recordings
from tests.unit.drives.recorded import drive
from tests.unit.viewer.found import results_of, some_crossing


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "r.mcap"
    write_recording(path, drive(), site_toml=None, reason="test")
    return path


@pytest.mark.parametrize("work", ["survey", "signals", "recover", "view"])
def test_reading_a_recording_reports_progress(recording: Path, work: str) -> None:
    reported: list[int] = []
    out = recording.with_name("out")
    match work:
        case "survey":
            summarise_recording(recording, progress=reported.append)
        case "signals":
            signals_of_recording(recording, reported.append)
        case "recover":
            recover_recording(recording, out.with_suffix(".mcap"), progress=reported.append)
        case "view":
            convert(recording, out.with_suffix(".rrd"), progress=reported.append)
    assert reported == sorted(set(reported))
    assert len(reported) > 5
    assert 0.8 * recording.stat().st_size < reported[-1] <= recording.stat().st_size


def test_a_bar_goes_over_all_files(tmp_path: Path) -> None:
    files = [tmp_path / "a", tmp_path / "b"]
    for file in files:
        file.write_bytes(bytes(100))
    shown = io.StringIO()
    terminal = Console(file=shown, force_terminal=True, width=80, color_system=None)
    with reading_bar("reading", files, terminal) as next_file:
        first = next_file()
        first(100)
        second = next_file()
        second(50)
    # Three quarters of a bar of 40 characters, when it is drawn at last.
    last = [line for line in shown.getvalue().split("\r") if "reading" in line][-1]
    assert last.count("━") == 30
    assert ":" in last  # the time that is left


def test_nothing_is_seen_where_there_is_no_terminal(tmp_path: Path) -> None:
    shown = io.StringIO()
    with reading_bar("reading", [tmp_path / "missing"], Console(file=shown)) as next_file:
        next_file()(10)
    assert shown.getvalue() == ""


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the time of the bars in s, the only item of a list."""
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def test_steps_without_a_terminal_are_a_start_and_sparse_lines(
    clock: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, progress_log.name)
    start = "validating {steps} crossings"
    with steps_bar("crossings", Console(file=io.StringIO()), start) as progress:
        progress(5, 205)
        assert caplog.messages == ["validating 200 crossings"]
        for done in range(6, 206):
            clock[0] += 20.0
            progress(done, 205)
    begin, *lines = caplog.messages
    assert begin == "validating 200 crossings"
    assert lines[:2] == [
        "crossings, 3 % after 40 s, about 66 min left",
        "crossings, 4 % after 80 s, about 65 min left",
    ]
    assert 20 < len(lines) < 40  # of 4000 s


@pytest.mark.parametrize(
    ("steps", "left"), [(4, "about 80 s left"), (8, "about 4 min left"), (300, "about 3.3 h left")]
)
def test_lines_state_the_remaining_time(
    clock: list[float], caplog: pytest.LogCaptureFixture, steps: int, left: str
) -> None:
    caplog.set_level(logging.INFO, progress_log.name)
    with steps_bar("crossings", Console(file=io.StringIO())) as progress:
        progress(0, steps)
        clock[0] += 80.0
        progress(2, steps)
    (line,) = caplog.messages
    assert line.endswith(f"after 80 s, {left}")


def test_steps_on_a_terminal_write_no_lines(
    clock: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, progress_log.name)
    terminal = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    with steps_bar("crossings", terminal, "validating {steps} crossings") as progress:
        clock[0] += 100.0
        progress(1, 2)
    assert caplog.messages == []


def test_commands_log_progress_and_otherwise_warnings(capsys: pytest.CaptureFixture[str]) -> None:
    before = logging.getLogger().handlers[:], logging.getLogger().level, progress_log.level
    try:
        configure_logging("text", logging.WARNING, {})
        progress_log.info("crossings, 3 %% after %d s", 40)
        logging.getLogger("other").info("detail")
    finally:
        logging.getLogger().handlers[:], logging.getLogger().level = before[:2]
        progress_log.setLevel(before[2])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("INFO driveby.progress: crossings, 3 % after 40 s")


def test_steps_are_a_bar_with_the_time_that_is_left() -> None:
    shown = io.StringIO()
    terminal = Console(file=shown, force_terminal=True, width=80, color_system=None)
    with steps_bar("drawing", terminal) as progress:
        progress(0, 4)
        progress(3, 4)
    last = [line for line in shown.getvalue().split("\r") if "drawing" in line][-1]
    assert last.count("━") == 30
    assert ":" in last


@pytest.mark.parametrize("work", ["view", "pictures", "report", "import"])
def test_each_step_is_reported_up_to_the_last(
    work: str, recording: Path, tmp_path: Path, project: Path
) -> None:
    reported: list[tuple[int, int]] = []

    def progress(done: int, steps: int) -> None:
        reported.append((done, steps))

    site = load_site(project / "docs/site.example.toml")
    found = results_of(site, some_crossing("a"), some_crossing("b", entry=60.0), used="a")
    match work:
        case "view":
            convert(recording, tmp_path / "r.rrd", drawing=progress)
        case "pictures":
            write_pictures(tmp_path, found, site, progress)
        case "report":
            page(bridge_reports([(tmp_path / "x.json", found, site)], None), progress)
        case "import":
            example = project / "tests/data/csv_example"
            import_command(
                ImportOptions(sources=(example,), site=example / "site.toml"),
                tmp_path / "i.mcap",
                writing=progress,
            )
    done, steps = zip(*reported, strict=True)
    assert len(set(steps)) == 1
    assert list(done) == sorted(set(done))
    assert len(done) > 1
    assert done[-1] == steps[0]


def last_drawn(shown: io.StringIO, word: str) -> str:
    return [line for line in shown.getvalue().split("\r") if word in line][-1]


def test_parts_are_a_bar_that_moves_within_each_and_never_back() -> None:
    shown = io.StringIO()
    terminal = Console(file=shown, force_terminal=True, width=120, color_system=None)
    with parts_bar("crossing", 4, terminal) as report:
        report("a", "finding the truck", 0.0)
        report("a", "done", 1.0)
        report("b", "freeing the elements", 0.5)
        report("b", "finding the truck", 0.1)  # in another way
    last = last_drawn(shown, "crossing")
    assert "crossing 2 of 4: finding the truck" in last
    assert last.count("━") == 15  # one part and a half of four, of 40 characters
    assert ":" in last.partition("truck")[2]  # the time that is left


def test_unknown_number_of_parts_shows_no_remaining_time() -> None:
    shown = io.StringIO()
    terminal = Console(file=shown, force_terminal=True, width=120, color_system=None)
    with parts_bar("crossing", 0, terminal) as report:
        report("a", "done", 1.0)
        report("b", "half", 0.5)
    last = last_drawn(shown, "crossing")
    assert "crossing 2: half" in last
    assert ":" not in last.partition("half")[2]


def test_crossing_reports_progress_up_to_the_end(project: Path) -> None:
    reported: dict[str, list[float]] = {}
    stages: list[str] = []

    def report(crossing_id: str, stage: str, fraction: float) -> None:
        reported.setdefault(crossing_id, []).append(fraction)
        stages.append(stage)

    sample = project / "recordings/sample/crossing.mcap"
    settings = IdentificationSettings(method="pre", seed=1)
    found = identify_recordings([sample], site_of([sample], None), settings, report)
    ((crossing_id, fractions),) = reported.items()
    assert crossing_id == found.crossings[0].crossing_id
    assert fractions[-1] == 1.0
    assert len(set(fractions)) > 4
    assert all(0.0 <= fraction <= 1.0 for fraction in fractions)
    assert stages[-1] == "done"
    of_bridge: list[float] = []
    counted = add_crossings(
        RecentCrossings(), [one for one in map(usable, found.crossings) if one is not None]
    )
    state_of(counted, "bridge", report=lambda stage, fraction: of_bridge.append(fraction))
    assert of_bridge == sorted(of_bridge)
    assert len(set(of_bridge)) > 4
    assert 0.0 <= of_bridge[0] < of_bridge[-1] < 1.0


def test_progress_shows_the_share_of_the_usual_time(tmp_path: Path) -> None:
    """A browser that waits for a signal to go on, and then prints."""
    reported: list[tuple[int, int]] = []
    go = tmp_path / "go"
    browser = tmp_path / "browser"
    browser.write_text(
        "#!/bin/sh\n"
        f"while [ ! -e {go} ]; do sleep 0.05; done\n"
        'for one in "$@"; do case "$one" in --print-to-pdf=*) '
        'printf %%PDF > "${one#--print-to-pdf=}";; esac; done\n'
    )
    browser.chmod(0o755)
    html = tmp_path / "r.html"
    html.write_text("<p>")

    def progress(done: int, steps: int) -> None:
        reported.append((done, steps))
        if len(reported) == 4:
            go.touch()

    write_pdf(html, tmp_path / "r.pdf", str(browser), progress)
    done, steps = zip(*reported, strict=True)
    assert list(done) == sorted(done)
    assert done[0] < done[-1] <= steps[0]
    assert set(steps) == {1500}
    assert (tmp_path / "r.pdf").read_bytes() == b"%PDF"
