"""Options of `driveby truck` and `driveby gateway`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from services.common.endpoints import BusOptions
from services.common.options import (
    endpoint_option,
    flag,
    opt,
    positional,
    realm_option,
    site_option,
    speed_option,
    tls_option,
    whole,
)


def _spool_option() -> Any:
    text = "folder that keeps every message until a logger has it; one for each truck"
    return opt(text, Path, metavar="DIR")


def _spool_budget_option() -> Any:
    return opt(
        "size limit of the spool in MiB; beyond it the oldest messages are dropped (default: 4096)",
        whole("MiB", 1, 1 << 30),
        default=4096,
        metavar="MIB",
    )


@dataclass(frozen=True, kw_only=True)
class TruckSettings(BusOptions):
    """Options of `driveby truck`: a recording, and the bus on which it is published."""

    recording: Path = positional(
        "measurements to publish: a recording, or a folder of CSV files with --site",
        Path,
        metavar="REC.mcap | DIR",
    )
    site: Path | None = site_option(
        "site file for a folder of CSV files (a recording carries its own)"
    )
    spool: Path | None = _spool_option()
    spool_budget: int = _spool_budget_option()
    endpoint: str | None = endpoint_option()
    tls: Path | None = tls_option()
    realm: str = realm_option()
    speed: float = speed_option(
        1.0,
        other="; at other values than 1 the logger reports a wrong clock of the truck, except in "
        "realms sim-…",
    )
    skip_gaps: bool = flag("skip gaps of more than 2 s, as between runs")
    vehicle: str | None = opt(
        "identifier of the vehicle to publish, where there are several", metavar="ID"
    )


@dataclass(frozen=True, kw_only=True)
class GatewaySettings(BusOptions):
    """Options of `driveby gateway`: a ROS 2 router, its truck, and the bus for its data."""

    what: str = positional(
        "ros2: a ROS 2 truck with rmw_zenoh, see docs/truck.md", choices=("ros2",)
    )
    ros: str = opt(
        "address of rmw_zenoh's router, e.g. tcp/127.0.0.1:7447",
        required=True,
        metavar="ENDPOINT",
    )
    site: Path = site_option("site file of the truck, with its topics in [ros2]", required=True)
    vehicle: str | None = opt("identifier of the site's vehicle", metavar="ID")
    spool: Path | None = _spool_option()
    spool_budget: int = _spool_budget_option()
    endpoint: str | None = endpoint_option()
    tls: Path | None = tls_option()
    realm: str = realm_option()
