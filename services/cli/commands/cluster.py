"""The command `driveby cluster`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.parser import Subcommand
from services.cli.scheduler import MAX_PROCESSES, cores, credentials_of
from services.common.endpoints import LOOPBACK
from services.common.errors import InputError
from services.common.options import opt, whole

if TYPE_CHECKING:
    from services.cluster.run import ClusterCredentials


@dataclass(frozen=True, kw_only=True)
class ClusterOptions:
    """A scheduler and workers on this machine."""

    workers: int = opt(
        "number of workers (default: one for each processor)",
        whole("a number of workers", 1, MAX_PROCESSES),
        default=cores(),
        metavar="N",
    )
    port: int = opt(
        "port of the scheduler (default: 8786)", whole("a port", 1, 65535), default=8786
    )
    listen: str = opt(
        f"address to listen on; any other than {LOOPBACK} needs --tls (default: {LOOPBACK})",
        default=LOOPBACK,
        metavar="ADDRESS",
    )
    tls: Path | None = opt(
        "folder made by `driveby certs FOLDER --cluster`, with scheduler, cluster-worker "
        "and client",
        Path,
        metavar="FOLDER",
    )
    memory: str = opt(
        "memory limit of a worker, e.g. 2GiB (default: auto, its share of all memory)",
        default="auto",
        metavar="SIZE",
    )


def _roles(folder: Path) -> "ClusterCredentials":
    from services.cluster.run import ClusterCredentials

    if not folder.is_dir():
        raise InputError(
            f"--tls: {folder} is not a folder; driveby certs {folder} --cluster creates it"
        )
    names = ("scheduler", "cluster-worker", "client")
    return ClusterCredentials(*(credentials_of(folder / name, name) for name in names))


def _cluster(asked: ClusterOptions) -> int:
    from services.cluster.run import ClusterConfig, run

    roles = None if asked.tls is None else _roles(asked.tls)
    return run(ClusterConfig(asked.workers, asked.listen, asked.port, roles, asked.memory))


COMMAND: Final = Subcommand(
    ClusterOptions,
    "driveby cluster --workers 4",
    _cluster,
)
