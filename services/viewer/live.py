"""`driveby view live`: the messages of a realm, live in the Rerun viewer.

This process is a subscriber as any other and needs nothing of the worker. It serves its pictures to
the viewer that it opens, and to others that connect later, which receive the history in the limits
of `_KEPT`; older data are dropped.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import socket
import subprocess
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from typing import Final
from urllib.parse import quote

import rerun as rr

from schemas.site_file import load_site
from services.bus.playback import leave_at_once, stopped_by_signals
from services.bus.realm_listener import (
    RealmListener,
    open_listener,
    other_realms_hint,
)
from services.bus.session import checked_realm
from services.common.errors import FailureError, InputError
from services.common.parquet_files import arrow
from services.viewer.live_layout import WAITING, waiting_blueprint
from services.viewer.live_view import LiveView
from services.viewer.rerun_parts import log_markdown
from services.viewer.settings import Show, ViewSettings
from services.viewer.view import check_ended_well, prepare_viewer, viewer_arguments

_log = logging.getLogger(__name__)

APPLICATION: Final = "driveby-live"
_KEPT: Final = "256MB"
"""Memory of the history for viewers that connect later."""
_PAST_S: Final = 60.0
"""Time in s of measurements before the start, as far as trucks keep them."""
_PERIOD_S: Final = 0.5
"""Interval in s at which new data are drawn."""

_TRIES: Final = 120
"""Number of checks whether the page is available."""


def live_command(asked: ViewSettings, print_line: Callable[[str], None]) -> int:
    """Show a realm until the viewer is closed or a signal arrives; return 0.

    Viewers connect to the address `listen`, at a `port` (0: any free one). The command waits for
    the router without limit.

    Raise InputError for a bad realm, site file or address, FailureError if the port is taken, or
    the viewer is absent or fails.
    """
    realm, show, address = asked.realm, asked.show, asked.listen
    checked_realm(realm)
    known = None if asked.site is None else load_site(asked.site)
    _check_address(address)
    chosen = _free_port(address, asked.port)
    if show is not None:
        prepare_viewer(window=show == "window")
    arrow()  # before Rerun's first list
    with (
        stopped_by_signals(leave_at_once) as stop,
        rr.RecordingStream(APPLICATION) as recording,
    ):
        sink = rr.GrpcServerSink(address, chosen, server_memory_limit=_KEPT)
        recording.set_sinks(sink)
        recording.send_recording_name(realm)
        recording.send_blueprint(waiting_blueprint())
        log_markdown(recording, WAITING, f"Waiting for a router at {asked.address}.")
        print_line(f"realm {realm}, live at {sink.uri}; more viewers: rerun {sink.uri}")
        with _viewer(sink.uri, show, address, print_line) as viewer:

            def is_over() -> bool:
                return stop.is_set() or _has_ended(viewer)

            with open_listener(asked.address, asked.tls, realm, is_over, past_s=_PAST_S) as heard:
                if heard is not None:
                    _draw(recording, LiveView(recording, known), heard, stop, is_over)
        recording.disconnect()
    if viewer is not None and not stop.is_set():
        check_ended_well(viewer.returncode)
    return 0


def _draw(
    recording: rr.RecordingStream,
    picture: LiveView,
    heard: RealmListener,
    stop: threading.Event,
    is_over: Callable[[], bool],
) -> None:
    """Draw new data until the viewer is closed or a signal arrives."""
    shown = ""
    while not is_over():
        for one in heard.heard():
            picture.ingest(one)
            if stop.is_set():
                return
        picture.flush()
        if picture.is_empty:
            hint = other_realms_hint(heard.realm, heard.elsewhere)
            page = f"# Realm {heard.realm}\n\nNo trucks yet.\n\n{hint or ''}"
            if page != shown:
                log_markdown(recording, WAITING, page)
                shown = page
                if hint is not None:
                    _log.warning("%s", hint)
        stop.wait(_PERIOD_S)


@contextlib.contextmanager
def _viewer(
    uri: str, show: Show | None, address: str, print_line: Callable[[str], None]
) -> Iterator[subprocess.Popen[bytes] | None]:
    """Run the viewer of a server; end it with the context."""
    if show is None:
        yield None
        return
    arguments = viewer_arguments(uri, web=False, address=address)
    if show == "web":
        port = _free_port(address, 0)
        arguments[1:1] = ["--serve-web", "--web-viewer-port", str(port)]
        # The texts in its pictures are meant for a dark page.
        page = f"http://{address}:{port}?url={quote(uri, safe='')}&theme=dark"
        print_line(f"in a browser: {page}")
        threading.Thread(target=_open_browser, args=(page, address, port), daemon=True).start()
    # This process handles a Ctrl-C, and ends the viewer.
    with subprocess.Popen(arguments, start_new_session=True) as process:
        try:
            yield process
        finally:
            process.terminate()


def _open_browser(page: str, address: str, port: int) -> None:
    """Open a page as soon as it is served; its address was printed for use without a browser."""
    for _ in range(_TRIES):
        with contextlib.suppress(OSError), socket.create_connection((address, port), 1.0):
            webbrowser.open(page)
            return
        time.sleep(_PERIOD_S)


def _has_ended(viewer: subprocess.Popen[bytes] | None) -> bool:
    return viewer is not None and viewer.poll() is not None


def _check_address(address: str) -> None:
    try:
        ip = ipaddress.IPv4Address(address)
    except ValueError:
        raise InputError(
            f"--listen {address}: is not an IPv4 address; one of this machine is expected, such as "
            "127.0.0.1"
        ) from None
    if not ip.is_loopback:
        _log.warning("%s is not authenticated: anyone who can reach it sees the view", address)


def _free_port(address: str, port: int) -> int:
    """Return a free port: Rerun would accept one of another process without a message."""
    with socket.socket() as probe:
        try:
            probe.bind((address, port))
        except OSError as error:
            raise FailureError(
                f"cannot listen at {address}, port {port}: {error.strerror}; give another --port"
            ) from None
        return int(probe.getsockname()[1])
