"""`driveby watch`: what happens in a realm, on a terminal as a page, elsewhere line by line."""

import argparse
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from services.cli.parsing import a_console, add_endpoint, add_realm, command
from services.common.endpoints import default_endpoint

if TYPE_CHECKING:
    from rich.console import Console

    from services.bus.listening import Listening

_PERIOD_S: Final = 0.25
"""How often the page is drawn."""
_HINT_AFTER_S: Final = 2.0
"""Who has heard nothing for so long may be in the wrong realm."""


def add_watch(commands: Any) -> None:
    """`driveby watch`: trucks, crossings and results as they come."""
    p = command(
        commands,
        "watch",
        _watch,
        "show trucks, crossings and results in the terminal as they arrive",
        "driveby watch --realm sim-demo",
    )
    add_endpoint(p)
    add_realm(p)


def _watch(options: argparse.Namespace) -> int:
    return watch_command(
        endpoint=options.endpoint or default_endpoint(options.tls),
        realm=options.realm,
        tls=options.tls,
        console=a_console(),
    )


def watch_command(*, endpoint: str, realm: str, tls: Path | None, console: "Console") -> int:
    """Show a realm until a signal comes; return 0. Waits for the router for ever.

    InputError: a bad realm, endpoint or credentials.
    """
    from services.bus.listening import listening
    from services.bus.playback import leave_at_once, stopped_by_signals

    with (
        stopped_by_signals(leave_at_once) as stop,
        listening(endpoint, tls, realm, stop.is_set) as heard,
    ):
        if heard is None:
            return 0
        if console.is_terminal:
            _show_page(heard, endpoint, stop, console)
        else:
            _print_lines(heard, stop, lambda line: print(line, flush=True))
    return 0


def _show_page(
    listening: "Listening", endpoint: str, stop: threading.Event, console: "Console"
) -> None:
    from rich.live import Live

    from services.cli.watch_page import page
    from services.cli.watched import Watched

    watched = Watched()
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        while not stop.is_set():
            for heard in listening.heard():
                watched.take(heard, time.monotonic(), time.time_ns())
            where = f"realm {listening.realm} at {endpoint}"
            shown = page(
                watched,
                where,
                listening,
                now_s=time.monotonic(),
                now_ns=time.time_ns(),
                width=console.width,
                height=console.height - 1,
            )
            live.update(shown, refresh=True)
            stop.wait(_PERIOD_S)


def _print_lines(listening: "Listening", stop: threading.Event, say: Callable[[str], None]) -> None:
    from services.bus.listening import elsewhere_line
    from services.cli.watch_page import silent_trucks
    from services.cli.watched import Watched

    watched = Watched()
    began_s = time.monotonic()
    hinted, silent = "", frozenset[str]()

    def tell(line: str | None) -> None:
        if line is not None:
            say(f"{datetime.now(UTC):%H:%M:%S} {line}")

    while not stop.is_set():
        for heard in listening.heard():
            now_s = time.monotonic()
            tell(watched.take(heard, now_s, time.time_ns()))
        now_s = time.monotonic()
        gone = silent_trucks(watched, now_s)
        for name in sorted(gone - silent):
            tell(f"{name} is silent")
        silent = gone
        hint = elsewhere_line(listening.realm, listening.elsewhere) or ""
        is_empty = not watched.trucks and not watched.crossings
        if is_empty and hint != hinted and now_s - began_s > _HINT_AFTER_S:
            hinted = hint
            tell(hint or None)
        stop.wait(_PERIOD_S)
