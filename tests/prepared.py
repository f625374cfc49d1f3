"""Processes that are forked from one with everything imported, for tests that start many.

Importing numpy, numba, scipy and the services and loading the kernels takes seconds of a processor
for each process. A process of this module has its own arguments, environment, folder, descriptors,
limits of resources and signal mask, and is a child of the caller, as if it had been executed. It is
no test of how a command starts: such tests use `subprocess`.

Each test process has one server, which has no threads, so that a fork of it is sound. A fork is
adopted by the caller, the "child subreaper" while it starts.
"""

import ctypes
import gc
import importlib
import io
import json
import multiprocessing.util
import os
import resource
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TextIO

import pytest

from tests.waiting import until

PROJECT = Path(__file__).parents[1]
IMPORTED = (
    "services.cli.main",
    "services.logger.run",
    "services.replay.run",
    "services.truck.run",
    "services.worker.run",
)
_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36
_LARGEST_REQUEST = 100_000
_MOST_DESCRIPTORS = 64
_ABOVE_ALL = 500
"""Number of a descriptor beyond those that anybody asks for."""
_LIMITED = [number for name, number in vars(resource).items() if name.startswith("RLIMIT_")]


class Request(NamedTuple):
    """A process to be forked: words of a command line of Python, and its surroundings."""

    words: list[str]
    environment: dict[str, str]
    folder: str
    parent: int
    blocked: list[int]
    """Signals."""
    limits: list[list[int]]
    """Of resources, with the number of each."""
    numbers: list[int]
    """Of the descriptors that come with the request, in the process."""
    has_server: bool
    """Whether its own children of multiprocessing are forked, too."""


class Server:
    """The end of the caller at a server of prepared processes."""

    def __init__(self, end: socket.socket, process: "subprocess.Popen[bytes] | None") -> None:
        self._end = end
        self._process = process
        self._lock = threading.Lock()

    def close(self) -> None:
        """End it; processes that it has forked go on."""
        self._end.close()
        if self._process is not None:
            self._process.wait()

    def fork(
        self,
        words: Sequence[str],
        environment: Mapping[str, str],
        folder: str,
        descriptors: Mapping[int, int],
        *,
        has_server: bool = False,
    ) -> int:
        """Return the process id of a new child; `descriptors` are ours, by its numbers."""
        blocked = [int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, ())]
        limits = [[number, *resource.getrlimit(number)] for number in _LIMITED]
        request = Request(
            [*words],
            {**environment},
            folder,
            os.getpid(),
            blocked,
            limits,
            [*descriptors],
            has_server,
        )
        with self._lock, _adopting():
            text = json.dumps(request).encode()
            socket.send_fds(self._end, [text], [*descriptors.values()])
            answer = self._end.recv(64)
        if not answer:
            raise OSError("the server of prepared processes has ended")
        return int(answer)

    def spawn(self, path: bytes, words: Sequence[Any], descriptors: Sequence[int]) -> int:
        """Fork what multiprocessing would execute; see `spawnv_passfds` of multiprocessing."""
        at = {number: number for number in (0, 1, 2, *descriptors)}
        own = [os.fsdecode(word) for word in words]
        return self.fork(own[own.index("-c") :], os.environ, str(Path.cwd()), at)


@contextmanager
def _adopting() -> Iterator[None]:
    """Be the parent of orphans below this process."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    try:
        yield
    finally:
        _prctl(_PR_SET_CHILD_SUBREAPER, 0)


def _prctl(option: int, value: int | bytes) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(option, value, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")


@cache
def server() -> Server:
    """Return the server of this process, which is started at the first call."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.prepared", str(theirs.fileno())],
            stdin=subprocess.DEVNULL,
            cwd=PROJECT,
            pass_fds=[theirs.fileno()],
        )
    return Server(ours, process)


def pytest_unconfigure() -> None:
    if server.cache_info().currsize:
        server().close()


def are_used() -> bool:
    """Return whether processes are forked: not where the coverage of each one is measured."""
    return sys.platform == "linux" and not any(name.startswith("COVERAGE_") for name in os.environ)


