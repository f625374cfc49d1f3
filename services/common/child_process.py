"""Modules run like `python -m`, in a process that ends with its parent.

    python -m services.common.child_process MODULE ARGUMENT…

Standard input is a pipe into which nothing is ever written. It ends when the parent closes it or
dies, however it dies. A child that survived would rename recordings which the next logger is about
to read. (Linux can kill a child with its parent, but takes the thread that started it for the
parent.)
"""

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from typing import NamedTuple, ParamSpec, TypeVar

from services.common.errors import EXIT_INTERRUPTED

_P = ParamSpec("_P")
_T = TypeVar("_T")
_CLEAN_UP_S = 2.0
"""Time to remove incomplete files; then the process ends in any case."""
_NO_WARNING = "ignore:resource_tracker"
_POLL_S = 0.1
"""Longest delay of the parent's end while a child works."""
_GROUP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that a terminal or supervisor sends to all processes of a service."""
_NICE = 15
"""Niceness of low-priority children."""


class ChildOutput(NamedTuple):
    """Exit code and output of a child that has ended."""

    code: int
    out: str
    log: str
    """Standard error."""


def run_gently(arguments: Sequence[str], closing: threading.Event) -> ChildOutput | None:
    """Run a module with its arguments at low priority; return None if it was interrupted.

    It is interrupted when `closing` is set, and ends with this process, even if this one is killed.
    """
    its_end, our_end = os.pipe()
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "services.common.child_process", *arguments],
            stdin=its_end,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        os.close(its_end)
    with process, os.fdopen(our_end, "wb") as leash:
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
        while True:
            try:
                out, log = process.communicate(timeout=_POLL_S)
            except subprocess.TimeoutExpired:
                if closing.is_set():
                    leash.close()
                    process.communicate()
                    return None
                continue
            if process.returncode == EXIT_INTERRUPTED:
                return None
            return ChildOutput(process.returncode, out, log)


def _start_resource_tracker() -> None:
    """Start the tracker of resources without its warnings: it cleans up after processes that exit.

    It inherits the warning options of the moment it starts; the first lock of multiprocessing would
    start it with warnings.
    """
    sys.warnoptions.append(_NO_WARNING)
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(_NO_WARNING)


@contextmanager
def group_signals_blocked() -> Iterator[None]:
    """Block the signals of a group in processes started here, which would die while they load.

    The tracker of resources would unblock them at its start, so it is started first.
    """
    _start_resource_tracker()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _GROUP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore_group_signals() -> None:
    """Leave the signals of a group to the parent of this process, which decides what to do."""
    for number in _GROUP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


class ChildPool(ProcessPoolExecutor):
    """A pool whose processes end silently with an interrupt of the command, and with its death."""

    def __init__(self, processes: int, method: str) -> None:
        """Create the pool; `method` is how multiprocessing starts its processes."""
        super().__init__(processes, multiprocessing.get_context(method), _end_with_parent)

    def submit(
        self, call: Callable[_P, _T], /, *arguments: _P.args, **named: _P.kwargs
    ) -> Future[_T]:
        """Start the call in a process, which may be created for it."""
        with group_signals_blocked():
            return super().submit(call, *arguments, **named)


def _end_with_parent() -> None:
    """Let this process of a pool end at once at a signal, and when its parent dies.

    Otherwise it would print a traceback, or finish its work unused and wait for more for ever.
    """
    for number in _GROUP_SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _GROUP_SIGNALS)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent,), name="leash", daemon=True).start()


def _end_after(parent: BaseProcess) -> None:
    parent.join()
    os._exit(EXIT_INTERRUPTED)


def _end_with_standard_input() -> None:
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(_CLEAN_UP_S)
    os._exit(EXIT_INTERRUPTED)


def main(module: str, *arguments: str) -> None:
    """Run the module; its exit code is that of this process."""
    threading.Thread(target=_end_with_standard_input, name="leash", daemon=True).start()
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
