"""Ports on loopback at which nobody listens yet, for tests that may run side by side."""

import random
import socket

_PORTS = range(20_000, 32_000)
"""Below those that Linux gives to outgoing connections: none of these can take one meanwhile."""


def free_endpoint(protocol: str = "tcp") -> str:
    """An address as Zenoh writes it."""
    return f"{protocol}/127.0.0.1:{free_port()}"


def free_port() -> int:
    """A port drawn by the system: Hypothesis sets the seed of `random` anew for each test."""
    for port in random.SystemRandom().sample(_PORTS, 100):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError(f"100 ports of {_PORTS} are all taken")
