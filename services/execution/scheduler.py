"""Dask, as far as crossings need it: a connection to a scheduler, and who its workers are.

Dask runs whatever it is sent. So a scheduler elsewhere is spoken to by TLS only, and workers of
another program, of another Python or of packages that compute otherwise are refused by name.
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
from services.execution.cluster_worker import About, about, identify_batch
from services.execution.program import PYTHON, another_program, processor

_log = logging.getLogger(__name__)
CALL_S = 20.0
"""A scheduler that answers nothing for so long is taken to be gone."""
_RETRY_S: Final = 1.0
_SOON_S: Final = 5.0
_SCHEMES: Final = ("tcp", "tls")


class Credentials(NamedTuple):
    """Files in PEM form: whom to believe, and who one is."""

    authority: Path
    certificate: Path
    key: Path


class AwayError(FailureError):
    """A scheduler, or one of its workers, has gone while it was asked, or is frozen."""


class Gone(NamedTuple):
    """The future of a batch that could not be given to a scheduler."""

    status: str = "cancelled"
    """As Dask calls that of all batches of a scheduler that is gone."""

    def release(self) -> None:
        """Nobody keeps it."""


class Scheduler:
    """A connection to a scheduler that has workers of this program, or had a moment ago."""

    def __init__(self, address: str, client: Any) -> None:
        self._address = address
        self._client = client

    @property
    def threads(self) -> int | None:
        """How many batches its workers take at once; None if it does not answer in time."""
        if self._client.status != "running":
            return None
        try:
            said = self._in_time(self._client.scheduler.identity)
        except Exception as error:  # whatever it is, there is no answer
            _log.debug("the scheduler does not answer: %s", error)
            return None
        return sum(int(worker["nthreads"]) for worker in said["workers"].values())

    def submit(self, key: str, batch: bytes, program: dict[str, str]) -> Any:
        """Have a batch identified; its future."""
        try:
            return self._client.submit(identify_batch, batch, program, key=key, pure=False)
        except Exception as error:  # whatever it is, the batch has not been given away
            _log.debug("a batch could not be sent: %s", error)
            return Gone()

    def answer(self, future: Any) -> Any:
        """What a batch gave. Raises what its task has raised, or that it does not come."""
        return future.result(timeout=CALL_S)

    def send_away(self, worker: str) -> None:
        """Have a worker end: it would take a batch after the other, and give all back."""
        try:
            self._in_time(self._client.retire_workers, [worker], close_workers=True)
        except Exception as error:  # it may have gone by itself, or the scheduler has
            _log.debug("worker %s could not be sent away: %s", worker, error)

    def wait_for_workers(self, longest_s: float) -> None:
        """FailureError if there are none for so long; AwayError if the scheduler goes meanwhile."""
        deadline = time.monotonic() + longest_s
        is_told = False
        while not (threads := self.threads):
            if threads is None:
                raise AwayError(f"{self._address}: the scheduler is gone again")
            if time.monotonic() > deadline:
                raise FailureError(
                    f"{self._address}: has no worker; start some (dask worker {self._address}), "
                    "and the same command again"
                )
            if not is_told:
                is_told = True
                _log.warning(
                    "the scheduler at %s has no worker; waiting %.0f s for one",
                    *(self._address, longest_s),
                )
            time.sleep(_RETRY_S)

    def check_workers(self, program: dict[str, str]) -> None:
        """FailureError that names those of another program, if there are any.

        AwayError if they do not answer. Versions are asked for first, which runs nothing that is
        sent: what one Python has packed may end another one.
        """
        packages = [name for name in program if name != PYTHON]
        told = self._asked("its workers' versions", self._client.get_versions, packages=packages)
        plain = {name: text.partition(" ")[0] for name, text in program.items()}
        wrong = []
        for worker, said in told["workers"].items():
            python = ".".join(str(said["host"]["python"]).split(".")[:3])
            why = another_program(said["packages"] | {PYTHON: python}, plain)
            if why:
                wrong.append(f"worker {worker}: {why}")
        wrong = wrong or self._of_other_code(program)
        if wrong:
            raise FailureError(f"{'; '.join(sorted(wrong))}; all must run the same program")

    def close(self) -> None:
        """Leave; what is under way for this one is given up."""
        with contextlib.suppress(Exception):  # it may be gone
            self._client.close(timeout=_RETRY_S)

    def _of_other_code(self, program: dict[str, str]) -> list[str]:
        said = self._asked("its workers", self._client.run, about, on_error="return")
        wrong = []
        for worker, one in sorted(said.items()):
            if not isinstance(one, About):
                wrong.append(f"worker {worker}: does not know this program: {reason(one)}")
            elif why := another_program(one.program, program) or one.cannot:
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
            raise AwayError(f"{self._address}: could not ask for {what}: {reason(error)}") from None

    def _in_time(self, ask: Any, *arguments: Any, **named: Any) -> Any:
        """What a question to the scheduler gives; by itself it would wait for a frozen one."""

        async def asking() -> Any:
            return await ask(*arguments, **named)

        return self._client.sync(asking, callback_timeout=CALL_S)


def connected(address: str, credentials: Credentials | None, longest_s: float) -> Scheduler:
    """A connection to the scheduler. FailureError if none answers for so long."""
    deadline = time.monotonic() + longest_s
    while True:
        left_s = max(deadline - time.monotonic(), _RETRY_S)
        try:
            return Scheduler(address, _client(address, credentials, min(left_s, CALL_S)))
        except Exception as error:  # a refused connection, a handshake, a time-out
            if time.monotonic() + _RETRY_S > deadline:
                raise FailureError(
                    f"{address}: no scheduler answers ({reason(error)}); start one, and the same "
                    "command again"
                ) from None
        time.sleep(_RETRY_S)


def threads_of(address: str, credentials: Credentials | None) -> int:
    """How many batches the workers of a scheduler take at once; 0 if none answers."""
    try:
        scheduler = Scheduler(address, _client(address, credentials, _SOON_S))
    except Exception as error:  # not there yet
        _log.debug("%s: %s", address, error)
        return 0
    try:
        return scheduler.threads or 0
    finally:
        scheduler.close()


def check_address(address: str, credentials: Credentials | None) -> None:
    """InputError unless it is tcp:// on this machine, or tls:// with credentials."""
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
        raise InputError(f"--tls: {address} is spoken to without TLS; tls://… is meant")
    if parts.scheme == "tcp" and not is_loopback(str(parts.hostname)):
        raise InputError(
            f"--scheduler: {address} is another machine: without TLS whoever reaches it runs "
            "programs there; use tls:// with --tls"
        )


