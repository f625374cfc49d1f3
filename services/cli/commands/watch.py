"""The command `driveby watch`: a realm as a page on a terminal, elsewhere line by line."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.common.endpoints import BusOptions
from services.common.options import endpoint_option, realm_option, tls_option

if TYPE_CHECKING:
    from rich.console import Console

    from services.bus.realm_listener import RealmListener
    from services.cli.realm_model import RealmModel

_PERIOD_S: Final = 0.25
"""Interval in s at which the page is drawn."""
_HINT_AFTER_S: Final = 2.0
"""Silence in s after which a hint names other realms."""


@dataclass(frozen=True, kw_only=True)
class WatchOptions(BusOptions):
    """A realm to show."""

    endpoint: str | None = endpoint_option()
    tls: Path | None = tls_option()
    realm: str = realm_option()


def _watch(asked: WatchOptions) -> int:
    """Show a realm until a signal arrives; return 0. Wait for the router without limit.

    InputError: a bad realm, endpoint or credentials.
    """
    from services.bus.playback import leave_at_once, stopped_by_signals
    from services.bus.realm_listener import open_listener, sees_trucks
    from services.cli.realm_model import RealmModel

    endpoint, console = asked.address, a_console()
    with (
        stopped_by_signals(leave_at_once) as stop,
        open_listener(endpoint, asked.tls, asked.realm, stop.is_set) as heard,
    ):
        if heard is None:
            return 0
        model = RealmModel(
            sees_trucks=sees_trucks(asked.tls, asked.realm), began_s=time.monotonic()
        )
        if console.is_terminal:
            _show_page(model, heard, endpoint, stop, console)
        else:
            _print_lines(model, heard, stop, lambda line: print(line, flush=True))
    return 0


def _show_page(
    model: "RealmModel",
    listening: "RealmListener",
    endpoint: str,
    stop: threading.Event,
    console: "Console",
) -> None:
    from rich.live import Live

    from services.cli.watch_page import page

    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        while not stop.is_set():
            for heard in listening.heard():
                model.ingest(heard, time.monotonic(), time.time_ns())
            where = f"realm {listening.realm} at {endpoint}"
            shown = page(
                model,
                where,
                listening,
                now_s=time.monotonic(),
                now_ns=time.time_ns(),
                width=console.width,
                height=console.height - 1,
            )
            live.update(shown, refresh=True)
            stop.wait(_PERIOD_S)


def _print_lines(
    model: "RealmModel",
    listening: "RealmListener",
    stop: threading.Event,
    write: Callable[[str], None],
) -> None:
    from services.bus.realm_listener import other_realms_hint
    from services.cli.presence_lines import NOTHING_ABSENT, presence_lines
    from services.cli.watch_page import NO_ALARM, NO_WORKER, has_worker

    began_s = time.monotonic()
    hinted, absent, is_monitoring_named = "", NOTHING_ABSENT, False
    is_worker_named = False

    def print_line(line: str | None) -> None:
        if line is not None:
            write(f"{datetime.now(UTC):%H:%M:%S} {line}")

    while not stop.is_set():
        for heard in listening.heard():
            now_s = time.monotonic()
            print_line(model.ingest(heard, now_s, time.time_ns()))
        now_s = time.monotonic()
        absent, lines = presence_lines(absent, model, listening, now_s, time.time_ns())
        for line in lines:
            print_line(line)
        is_empty = not model.trucks and not model.crossings
        if not is_empty and not is_worker_named and now_s - began_s > _HINT_AFTER_S:
            is_worker_named = True
            if not has_worker(model, absent.services.keys(), now_s):
                print_line(NO_WORKER)
        hint = other_realms_hint(listening.realm, listening.elsewhere) or ""
        if is_empty and hint != hinted and now_s - began_s > _HINT_AFTER_S:
            hinted = hint
            print_line(hint or None)
        if model.alarms:
            is_monitoring_named = True
        if model.bridges and not is_monitoring_named and now_s - began_s > _HINT_AFTER_S:
            is_monitoring_named = True
            print_line(NO_ALARM)
        stop.wait(_PERIOD_S)


COMMAND: Final = Subcommand(
    WatchOptions,
    "driveby watch --realm sim-demo",
    _watch,
)
