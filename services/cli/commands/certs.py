"""The command `driveby certs`: certificates of the bus and of clusters."""

from typing import Final

from services.cli.parser import Subcommand
from services.security.settings import CertsSettings


def _certs(asked: CertsSettings) -> int:
    from services.security.certs import certs_command

    print("\n".join(certs_command(asked)))
    return 0


COMMAND: Final = Subcommand(
    CertsSettings,
    "driveby certs certs --trucks truck-1,truck-2 --host logger.example.org",
    _certs,
)
