"""The option `--scheduler`: where crossings are identified."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.settings import IdentifyOptions
from services.common.errors import InputError
from services.common.options import option_of

if TYPE_CHECKING:
    from services.execution.dispatch import CrossingExecutor
    from services.execution.scheduler import Credentials

_PROCESSES: Final = "processes"
MAX_PROCESSES: Final = 256


def check_scheduler(options: IdentifyOptions) -> None:
    """Raise InputError for an invalid `--scheduler`, before anything is started."""
    given: str | None = options.scheduler
    is_cluster = given is not None and given.partition(":")[0] != _PROCESSES
    for name in ("tls", "batch", "reconnect_timeout"):
        if getattr(options, name) is not None and not is_cluster:
            raise InputError(
                f"{option_of(name)}: belongs to a cluster, --scheduler tcp://… or tls://…"
            )
    if given is not None and not is_cluster:
        _number(given)
    if is_cluster:
        from services.execution.scheduler import check_address

        check_address(str(given), _credentials(options))


@contextmanager
def execution_of(options: IdentifyOptions) -> "Iterator[CrossingExecutor | None]":
    """Run the executor of `--scheduler`, started at entry; None without the option."""
    given: str | None = options.scheduler
    if given is None:
        yield None
    elif given.partition(":")[0] == _PROCESSES:
        from services.execution.processes import ProcessExecutor

        with ProcessExecutor(_number(given)) as processes:
            yield processes
    else:
        from services.execution.cluster import BATCH, PATIENCE_S, DaskExecutor

        with DaskExecutor(
            given,
            credentials=_credentials(options),
            batch=options.batch or BATCH,
            patience_s=options.reconnect_timeout or PATIENCE_S,
        ) as cluster:
            yield cluster


def _credentials(options: IdentifyOptions) -> "Credentials | None":
    return None if options.tls is None else credentials_of(options.tls, "client")


def credentials_of(folder: Path, role: str) -> "Credentials":
    """Return the files of a folder of credentials; InputError for those of another role."""
    from services.bus.credentials import AUTHORITY, CERTIFICATE, KEY, check_speaks_for
    from services.execution.scheduler import Credentials

    check_speaks_for(folder, role)
    return Credentials(folder / AUTHORITY, folder / CERTIFICATE, folder / KEY)


def _number(given: str) -> int:
    _, _, text = given.partition(":")
    if given == _PROCESSES:
        return cores()
    try:
        number = int(text)
    except ValueError:
        number = 0
    if not 1 <= number <= MAX_PROCESSES:
        raise InputError(f"--scheduler: is {given!r}, the number must be from 1 to {MAX_PROCESSES}")
    return number


def cores() -> int:
    """Return the number of processors, up to the limit."""
    return min(os.cpu_count() or 1, MAX_PROCESSES)
