"""`driveby cluster`: a Dask scheduler and workers on this machine, for as long as this runs.

They are processes of their own, started as `dask scheduler` and `dask worker` start them, and end
with this one, however it ends (`services.common.leash`). One that dies is started again: a worker
leaves when its scheduler does, so after a dead scheduler all are new. One that is frozen is ended,
so it dies as well. Exit code 0 is an end like any other: whatever Dask's configuration says
(`_FIXED`), none of them ends by itself while this runs.

Dask runs whatever it is sent. They listen on this machine only, unless they have credentials: then
everybody who connects shows a certificate of the same authority.
"""

import logging
import math
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, NamedTuple

from services.bus.playback import leave_at_once, stopped_by_signals
from services.cluster.scheduler_process import CAUSE_FILE
from services.common.errors import FailureError, InputError
from services.common.extras import check_installed
from services.execution.scheduler import Credentials, is_loopback, threads_of
from services.execution.watch import Limits, Watch

_log = logging.getLogger(__name__)
DEFAULT_PORT: Final = 8786
_LOOK_S = 0.2
_SOON_S = 10.0
"""Who dies sooner than this after its start will die again: it is started more and more slowly."""
_LONGEST_PAUSE_S = 10.0
_TRIES = 5
"""So often may something die soon before all were there for the first time."""
_END_S = 10.0
FROZEN_S = 60.0
"""A scheduler and a worker do something every half second, whether or not there is work: who has
taken no processor time for so long is stopped, or waits for what will not come."""


class Roles(NamedTuple):
    """Credentials of those who take part on this machine."""

    scheduler: Credentials
    worker: Credentials
    client: Credentials


