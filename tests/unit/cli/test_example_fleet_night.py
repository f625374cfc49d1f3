"""The rehearsal of docs/examples/fleet_night raises the alarm that its page promises."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from services.history.alarm_files import active_alarms


@pytest.mark.slow
@pytest.mark.process
def test_nights_after_a_loss_of_stiffness_raise_an_alarm(project: Path, tmp_path: Path) -> None:
    name = Path("docs/examples/fleet_night")
    page = (project / name / "README.md").read_text()
    commands = "\n".join(re.findall(r"```sh\n(.*?)```", page, re.DOTALL))
    shutil.copytree(project / name, tmp_path / name)
    shutil.copy(project / "docs" / "site.example.toml", tmp_path / "docs")
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", "-eu", "-c", commands],
        cwd=tmp_path,
        env=os.environ | {"PATH": programs},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    (alarm,), problems = active_alarms(tmp_path / "history")
    assert (alarm.bridge, alarm.element, problems) == ("bridge-1", 4, [])
    assert alarm.direction == "weaker"
    assert alarm.ratio == pytest.approx(0.7, abs=0.06)
    assert "element 4 is " in done.stdout
    assert list((tmp_path / "figures").glob("*.png"))
    again = subprocess.run(
        [
            "sh",
            name / "night.sh",
            "recordings",
            "docs/site.example.toml",
            "temperatures.csv",
            "day",
        ],
        cwd=tmp_path,
        env=os.environ | {"PATH": programs},
        capture_output=True,
        text=True,
    )
    assert again.returncode == 0, again.stderr
    assert "12 crossings, 12 from earlier runs" in again.stdout


@pytest.mark.parametrize(("code", "commands"), [(0, 4), (3, 4), (1, 2), (2, 2)])
def test_a_night_with_losses_still_checks_for_alarms(
    project: Path, tmp_path: Path, code: int, commands: int
) -> None:
    """A cut-off recording must not keep the other bridges from being watched."""
    stub = tmp_path / "driveby"
    stub.write_text(f'#!/bin/sh\necho "$1" >> called\n[ "$1" != identify ] || exit {code}\n')
    stub.chmod(0o755)
    done = subprocess.run(
        ["sh", project / "docs/examples/fleet_night/night.sh", "r", "s.toml", "-"],
        cwd=tmp_path,
        env=os.environ | {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"},
    )
    assert done.returncode == code
    called = (tmp_path / "called").read_text().split()
    assert called == ["catalog", "identify", "history", "alarm"][:commands]


def night_with_stub(project: Path, folder: Path, *words: str) -> tuple[int, str, list[str]]:
    """Run a night whose commands only record their arguments: code, errors, commands."""
    stub = folder / "driveby"
    stub.write_text('#!/bin/sh\necho "$*" >> called\n')
    stub.chmod(0o755)
    called = folder / "called"
    called.write_text("")
    done = subprocess.run(
        ["sh", project / "docs/examples/fleet_night/night.sh", *words],
        cwd=folder,
        env=os.environ | {"PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stderr, called.read_text().splitlines()


def test_night_adds_results_of_workers(project: Path, tmp_path: Path) -> None:
    """Where a budget has deleted the recordings, only the worker's results are left."""
    for name in ("live", "sim one", "certificates"):
        (tmp_path / "r" / name).mkdir(parents=True)
    for path in ("live/results-1.json", "live/results-2.json", "sim one/results-1.json"):
        (tmp_path / "r" / path).write_text("{}")
    (tmp_path / "t.csv").write_text("time_s,temperature_deg_c\n")
    code, _, called = night_with_stub(project, tmp_path, "r", "s.toml", "t.csv", "day")
    assert code == 0
    assert called[2:] == [
        "history add identified r/live r/sim one --temperature t.csv",
        "alarm check --period day",
    ]


@pytest.mark.parametrize("words", [(), ("-",)])
def test_night_needs_no_temperatures(project: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    code, _, called = night_with_stub(project, tmp_path, "s3://bucket/r", "s.toml", *words)
    assert code == 0
    assert called[2:] == ["history add identified", "alarm check --period week"]


def test_night_checks_the_temperatures_first(project: Path, tmp_path: Path) -> None:
    code, errors, called = night_with_stub(project, tmp_path, "r", "s.toml", "t.csv")
    assert (code, called) == (2, [])
    assert errors == "night.sh: t.csv: cannot be read; - stands for no temperatures\n"
    assert night_with_stub(project, tmp_path, "r")[::2] == (2, [])
