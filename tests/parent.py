"""Processes that tests start end with the test run, however that ends."""

import ctypes
import os
import signal

PARENT_ENV = "DRIVEBY_TEST_PARENT"
_PR_SET_PDEATHSIG = 1


def parent_environment() -> dict[str, str]:
    """What `die_with_parent` in the process to be started must know of this one."""
    return {PARENT_ENV: str(os.getpid())}


def die_with_parent() -> None:
    """Let Linux kill this process, frozen or not, when the one that has started it ends.

    Fixtures end what they started, too, but not after `kill -9`, nor when Ctrl-C is pressed again
    because ending them takes long. Does nothing in a process that no test has started.
    """
    parent = os.environ.get(PARENT_ENV)
    if parent is None:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")
    if os.getppid() != int(parent):  # it was gone before it could be asked for
        os._exit(1)
