"""Access to Dask: a connection to a scheduler, and a check of its workers.

Dask runs whatever it is sent. So a remote scheduler is accepted with TLS only, and workers of
another program, of another Python or of packages that compute differently are refused by name.
"""

import contextlib
import ipaddress
import logging
import time
import warnings
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

from services.common.errors import FailureError, InputError
from services.execution.cluster_worker import WorkerInfo, identify_batch, worker_info
from services.execution.program import PYTHON, processor, version_difference

_log = logging.getLogger(__name__)
CALL_S = 20.0
"""Time in s without an answer after which a scheduler counts as lost."""
_RETRY_S: Final = 1.0
_SOON_S: Final = 5.0
_SCHEMES: Final = ("tcp", "tls")


class Credentials(NamedTuple):
    """Paths of PEM files: the trusted authority, and one's own certificate and key."""

    authority: Path
    certificate: Path
    key: Path


class SchedulerUnavailableError(FailureError):
    """A scheduler or one of its workers is lost or frozen."""


class UnsentFuture(NamedTuple):
    """The future of a batch that could not be submitted."""

    status: str = "cancelled"
    """State in Dask's terms, as of all batches of a lost scheduler."""

    def release(self) -> None:
        """Do nothing: no scheduler holds the result."""


class Scheduler:
    """A connection to a scheduler that has workers of this program, or had a moment ago."""

    def __init__(self, address: str, client: Any) -> None:
        self._address = address
        self._client = client

    @property
    def threads(self) -> int | None:
        """Number of batches its workers run at once; None without a timely answer."""
        if self._client.status != "running":
            return None
        try:
            described = self._in_time(self._client.scheduler.identity)
        except Exception as error:  # whatever it is, there is no answer
            _log.debug("the scheduler does not answer: %s", error)
            return None
        return sum(int(worker["nthreads"]) for worker in described["workers"].values())

    def submit(self, key: str, batch: bytes, program: dict[str, str]) -> Any:
        """Submit a batch for identification; return its future."""
        try:
            return self._client.submit(identify_batch, batch, program, key=key, pure=False)
        except Exception as error:  # whatever it is, the batch was not submitted
            _log.debug("cannot submit a batch: %s", error)
            return UnsentFuture()

    def answer(self, future: Any) -> Any:
        """Return a batch's result. Raise what its task raised, or TimeoutError."""
        return future.result(timeout=CALL_S)

    def retire_worker(self, worker: str) -> None:
        """Ask a worker to end: it would accept one batch after the other, and refuse all."""
        try:
            self._in_time(self._client.retire_workers, [worker], close_workers=True)
        except Exception as error:  # it may have ended itself, or the scheduler has
            _log.debug("cannot retire worker %s: %s", worker, error)

    def wait_for_workers(self, longest_s: float) -> None:
        """Wait for workers.

        Raise FailureError without any, SchedulerUnavailableError if the scheduler is lost.
        """
        deadline = time.monotonic() + longest_s
        is_logged = False
        while not (threads := self.threads):
            if threads is None:
                raise SchedulerUnavailableError(f"{self._address}: the scheduler is lost again")
            if time.monotonic() > deadline:
                raise FailureError(
                    f"{self._address}: has no worker; start some (dask worker {self._address}), "
                    "and run the same command again"
                )
            if not is_logged:
                is_logged = True
                _log.warning(
                    "scheduler %s has no worker; waiting up to %.0f s for one",
                    *(self._address, longest_s),
                )
            time.sleep(_RETRY_S)

    def check_workers(self, program: dict[str, str]) -> None:
        """Raise FailureError with the names of the workers of another program, if there are any.

        Raise SchedulerUnavailableError if they do not answer. Versions are requested first, which
        executes nothing that is sent: a pickle of one Python version may end a process of another.
        """
        packages = [name for name in program if name != PYTHON]
        versions = self._asked(
            "its workers' versions", self._client.get_versions, packages=packages
        )
        plain = {name: text.partition(" ")[0] for name, text in program.items()}
        wrong = []
        for worker, described in versions["workers"].items():
            python = ".".join(str(described["host"]["python"]).split(".")[:3])
            why = version_difference(described["packages"] | {PYTHON: python}, plain)
            if why:
                wrong.append(f"worker {worker}: {why}")
        wrong = wrong or self._of_other_code(program)
        if wrong:
            raise FailureError(f"{'; '.join(sorted(wrong))}; all must run the same program")

    def close(self) -> None:
        """Disconnect; unfinished work for this process is given up."""
        with contextlib.suppress(Exception):  # it may be lost
            self._client.close(timeout=_RETRY_S)

    def _of_other_code(self, program: dict[str, str]) -> list[str]:
        described = self._asked("its workers", self._client.run, worker_info, on_error="return")
        wrong = []
        for worker, one in sorted(described.items()):
            if not isinstance(one, WorkerInfo):
                wrong.append(f"worker {worker}: does not know this program: {reason(one)}")
            elif why := version_difference(one.program, program) or one.cannot:
                wrong.append(f"worker {worker}: {why}")
            elif one.processor != processor():
                _log.warning(
                    "worker %s has another processor (%s, here %s): last digits may differ",
                    *(worker, one.processor, processor()),
                )
        return wrong

    def _asked(self, what: str, ask: Any, *arguments: Any, **named: Any) -> Any:
        try:
            return self._in_time(ask, *arguments, **named)
        except Exception as error:
            raise SchedulerUnavailableError(
                f"{self._address}: could not ask for {what}: {reason(error)}"
            ) from None

    def _in_time(self, ask: Any, *arguments: Any, **named: Any) -> Any:
        """Return an answer of the scheduler in time; Dask itself would wait for a frozen one."""

        async def asking() -> Any:
            return await ask(*arguments, **named)

        return self._client.sync(asking, callback_timeout=CALL_S)


