"""A Dask scheduler and workers on this machine, while `driveby cluster` runs.

They are processes of their own, started as `dask scheduler` and `dask worker` start them, and end
with this one, however it ends (`common.child_process`). A dead one is started again: a worker
leaves when its scheduler does, so after a dead scheduler all are new. A frozen one is ended, so it
dies as well. An end with exit code 0 counts as any other: whatever Dask's configuration contains
(`_FIXED`), none of them ends by itself while this runs.

Dask runs whatever it is sent. They listen on this machine only, unless they have credentials: every
client then shows a certificate of the same authority.
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
from services.execution.hang_watchdog import HangWatchdog, TaskLimits
from services.execution.scheduler import Credentials, is_loopback, threads_of

_log = logging.getLogger(__name__)
_POLL_S = 0.2
_SOON_S = 10.0
"""Lifetime in s below which a process is restarted with increasing delays."""
_LONGEST_PAUSE_S = 10.0
_TRIES = 5
"""Maximum number of early deaths before all processes have started for the first time."""
_END_S = 10.0
FROZEN_S = 60.0
"""Time in s without use of the processor after which a process is frozen.

A scheduler and a worker act every half second, with or without tasks: one that does not is stopped,
or waits for an event that will not occur.
"""


class ClusterCredentials(NamedTuple):
    """Credentials of the processes on this machine."""

    scheduler: Credentials
    worker: Credentials
    client: Credentials


class ClusterConfig(NamedTuple):
    """Processes to run."""

    workers: int
    host: str
    port: int
    roles: ClusterCredentials | None
    memory: str
    """Memory limit of a worker, as Dask reads it: `auto`, `2GiB`, `0` for no limit."""

    @property
    def address(self) -> str:
        """Address of the scheduler."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'tcp' if self.roles is None else 'tls'}://{host}:{self.port}"


def run(config: ClusterConfig) -> int:
    """Run until a signal arrives; log the address once all processes are ready.

    Raise InputError for an interface other than loopback without credentials, a port in use, and
    without Dask, FailureError if a process dies repeatedly.
    """
    check_installed("driveby cluster", "distributed", extra="cluster")
    check_listens(config)
    client = None if config.roles is None else config.roles.client
    with (
        stopped_by_signals(leave_at_once) as stop,
        tempfile.TemporaryDirectory(prefix="driveby-cluster-") as folder,
        _children(config, folder) as children,
    ):
        is_logged = False
        while not stop.wait(_POLL_S):
            for child in children:
                child.restart_if_dead()
                if not is_logged and child.died_soon > _TRIES:
                    raise FailureError(f"the {child.name} ends soon after every start; see above")
            if not is_logged and threads_of(config.address, client) >= config.workers:
                is_logged = True
                _log.info(
                    "ready: %d worker%s at %s%s; driveby identify … --scheduler %s",
                    *(config.workers, "" if config.workers == 1 else "s", config.address),
                    "" if config.roles else " (this machine only, without TLS)",
                    config.address,
                )
    return 0


def check_listens(config: ClusterConfig) -> None:
    """Raise InputError if others could reach it without credentials, or it cannot listen."""
    if config.roles is None and not is_loopback(config.host):
        raise InputError(
            f"--listen {config.host}: without TLS anyone who reaches it runs programs on this "
            "machine; give --tls FOLDER, made by driveby certs FOLDER --cluster"
        )
    kind = socket.AF_INET6 if ":" in config.host else socket.AF_INET
    with socket.socket(kind) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((config.host, config.port))
        except OSError as error:
            raise InputError(
                f"cannot listen at {config.host} port {config.port}: {error.strerror}"
            ) from None