def is_loopback(host: str) -> bool:
    """Whether a host is this machine, and nobody else reaches it."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def reason(error: BaseException) -> str:
    """The first line of what is said, or of what it was caused by."""
    cause = error.__cause__ or error
    lines = str(cause).splitlines() or [type(cause).__name__]
    return lines[0][:160]


def _client(address: str, credentials: Credentials | None, timeout_s: float) -> Any:
    _quieten()
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
        warnings.simplefilter("ignore")  # of versions: they are told by name
        return Client(
            address,
            loop=_loop(),
            timeout=timeout_s,
            security=security,
            set_as_default=False,
            name="driveby",
        )


def _check_that_it_answers(address: str, security: Any, timeout_s: float) -> None:
    """Raise what Dask does, or TimeoutError, if nobody answers.

    Its client limits the time to reach a port, and then waits without end for a scheduler that is
    frozen: the port of that one is still open.
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
    """The loop of all connections, in a thread of its own.

    A client without one starts another such thread, and leaves it behind if it cannot connect.
    """
    from distributed.utils import LoopRunner

    runner = LoopRunner()
    runner.start()
    return runner.loop


def _quieten() -> None:
    """Dask tells in its own logs, with tracebacks, what is told here in a line."""
    import dask
    import distributed  # noqa: F401 - it sets up its logs when it is imported

    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    # A batch is a large one, and meant to be.
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})
