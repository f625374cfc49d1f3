"""Processes of a pool end with their parent, however that ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.waiting import until

PROGRAM = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from services.common.child_process import end_with_parent

def busy():
    print(os.getpid(), flush=True)
    time.sleep(3600.0)

if __name__ == "__main__":
    with ProcessPoolExecutor(1, get_context({context!r}), end_with_parent) as pool:
        pool.submit(busy).result()
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
        path.write_text(PROGRAM.format(context=context))
        with subprocess.Popen(
            [sys.executable, str(path)], stdout=subprocess.PIPE, text=True
        ) as parent:
            assert parent.stdout is not None
            child = int(parent.stdout.readline())
            parent.send_signal(signal.SIGKILL)
        until(lambda child=child: not is_running(child), f"the end of the {context} process")
