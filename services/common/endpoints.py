"""The default endpoint of the router, known to `--help` without loading the bus."""

from pathlib import Path
from typing import Final

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
LOOPBACK: Final = "127.0.0.1"
DEFAULT_TLS_ENDPOINT: Final = "tls/127.0.0.1:7447"


def default_endpoint(tls: Path | None) -> str:
    """Return the default endpoint of a logger and its clients, with or without credentials."""
    return DEFAULT_ENDPOINT if tls is None else DEFAULT_TLS_ENDPOINT


class BusOptions:
    """Options of a command that connects to a logger."""

    endpoint: str | None
    tls: Path | None

    @property
    def address(self) -> str:
        """Address of the bus."""
        return self.endpoint or default_endpoint(self.tls)
