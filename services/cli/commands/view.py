"""The command `driveby view`: a file, or the live bus, in the Rerun viewer."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.common.endpoints import LOOPBACK, default_endpoint
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

_LIVE: Final = "live"


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """A file or the bus to show, and where viewers connect."""

    target: str = positional(
        "a .mcap, .json or .rrd file; live: the messages on the bus",
        metavar="REC|RESULT|RRD|live",
    )
    web: bool = flag("in the browser")
    endpoint: str | None = endpoint_option(group=_LIVE)
    tls: Path | None = tls_option(group=_LIVE)
    realm: str = realm_option(group=_LIVE)
    site: Path | None = site_option(
        "site file of the bridges (without it results are shown, but no plan)", group=_LIVE
    )
    serve: bool = flag(
        "serve only; viewers that connect later receive the buffered history", group=_LIVE
    )
    listen: str = opt(
        f"where viewers connect (default: {LOOPBACK}, this machine only)",
        default=LOOPBACK,
        group=_LIVE,
        metavar="ADDRESS",
    )
    port: int = opt(
        "port of the server (default: any that is free)",
        whole("a port", 0, 65_535),
        default=0,
        group=_LIVE,
    )


def _view(asked: ViewOptions) -> int:
    if asked.target == "live":
        from services.viewer.live import live_command

        return live_command(
            endpoint=asked.endpoint or default_endpoint(asked.tls),
            realm=asked.realm,
            site=asked.site,
            tls=asked.tls,
            show=None if asked.serve else "web" if asked.web else "window",
            address=asked.listen,
            port=asked.port,
            print_line=lambda line: print(line, flush=True),
        )
    from services.viewer.view import view_command

    return view_command(target=asked.target, web=asked.web, console=a_console())


VIEW: Final = Subcommand(
    "view",
    ViewOptions,
    "open a recording, a result or the live bus in the Rerun viewer",
    "driveby view run.mcap --web",
    _view,
)