class Popen(subprocess.Popen[str]):
    """A process of Python, with the arguments of `subprocess.Popen`, that is forked.

    With `has_server`, processes that it starts by multiprocessing are forked, too.
    """

    def __init__(self, command: Sequence[str], *, has_server: bool = False, **how: Any) -> None:
        assert command[0] == sys.executable
        self._has_server = has_server
        super().__init__(command, text=True, **how)

    def _execute_child(self, args: Any, *given: Any) -> None:
        if not are_used():
            super()._execute_child(args, *given)  # type: ignore[misc]
            return
        cwd, env = given[4:6]
        p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite = given[9:15]
        ends = (p2cread, c2pwrite, errwrite)
        at = {number: number if end == -1 else end for number, end in enumerate(ends)}
        self.pid = server().fork(
            [*map(str, args[1:])],
            os.environ if env is None else env,
            str(cwd or Path.cwd()),
            at,
            has_server=self._has_server,
        )
        self._child_created = True
        self._close_pipe_fds(p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite)  # type: ignore[attr-defined]


@pytest.fixture
def forked_spawns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let multiprocessing fork the processes that it would spawn."""
    if are_used():
        monkeypatch.setattr(multiprocessing.util, "spawnv_passfds", server().spawn)


# In the server and its forks


def _next_fork(end: socket.socket) -> tuple[Request, list[int]]:
    """Fork what is asked for; return in each fork. It ends with the process that asks."""
    while True:
        text, descriptors, _, _ = socket.recv_fds(end, _LARGEST_REQUEST, _MOST_DESCRIPTORS)
        if not text:
            os._exit(0)
        if first := os.fork():
            os.waitpid(first, 0)
            for number in descriptors:
                os.close(number)
            continue
        if os.fork():
            os._exit(0)
        return Request(*json.loads(text)), descriptors


def _become(request: Request, descriptors: list[int], end: socket.socket) -> None:
    while os.getppid() != request.parent:
        if os.getppid() == 1:
            os._exit(1)  # nobody waits for it
        time.sleep(0.001)
    end.send(str(os.getpid()).encode())
    end.close()
    if request.has_server:
        _have_server()
    for given, number in zip(_above(descriptors), request.numbers, strict=True):
        os.dup2(given, number)
        os.close(given)
    os.environ.clear()
    os.environ.update(request.environment)
    os.chdir(request.folder)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        setattr(sys, name, _stream(number, getattr(sys, name)))
        setattr(sys, f"__{name}__", getattr(sys, name))
    for number, *limit in request.limits:
        if resource.getrlimit(number) != tuple(limit):
            resource.setrlimit(number, (limit[0], limit[1]))
    signal.pthread_sigmask(signal.SIG_SETMASK, request.blocked)


def _stream(number: int, before: TextIO) -> TextIO:
    """Return a standard stream as Python opens it for a descriptor."""
    below = open(number, "rb" if number == 0 else "wb", closefd=False)  # noqa: SIM115
    stream = io.TextIOWrapper(below, encoding=before.encoding, errors=before.errors)
    is_at_once = bool(os.environ.get("PYTHONUNBUFFERED"))
    stream.reconfigure(line_buffering=number == 2 or stream.isatty(), write_through=is_at_once)
    return stream


def _above(descriptors: list[int]) -> list[int]:
    import fcntl

    above = [fcntl.fcntl(number, fcntl.F_DUPFD_CLOEXEC, _ABOVE_ALL) for number in descriptors]
    for number in descriptors:
        os.close(number)
    return above


def _have_server() -> None:
    """Fork a server for the children of this process while it is as it was prepared."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if os.fork():
        theirs.close()
        multiprocessing.util.spawnv_passfds = Server(ours, None).spawn  # type: ignore[assignment]
        return
    ours.close()
    _serve(theirs)


def _serve(end: socket.socket) -> NoReturn:
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    request, descriptors = _next_fork(end)
    _become(request, descriptors, end)
    _run(request.words)
    sys.exit()


def _run(words: list[str]) -> None:
    """Do what `python WORDS` does, named in /proc after the program."""
    program = words[1] if words[0] == "-m" else Path(words[0]).name
    _prctl(_PR_SET_NAME, program.encode())
    main = sys.modules["__main__"] = types.ModuleType("__main__")
    match words:
        case ["-c", code, *_]:
            sys.argv = ["-c", *words[2:]]
            exec(code, main.__dict__)  # noqa: S102
        case ["-m", module, *_]:
            sys.argv = words[1:]
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        case [script, *_]:
            sys.argv = words
            runpy.run_path(script, run_name="__main__")


def _main(number: int) -> NoReturn:
    for module in IMPORTED:
        importlib.import_module(module)
    importlib.import_module("services.execution.warm_up").warm_up()
    # A thread that has been joined may still be about to end. A fork has one thread only.
    until(lambda: len([*Path("/proc/self/task").iterdir()]) == 1, "the end of all other threads")
    gc.freeze()
    _serve(socket.socket(fileno=number))


if __name__ == "__main__":
    _main(int(sys.argv[1]))