@contextmanager
def _children(config: ClusterConfig, folder: str) -> Iterator[list["_Child"]]:
    """Run the scheduler and the workers; end them with the context."""
    causes = Path(folder)
    own = "services.cluster.scheduler_process"
    scheduler = _Child("scheduler", own, _of_scheduler(config), causes)
    arguments = _of_worker(config, folder)
    workers = [
        _Child(f"worker {number}", "distributed.cli.dask_worker", arguments, causes)
        for number in range(1, config.workers + 1)
    ]
    children = [scheduler, *workers]
    try:
        for child in children:
            child.start()
        yield children
    finally:
        for child in reversed(children):
            child.request_stop()
        for child in children:
            child.end()


def _of_scheduler(config: ClusterConfig) -> list[str]:
    files = None if config.roles is None else config.roles.scheduler
    return [
        *("--host", config.host, "--port", str(config.port)),
        # Its pages would listen on all interfaces.
        *("--no-dashboard", "--dashboard-address", "127.0.0.1:0"),
        *_tls_arguments(files),
    ]


def _of_worker(config: ClusterConfig, folder: str) -> list[str]:
    files = None if config.roles is None else config.roles.worker
    return [
        *(config.address, "--host", config.host, "--nthreads", "1", "--no-nanny"),
        *("--memory-limit", config.memory, "--local-directory", folder),
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
    """A child process and its successors."""

    def __init__(self, name: str, module: str, arguments: list[str], causes: Path) -> None:
        self.name = name
        self._cause_file = causes / f"{name.replace(' ', '-')}-ended"
        self._arguments = [module, *arguments]
        self._process: subprocess.Popen[bytes] | None = None
        self._watchdog: HangWatchdog | None = None
        self._began_s = 0.0
        self._again_s: float | None = None
        self.died_soon = 0
        """Number of consecutive deaths soon after the start."""

    def start(self) -> None:
        """Start it; its output goes to this process's standard error."""
        self._cause_file.unlink(missing_ok=True)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "services.common.child_process", *self._arguments],
            stdin=subprocess.PIPE,
            env=_ENVIRONMENT | os.environ | _FIXED | {CAUSE_FILE: str(self._cause_file)},
        )
        self._began_s, self._again_s = time.monotonic(), None
        self._watchdog = HangWatchdog(
            self._process.pid, TaskLimits(math.inf, FROZEN_S), self._began_s
        )
        _log.info("%s is process %d", self.name, self._process.pid)

    def restart_if_dead(self) -> None:
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
        _log.warning("the %s ended (exit code %d%s); restarting it", self.name, code, cause)

    def _end_if_frozen(self, now_s: float) -> None:
        """Kill it if it is frozen; it is started again when it has ended."""
        why = "" if self._watchdog is None else self._watchdog.why_hung(now_s)
        if why and self._process is not None:
            self._watchdog = None
            _log.warning("the %s %s; ending it", self.name, why)
            self._process.kill()

    def request_stop(self) -> None:
        """Request its end by closing its lifeline."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def end(self) -> None:
        """Wait for its end, up to a limit."""
        if self._process is None:
            return
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


_ENVIRONMENT: Final = {
    "OPENBLAS_NUM_THREADS": "1",
    # Maximum number of workers that die of a batch besides the first: Dask's 3 takes long to reach.
    "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
    # Tasks of a silent worker are given to another one: after Dask's 5 minutes, too late.
    "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": f"{FROZEN_S:.0f}s",
    "DASK_LOGGING__DISTRIBUTED": "critical",  # arrivals and departures are logged here
    "PYTHONWARNINGS": "ignore:resource_tracker",  # it cleans up after a worker that is ended
}
"""Environment of the children; values set by the user take precedence."""

_FIXED: Final = {
    "DASK_DISTRIBUTED__SCHEDULER__IDLE_TIMEOUT": "None",
    "DASK_DISTRIBUTED__SCHEDULER__NO_WORKERS_TIMEOUT": "None",
    "DASK_DISTRIBUTED__WORKER__LIFETIME__DURATION": "None",
}
"""Environment of the children that overrides Dask's files and the user.

By the first and the last the children would end by themselves with exit code 0, by the second they
would give up batches while workers restart.
"""
