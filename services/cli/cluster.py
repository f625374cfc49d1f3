"""The command `driveby cluster`, and `--scheduler`: where crossings are identified."""

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from services.cli.commands.identify import IdentifyOptions
from services.cli.parsing import command, option_of
from services.common.endpoints import LOOPBACK
from services.common.errors import InputError
from services.common.options import whole

if TYPE_CHECKING:
    from services.cluster.run import ClusterCredentials
    from services.execution.dispatch import CrossingExecutor
    from services.execution.scheduler import Credentials

_PROCESSES: Final = "processes"
_MOST: Final = 256


def add_cluster(commands: Any) -> None:
    """Add `driveby cluster`: run a Dask scheduler and workers on this machine."""
    p = command(
        commands,
        "cluster",
        _cluster,
        "run a Dask scheduler and workers on this machine, for `identify --scheduler`",
        "driveby cluster --workers 4",
    )
    p.add_argument(
        "--workers",
        type=whole("a number of workers", 1, _MOST),
        default=_cores(),
        metavar="N",
        help="number of workers (default: one for each processor)",
    )
    p.add_argument(
        "--port",
        type=whole("a port", 1, 65535),
        default=8786,
        help="port of the scheduler (default: 8786)",
    )
    p.add_argument(
        "--listen",
        default=LOOPBACK,
        metavar="ADDRESS",
        help=f"of this machine; any other than {LOOPBACK} needs --tls (default: {LOOPBACK})",
    )
    p.add_argument(
        "--tls",
        type=Path,
        metavar="FOLDER",
        help="folder made by `driveby certs FOLDER --cluster`, with scheduler, cluster-worker "
        "and client",
    )
    p.add_argument(
        "--memory",
        default="auto",
        metavar="SIZE",
        help="memory limit of a worker, e.g. 2GiB (default: auto, its share of this machine's)",
    )


def check_scheduler(options: IdentifyOptions) -> None:
    """Raise InputError for an invalid `--scheduler`, before anything is started."""
    said: str | None = options.scheduler
    is_cluster = said is not None and said.partition(":")[0] != _PROCESSES
    for name in ("tls", "batch", "reconnect_timeout"):
        if getattr(options, name) is not None and not is_cluster:
            raise InputError(
                f"{option_of(name)}: belongs to a cluster, --scheduler tcp://… or tls://…"
            )
    if said is not None and not is_cluster:
        _number(said)
    if is_cluster:
        from services.execution.scheduler import check_address

        check_address(str(said), _credentials(options))


@contextmanager
def execution_of(options: IdentifyOptions) -> "Iterator[CrossingExecutor | None]":
    """Run the executor of `--scheduler`, started at entry; None without the option."""
    said: str | None = options.scheduler
    if said is None:
        yield None
    elif said.partition(":")[0] == _PROCESSES:
        from services.execution.processes import ProcessExecutor

        with ProcessExecutor(_number(said)) as processes:
            yield processes
    else:
        from services.execution.cluster import BATCH, PATIENCE_S, DaskExecutor

        with DaskExecutor(
            said,
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


def _number(said: str) -> int:
    _, _, text = said.partition(":")
    if said == _PROCESSES:
        return _cores()
    try:
        number = int(text)
    except ValueError:
        number = 0
    if not 1 <= number <= _MOST:
        raise InputError(f"--scheduler: is {said!r}, the number must be from 1 to {_MOST}")
    return number


def _cores() -> int:
    return min(os.cpu_count() or 1, _MOST)


def _roles(folder: Path) -> "ClusterCredentials":
    from services.cluster.run import ClusterCredentials

    if not folder.is_dir():
        raise InputError(f"--tls: {folder} is no folder; driveby certs {folder} --cluster makes it")
    names = ("scheduler", "cluster-worker", "client")
    return ClusterCredentials(*(credentials_of(folder / name, name) for name in names))


def _cluster(options: argparse.Namespace) -> int:
    from services.cluster.run import ClusterConfig, run

    return run(
        ClusterConfig(
            options.workers,
            options.listen,
            options.port,
            None if options.tls is None else _roles(options.tls),
            options.memory,
        )
    )


SERVICES: Final = (_cluster,)
"""Handlers that run until they are stopped, and whose log is their only output."""
