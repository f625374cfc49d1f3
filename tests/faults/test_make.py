"""`make faults` and `make soak`: what they run, and that nothing of it is left behind."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.parent import PARENT_ENV
from tests.waiting import LONGEST_S, until


def arguments_of(project: Path, target: str) -> list[str]:
    """What the target gives to pytest."""
    rule = re.search(
        rf"^{target}:.*\n((?:\t.*\n)+)", (project / "Makefile").read_text(), re.MULTILINE
    )
    assert rule is not None
    return shlex.split(rule[1].strip().rpartition("-m pytest ")[2])


COLLECT = """
import json
import sys

import pytest

for arguments in json.loads(sys.argv[1]):
    code = pytest.main([*arguments, "--collect-only", "-q"])
    print("exit code", int(code), flush=True)
"""


def collected(project: Path, *selections: list[str]) -> list[set[str]]:
    """What each selection collects, in one process: most of the time is the first's imports."""
    done = subprocess.run(
        [sys.executable, "-c", COLLECT, json.dumps(selections)],
        cwd=project, capture_output=True, text=True, timeout=LONGEST_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *parts, end = done.stdout.split("exit code 0\n")
    assert (len(parts), end) == (len(selections), ""), done.stdout
    return [{line for line in part.splitlines() if "::" in line} for part in parts]


def test_faults_runs_everything_but_the_soak(project: Path) -> None:
    faults, soak, every = collected(
        project,
        arguments_of(project, "faults"),
        arguments_of(project, "soak"),
        ["tests/faults", "-m", "soak or not soak"],
    )
    assert {name.partition("::")[2].partition("[")[0] for name in soak} == {
        "test_killed_fifty_times",
        "test_an_hour_at_the_rated_load",
        "test_truck_silent_for_over_an_hour_is_fetched_from_its_spool",
    }
    assert not faults & soak
    assert faults | soak == every


def session_of(number: int) -> Iterator[tuple[int, str]]:
    """Process and program of all that live in a session of processes.

    A forked one (`tests.prepared`) has the command line of another, and a name of its own.
    """
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
            program = (stat.parent / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            program += (stat.parent / "comm").read_text()
        except OSError:
            continue
        if int(fields[3]) == number and fields[0] != "Z":
            yield int(stat.parent.name), program


def hear_ctrl_c() -> None:
    """What a shell starts in the background ignores Ctrl-C, and hands that on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.process
@pytest.mark.faults
@pytest.mark.parametrize("how", ["Ctrl-C", "kill -9"])
def test_what_interrupts_the_tests_ends_their_processes(
    project: Path, tmp_path: Path, how: str
) -> None:
    """While one truck is frozen, which hears no signal that asks it to end."""
    test = "tests/faults/test_nothing_lost.py::test_a_frozen_truck_delays_no_other[False]"
    environment = {name: text for name, text in os.environ.items() if name != PARENT_ENV}
    tests = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-m", "not soak", f"--basetemp={tmp_path / 'run'}", test],
        cwd=project, env=environment, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, preexec_fn=hear_ctrl_c,
    )  # fmt: skip
    try:
        until(
            lambda: (
                tests.poll() is not None
                or sum("truck_process" in program for _, program in session_of(tests.pid)) >= 3
            ),
            "three trucks",
        )
        assert tests.poll() is None
        if how == "Ctrl-C":  # pressed again, because it takes long
            os.killpg(tests.pid, signal.SIGINT)
            time.sleep(0.2)
            os.killpg(tests.pid, signal.SIGINT)
        else:
            tests.kill()
        tests.wait(timeout=LONGEST_S)
        until(lambda: not list(session_of(tests.pid)), "the end of all processes")
    finally:
        for process, _ in session_of(tests.pid):
            os.kill(process, signal.SIGKILL)
        tests.wait()
