"""The command `driveby health`."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from services.cli.parser import Announce, ServiceCommand
from services.common.endpoints import BusOptions
from services.common.errors import InputError
from services.common.options import (
    endpoint_option,
    flag,
    opt,
    positional,
    tls_option,
)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not (port.isdecimal() and int(port) < 65536):
        raise argparse.ArgumentTypeError(f"{text!r}: a port or HOST:PORT is expected, e.g. 9464")
    return host.strip("[]") or "127.0.0.1", int(port)


@dataclass(frozen=True, kw_only=True)
class HealthOptions(BusOptions):
    """Services whose health is queried, and the form of the answer."""

    service: str | None = positional(
        "name of the service (its --id), such as logger; may be omitted with --metrics, which then "
        "queries all",
        nargs="?",
        metavar="ID",
    )
    metrics: bool = flag("print all figures in the format of Prometheus")
    serve: tuple[str, int] | None = opt(
        "with --metrics: HTTP address that answers /metrics until the command is stopped (default "
        "host: 127.0.0.1)",
        _address,
        metavar="[HOST:]PORT",
    )
    endpoint: str | None = endpoint_option()
    tls: Path | None = tls_option()
    realm: str = opt(
        "realm of the service; a logger of several realms answers in live (default: live)",
        default="live",
    )


def _health(options: HealthOptions, announce: Announce) -> int:
    asked: dict[str, Any] = {
        "service": options.service,
        "endpoint": options.address,
        "tls": options.tls,
        "realm": options.realm,
    }
    if options.metrics:
        from services.cli.metrics import metrics_command, serve_metrics

        if options.serve is None:
            print(metrics_command(**asked), end="")
        else:

            def ready(url: str) -> None:
                announce(f"ready, metrics at {url}")()

            serve_metrics(**asked, address=options.serve, ready=ready)
        return 0
    if options.serve is not None:
        raise InputError("--serve needs --metrics")
    if options.service is None:
        raise InputError("name the service, such as logger or worker; --metrics needs none")
    from services.cli.health import health_command

    print(health_command(**asked))
    return 0


COMMAND: Final = ServiceCommand(
    HealthOptions,
    "driveby health logger",
    _health,
)
