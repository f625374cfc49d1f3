"""Options of `driveby view`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from services.common.endpoints import LOOPBACK, BusOptions
from services.common.options import (
    endpoint_option,
    flag,
    opt,
    positional,
    realm_option,
    site_option,
    tls_option,
    whole,
)

Show = Literal["window", "web"]
"""Viewer that is opened."""
_LIVE: Final = "live"


@dataclass(frozen=True, kw_only=True)
class ViewSettings(BusOptions):
    """Options of `driveby view`: a file or the bus, and the address for viewers."""

    target: str = positional(
        "a .mcap, .json or .rrd file; live: the messages on the bus",
        metavar="REC|RESULT|RRD|live",
    )
    web: bool = flag("open in the browser")
    endpoint: str | None = endpoint_option(group=_LIVE)
    tls: Path | None = tls_option(group=_LIVE)
    realm: str = realm_option(group=_LIVE)
    site: Path | None = site_option(
        "site file of the bridges (without it results are shown, but no plan)", group=_LIVE
    )
    serve: bool = flag(
        "open no viewer; viewers that connect receive the buffered history", group=_LIVE
    )
    listen: str = opt(
        f"address for viewers (default: {LOOPBACK}, this machine only)",
        default=LOOPBACK,
        group=_LIVE,
        metavar="ADDRESS",
    )
    port: int = opt(
        "port of the server (default: any free port)",
        whole("a port", 0, 65_535),
        default=0,
        group=_LIVE,
    )

    @property
    def show(self) -> Show | None:
        """Viewer to open; None: serve only."""
        return None if self.serve else "web" if self.web else "window"
