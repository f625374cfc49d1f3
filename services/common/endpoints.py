"""Where the router is unless somebody says otherwise; `--help` says it without loading the bus."""

from pathlib import Path
from typing import Final

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
LOOPBACK: Final = "127.0.0.1"
DEFAULT_TLS_ENDPOINT: Final = "tls/127.0.0.1:7447"


def default_endpoint(tls: Path | None) -> str:
    """Where a logger listens and the others connect, with and without credentials."""
    return DEFAULT_ENDPOINT if tls is None else DEFAULT_TLS_ENDPOINT