class Wanted(NamedTuple):
    """What is to run."""

    workers: int
    host: str
    port: int
    roles: Roles | None
    memory: str
    """What a worker may take, as Dask reads it: `auto`, `2GiB`, `0` for no limit."""

    @property
    def address(self) -> str:
        """Where the scheduler is."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'tcp' if self.roles is None else 'tls'}://{host}:{self.port}"


def run(wanted: Wanted) -> int:
    """Run until a signal comes; say where, when all are there.

    InputError: another interface than loopback without credentials, a port that is taken, Dask is
    not installed. FailureError: something dies again and again.
    """
    check_installed("driveby cluster", "distributed", extra="cluster")
    check_listens(wanted)
    client = None if wanted.roles is None else wanted.roles.client
    with (
        stopped_by_signals(leave_at_once) as stop,
        tempfile.TemporaryDirectory(prefix="driveby-cluster-") as folder,
        _children(wanted, folder) as children,
    ):
        is_told = False
        while not stop.wait(_LOOK_S):
            for child in children:
                child.look_after()
                if not is_told and child.died_soon > _TRIES:
                    raise FailureError(f"the {child.name} ends soon after every start; see above")
            if not is_told and threads_of(wanted.address, client) >= wanted.workers:
                is_told = True
                _log.info(
                    "ready: %d worker%s at %s%s; driveby identify … --scheduler %s",
                    *(wanted.workers, "" if wanted.workers == 1 else "s", wanted.address),
                    "" if wanted.roles else " (this machine only, without TLS)",
                    wanted.address,
                )
    return 0


def check_listens(wanted: Wanted) -> None:
    """InputError if others could reach it without credentials, or nobody can."""
    if wanted.roles is None and not is_loopback(wanted.host):
        raise InputError(
            f"--listen {wanted.host}: without TLS whoever reaches it runs programs on this "
            "machine; give --tls FOLDER, made by driveby certs FOLDER --cluster"
        )
    kind = socket.AF_INET6 if ":" in wanted.host else socket.AF_INET
    with socket.socket(kind) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((wanted.host, wanted.port))
        except OSError as error:
            raise InputError(
                f"cannot listen at {wanted.host} port {wanted.port}: {error.strerror}"
            ) from None


@contextmanager
def _children(wanted: Wanted, folder: str) -> Iterator[list["_Child"]]:
    """The scheduler and the workers; they have ended when the block has."""
    causes = Path(folder)
    own = "services.cluster.scheduler_process"
    scheduler = _Child("scheduler", own, _of_scheduler(wanted), causes)
    arguments = _of_worker(wanted, folder)
    workers = [
        _Child(f"worker {number}", "distributed.cli.dask_worker", arguments, causes)
        for number in range(1, wanted.workers + 1)
    ]
    children = [scheduler, *workers]
    try:
        for child in children:
            child.start()
        yield children
    finally:
        for child in reversed(children):
            child.let_go()
        for child in children:
            child.end()


def _of_scheduler(wanted: Wanted) -> list[str]:
    files = None if wanted.roles is None else wanted.roles.scheduler
    return [
        *("--host", wanted.host, "--port", str(wanted.port)),
        # Its pages would listen on all interfaces.
        *("--no-dashboard", "--dashboard-address", "127.0.0.1:0"),
        *_tls_arguments(files),
    ]


def _of_worker(wanted: Wanted, folder: str) -> list[str]:
    files = None if wanted.roles is None else wanted.roles.worker
    return [
        *(wanted.address, "--host", wanted.host, "--nthreads", "1", "--no-nanny"),
        *("--memory-limit", wanted.memory, "--local-directory", folder),
        *("--no-dashboard", "--dashboard-address", "127.0.0.1:0"),
        *_tls_arguments(files),
    ]


def _tls_arguments(files: Credentials | None) -> list[str]:
    if files is None:
        return []
    return [
        *("--tls-ca-file", str(files.authority), "--tls-cert", str(files.certificate)),
        *("--tls-key", str(files.key)),
    ]


class _Child:
    """One process after the other, on a leash."""

    def __init__(self, name: str, module: str, arguments: list[str], causes: Path) -> None:
        self.name = name
        self._cause_file = causes / f"{name.replace(' ', '-')}-ended"
        self._arguments = [module, *arguments]
        self._process: subprocess.Popen[bytes] | None = None
        self._watch: Watch | None = None
        self._began_s = 0.0
        self._again_s: float | None = None
        self.died_soon = 0
        """How often in a row it has died soon after its start."""

    def start(self) -> None:
        """Start it; what it says goes where this process's errors go."""
        self._cause_file.unlink(missing_ok=True)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "services.common.leash", *self._arguments],
            stdin=subprocess.PIPE,
            env=_ENVIRONMENT | os.environ | _FIXED | {CAUSE_FILE: str(self._cause_file)},
        )
        self._began_s, self._again_s = time.monotonic(), None
        self._watch = Watch(self._process.pid, Limits(math.inf, FROZEN_S), self._began_s)
        _log.info("%s is process %d", self.name, self._process.pid)

    def look_after(self) -> None:
        """Start it again if it has died."""
        now_s = time.monotonic()
        if self._again_s is not None:
            if now_s >= self._again_s:
                self.start()
            return
        code = None if self._process is None else self._process.poll()
        if code is None:
            self._end_if_frozen(now_s)
            return
        self.died_soon = self.died_soon + 1 if now_s < self._began_s + _SOON_S else 0
        pause_s = min(2.0**self.died_soon - 1.0, _LONGEST_PAUSE_S)
        self._again_s = now_s + pause_s
        cause = f": {self._cause_file.read_text()}" if self._cause_file.exists() else ""
        _log.warning(
            "the %s has ended (exit code %d%s); it is started again", self.name, code, cause
        )

    def _end_if_frozen(self, now_s: float) -> None:
        """Kill it if it does nothing; it is started again when it has ended."""
        why = "" if self._watch is None else self._watch.why_hung(now_s)
        if why and self._process is not None:
            self._watch = None
            _log.warning("the %s %s and is ended", self.name, why)
            self._process.kill()

    def let_go(self) -> None:
        """Let it end: it does when nobody holds its leash."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def end(self) -> None:
        """Wait for its end, and then not any longer."""
        if self._process is None:
            return
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


_ENVIRONMENT: Final = {
    "OPENBLAS_NUM_THREADS": "1",
    # So many workers may die of a batch besides the first: with Dask's 3 finding out takes long.
    "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
    # What a worker has that says nothing is given to another one: with Dask's 5 minutes, late.
    "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": f"{FROZEN_S:.0f}s",
    "DASK_LOGGING__DISTRIBUTED": "critical",  # of who comes and goes it is told here
    "PYTHONWARNINGS": "ignore:resource_tracker",  # it puts away what a worker that is ended leaves
}
"""Of the children; what the user has set counts."""

_FIXED: Final = {
    "DASK_DISTRIBUTED__SCHEDULER__IDLE_TIMEOUT": "None",
    "DASK_DISTRIBUTED__SCHEDULER__NO_WORKERS_TIMEOUT": "None",
    "DASK_DISTRIBUTED__WORKER__LIFETIME__DURATION": "None",
}
"""Of the children, whatever files of Dask or the user say. By the first and the last they would end
by themselves with exit code 0, by the second they would give up batches while workers start again.
"""
