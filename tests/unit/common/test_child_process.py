"""Processes of a pool end with their parent, however that ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import LONGEST_S, until

PROGRAM = """
import os, time
from services.common.child_process import ChildPool

if {loading} and __name__ != "__main__":
    print(os.getpid(), flush=True)
    time.sleep(1.0)

def busy():
    print(os.getpid(), flush=True)
    time.sleep({seconds})

if __name__ == "__main__":
    try:
        with ChildPool(1, {context!r}) as pool:
            pool.submit(busy).result()
            time.sleep(3600.0)
    except KeyboardInterrupt:
        print("interrupted")
"""


def is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_busy_process_of_a_pool_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    for context in ("spawn", "forkserver"):
        path = tmp_path / f"{context}.py"
        path.write_text(PROGRAM.format(context=context, loading=False, seconds=3600.0))
        with subprocess.Popen(
            [sys.executable, str(path)], stdout=subprocess.PIPE, text=True
        ) as parent:
            assert parent.stdout is not None
            child = int(parent.stdout.readline())
            parent.send_signal(signal.SIGKILL)
        until(lambda child=child: not is_running(child), f"the end of the {context} process")


@pytest.mark.parametrize("context", ["spawn", "forkserver"])
@pytest.mark.parametrize(
    ("loading", "seconds"),
    [(True, 0.0), (False, 0.0), (False, 3600.0)],
    ids=["load", "idle", "busy"],
)
def test_interrupt_of_the_group_ends_a_pool_silently(
    tmp_path: Path, context: str, loading: bool, seconds: float
) -> None:
    path = tmp_path / "program.py"
    path.write_text(PROGRAM.format(context=context, loading=loading, seconds=seconds))
    with subprocess.Popen(
        [sys.executable, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        os.killpg(parent.pid, signal.SIGINT)
        output, log = parent.communicate(timeout=LONGEST_S)
    assert log == ""
    assert output.endswith("interrupted\n")
    until(lambda: not is_running(child), "the end of the process")
