"""Options of `driveby certs`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from services.common.options import count_option, flag, names, opt, positional


@dataclass(frozen=True, kw_only=True)
class CertsSettings:
    """Credentials to make in a folder, to renew and to revoke."""

    folder: Path = positional(
        "folder of credentials; the first run makes those of authority, router, logger, worker, "
        "viewer and replay",
        Path,
        metavar="FOLDER",
    )
    cluster: bool = flag(
        "make an authority for a Dask cluster, with scheduler, cluster-worker and client"
    )
    trucks: Sequence[str] = opt("names of trucks to add", names, default=(), metavar="ID,…")
    add: Sequence[str] = opt(
        "roles to add, e.g. viewer/anna", names, default=(), metavar="ROLE/NAME,…"
    )
    host: Sequence[str] = opt(
        "names and addresses of the machines of router and logger, in addition to this machine",
        default=(),
        nargs="+",
        metavar="NAME",
    )
    days: int = count_option("validity of the new certificates in days", "days", 365, 1, 3650)
    renew: Sequence[str] = opt(
        "names that get a new key and certificate", names, default=(), metavar="NAME,…"
    )
    revoke: Sequence[str] = opt("names to exclude from now on", names, default=(), metavar="NAME,…")
