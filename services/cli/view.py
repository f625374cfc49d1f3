"""The command `driveby view`: a file, or the live bus, in the Rerun viewer."""

import argparse
from typing import Any

from services.cli.parsing import a_console, add_endpoint, add_realm, add_site, command
from services.common.endpoints import LOOPBACK, default_endpoint
from services.common.options import whole


def add_view(commands: Any) -> None:
    """Add `driveby view`: open a recording, a result or the live bus in the Rerun viewer."""
    p = command(
        commands,
        "view",
        _view,
        "open a recording, a result or the live bus in the Rerun viewer",
        "driveby view run.mcap --web",
    )
    p.add_argument(
        "target",
        metavar="REC|RESULT|RRD|live",
        help="a .mcap, .json or .rrd file; live: the messages on the bus",
    )
    p.add_argument("--web", action="store_true", help="in the browser")
    live = p.add_argument_group("live")
    add_endpoint(live)
    add_realm(live)
    add_site(live, "site file of the bridges (without it results are shown, but no plan)")
    live.add_argument(
        "--serve",
        action="store_true",
        help="serve only; viewers that connect later receive the buffered history",
    )
    live.add_argument(
        "--listen",
        metavar="ADDRESS",
        default=LOOPBACK,
        help=f"where viewers connect (default: {LOOPBACK}, this machine only)",
    )
    live.add_argument(
        "--port",
        type=whole("a port", 0, 65_535),
        default=0,
        help="port of the server (default: any that is free)",
    )


def _view(options: argparse.Namespace) -> int:
    if options.target == "live":
        from services.viewer.live import live_command

        return live_command(
            endpoint=options.endpoint or default_endpoint(options.tls),
            realm=options.realm,
            site=options.site,
            tls=options.tls,
            show=None if options.serve else "web" if options.web else "window",
            address=options.listen,
            port=options.port,
            print_line=lambda line: print(line, flush=True),
        )
    from services.viewer.view import view_command

    return view_command(target=options.target, web=options.web, console=a_console())