def connect(address: str, credentials: Credentials | None, longest_s: float) -> Scheduler:
    """Return a connection to the scheduler. Raise FailureError if none answers in time."""
    deadline = time.monotonic() + longest_s
    while True:
        left_s = max(deadline - time.monotonic(), _RETRY_S)
        try:
            return Scheduler(address, _client(address, credentials, min(left_s, CALL_S)))
        except Exception as error:  # a refused connection, a handshake, a time-out
            if time.monotonic() + _RETRY_S > deadline:
                raise FailureError(
                    f"{address}: no scheduler answers ({reason(error)}); start one, and run "
                    "the same command again"
                ) from None
        time.sleep(_RETRY_S)


def threads_of(address: str, credentials: Credentials | None) -> int:
    """Return the number of batches a scheduler's workers run at once; 0 if none answers."""
    try:
        scheduler = Scheduler(address, _client(address, credentials, _SOON_S))
    except Exception as error:  # it is not reachable yet
        _log.debug("%s: %s", address, error)
        return 0
    try:
        return scheduler.threads or 0
    finally:
        scheduler.close()


def check_address(address: str, credentials: Credentials | None) -> None:
    """Raise InputError unless it is tcp:// on this machine, or tls:// with credentials."""
    try:
        parts = urlsplit(address)
        is_one = parts.scheme in _SCHEMES and parts.hostname and parts.port
    except ValueError:
        is_one = False
    if not is_one or address != f"{parts.scheme}://{parts.netloc}" or "@" in address:
        raise InputError(
            f"--scheduler: is {address[:80]!r}, it must be processes, processes:N, tcp://HOST:PORT "
            "or tls://HOST:PORT"
        )
    if parts.scheme == "tls" and credentials is None:
        raise InputError(f"--scheduler: {address} needs --tls FOLDER, credentials of a client")
    if parts.scheme == "tcp" and credentials is not None:
        raise InputError(f"--tls: {address} is an address without TLS; write tls://…")
    if parts.scheme == "tcp" and not is_loopback(str(parts.hostname)):
        raise InputError(
            f"--scheduler: {address} is another machine: without TLS anyone who reaches it runs "
            "programs there; use tls:// with --tls"
        )


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine, so that no other one reaches it."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def reason(error: BaseException) -> str:
    """Return the first line of an exception's message, or of its cause's."""
    cause = error.__cause__ or error
    lines = str(cause).splitlines() or [type(cause).__name__]
    return lines[0][:160]


def _client(address: str, credentials: Credentials | None, timeout_s: float) -> Any:
    _silence_dask_logs()
    from distributed import Client, Security

    security = None
    if credentials is not None:
        security = Security(
            tls_ca_file=str(credentials.authority),
            tls_client_cert=str(credentials.certificate),
            tls_client_key=str(credentials.key),
            require_encryption=True,
        )
    _check_that_it_answers(address, security, timeout_s)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about versions: they are compared by name
        return Client(
            address,
            loop=_loop(),
            timeout=timeout_s,
            security=security,
            set_as_default=False,
            name="driveby",
        )


def _check_that_it_answers(address: str, security: Any, timeout_s: float) -> None:
    """Raise Dask's exception, or TimeoutError, if no scheduler answers.

    Its client limits the time to reach a port, and then waits without end for a frozen scheduler,
    whose port is still open.
    """
    from distributed.comm import connect
    from distributed.utils import sync

    arguments = {} if security is None else security.get_connection_args("client")

    async def greet() -> None:
        comm = await connect(address, timeout=timeout_s, **arguments)
        await comm.close()

    sync(_loop(), greet, callback_timeout=timeout_s + _RETRY_S)


@cache
def _loop() -> Any:
    """Return the loop of all connections, in a thread of its own.

    A client without one starts another such thread, and leaves it behind if it cannot connect.
    """
    from distributed.utils import LoopRunner

    runner = LoopRunner()
    runner.start()
    return runner.loop


def _silence_dask_logs() -> None:
    """Silence Dask's own logs of tracebacks; a line here reports the same."""
    import dask
    import distributed  # noqa: F401 - it sets up its logs when it is imported

    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    # A batch is large on purpose.
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})
