"""The command for certificates of the bus and of clusters: certs."""

from typing import Final

from services.cli.parser import Subcommand
from services.security.settings import CertsSettings


def _certs(asked: CertsSettings) -> int:
    from services.security.certs import certs_command

    print("\n".join(certs_command(asked)))
    return 0


CERTS: Final = Subcommand(
    "certs",
    CertsSettings,
    "make certificates and access control for a bus between machines",
    "driveby certs certs --trucks truck-1,truck-2 --host logger.example.org",
    _certs,
)
