"""Dask, as far as crossings need it: a connection to a scheduler, and who its workers are.

Dask runs whatever it is sent. So a scheduler elsewhere is spoken to by TLS only, and workers of
another program, of another Python or of packages that compute otherwise are refused by name.
"""

import contextlib
import ipaddress
import logging
import time
import warnings
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

from services.common.errors import FailureError, InputError
from services.execution.cluster_worker import About, about, identify_batch
from services.execution.program import PYTHON, another_program, processor

_log = logging.getLogger(__name__)
_CALL_S: Final = 20.0
"""A scheduler that answers nothing for so long is taken to be gone."""
_RETRY_S: Final = 1.0
_SOON_S: Final = 5.0
_SCHEMES: Final = ("tcp", "tls")


class Credentials(NamedTuple):
    """Files in PEM form: whom to believe, and who one is."""

    authority: Path
    certificate: Path
    key: Path


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
            said = self._client.sync(self._client.scheduler.identity, callback_timeout=_CALL_S)
        except Exception as error:  # whatever it is, there is no answer
            _log.debug("the scheduler does not answer: %s", error)
            return None
        return sum(int(worker["nthreads"]) for worker in said["workers"].values())

    def submit(self, key: str, batch: bytes, program: dict[str, str]) -> Any:
        """Have a batch identified; its future."""
        return self._client.submit(identify_batch, batch, program, key=key, pure=False)

    def answer(self, future: Any) -> Any:
        """What a batch gave. Raises what its task has raised, or that it does not come."""
        return future.result(timeout=_CALL_S)

    def send_away(self, worker: str) -> None:
        """Have a worker end: it would take a batch after the other, and give all back."""
        self._client.retire_workers([worker], close_workers=True)

    def wait_for_workers(self, longest_s: float) -> None:
        """FailureError if there are none for so long."""
        deadline = time.monotonic() + longest_s
        is_told = False
        while not self.threads:
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

        Versions are asked for first, which runs nothing that is sent: what one Python has packed
        may end another one.
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
            return ask(*arguments, **named)
        except Exception as error:
            raise FailureError(
                f"{self._address}: could not ask for {what}: {reason(error)}"
            ) from None


def connected(address: str, credentials: Credentials | None, longest_s: float) -> Scheduler:
    """A connection to the scheduler. FailureError if none answers for so long."""
    deadline = time.monotonic() + longest_s
    while True:
        left_s = max(deadline - time.monotonic(), _RETRY_S)
        try:
            return Scheduler(address, _client(address, credentials, min(left_s, _CALL_S)))
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
    if not is_one or parts.path or parts.query:
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of versions: they are told by name
        return Client(
            address, timeout=timeout_s, security=security, set_as_default=False, name="driveby"
        )


def _quieten() -> None:
    """Dask tells in its own logs, with tracebacks, what is told here in a line."""
    import dask
    import distributed  # noqa: F401 - it sets up its logs when it is imported

    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    # A batch is a large one, and meant to be.
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})
