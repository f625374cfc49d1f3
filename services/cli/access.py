"""The command for certificates of the bus and of clusters: certs."""

import argparse
from pathlib import Path
from typing import Any

from services.cli.parsing import command, names, whole


def add_certs(commands: Any) -> None:
    """Add `driveby certs`: make certificates and access control for a bus between machines."""
    p = command(
        commands,
        "certs",
        _certs,
        "make certificates and access control for a bus between machines",
        "driveby certs certs --trucks truck-1,truck-2 --host logger.example.org",
    )
    p.add_argument(
        "folder",
        type=Path,
        metavar="FOLDER",
        help="folder of credentials; the first run makes an authority, router, logger, worker, "
        "viewer and replay",
    )
    p.add_argument(
        "--cluster",
        action="store_true",
        help="make an authority for a Dask cluster, with scheduler, cluster-worker and client",
    )
    p.add_argument(
        "--trucks", type=names, default=(), metavar="ID,…", help="names of trucks to add"
    )
    p.add_argument(
        "--add",
        type=names,
        default=(),
        metavar="ROLE/NAME,…",
        help="roles to add, e.g. viewer/anna",
    )
    p.add_argument(
        "--host",
        nargs="+",
        default=(),
        metavar="NAME",
        help="names and addresses of the machines of router and logger, besides this machine",
    )
    p.add_argument(
        "--days",
        type=whole("days", 1, 3650),
        default=365,
        metavar="N",
        help="how long the new certificates are valid (default: 365)",
    )
    p.add_argument(
        "--renew",
        type=names,
        default=(),
        metavar="NAME,…",
        help="names that get a new key and certificate",
    )
    p.add_argument(
        "--revoke", type=names, default=(), metavar="NAME,…", help="names to exclude from now on"
    )


def _certs(options: argparse.Namespace) -> int:
    from services.security.certs import certs_command

    lines = certs_command(
        folder=options.folder,
        trucks=options.trucks,
        others=options.add,
        renew=options.renew,
        revoke=options.revoke,
        hosts=options.host,
        days=options.days,
        is_cluster=options.cluster,
    )
    print("\n".join(lines))
    return 0
