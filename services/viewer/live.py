"""`driveby view live`: what travels on a bus now, in the Rerun viewer.

This process is a subscriber as any other and needs nothing of the worker. It serves what it draws
to viewers: the one that it opens, and others that connect later, which get what happened before as
far as `_KEPT` goes. Beyond it the oldest is let go of.
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
from pathlib import Path
from typing import Final, Literal
from urllib.parse import quote

import rerun as rr

from schemas.site_file import load_site
from services.bus.listening import Listening, check_listenable, elsewhere_line, listening
from services.bus.playback import leave_at_once, stopped_by_signals
from services.common.errors import FailureError, InputError
from services.viewer.live_layout import WAITING, waiting_blueprint
from services.viewer.live_picture import LivePicture
from services.viewer.rerun_parts import log_markdown
from services.viewer.view import check_ended_well, prepare_viewer, viewer_arguments

_log = logging.getLogger(__name__)

APPLICATION: Final = "driveby-live"
_KEPT: Final = "256MB"
"""For viewers that come late."""
_PAST_S: Final = 60.0
"""Of what trucks measured before this command began, as far as they keep it."""
_PERIOD_S: Final = 0.5
"""How often what has come is drawn."""

_TRIES: Final = 120
"""How often it is looked whether the page is there."""

Show = Literal["window", "web"]


def live_command(
    *,
    endpoint: str,
    realm: str,
    site: Path | None,
    tls: Path | None,
    show: Show | None,
    address: str,
    port: int,
    say: Callable[[str], None],
) -> int:
    """Show a realm until the viewer is closed or a signal comes; return 0.

    `show` None: only serve it. Viewers connect to `address`, at a `port` (0: any that is free).
    Waits for the router for ever.

    InputError: a bad realm, site file or address. FailureError: the port is taken, or there is no
    viewer or it fails.
    """
    check_listenable(realm)
    known = None if site is None else load_site(site)
    _check_address(address)
    chosen = _free_port(address, port)
    if show is not None:
        prepare_viewer()
    with (
        stopped_by_signals(leave_at_once) as stop,
        rr.RecordingStream(APPLICATION) as recording,
    ):
        sink = rr.GrpcServerSink(address, chosen, server_memory_limit=_KEPT)
        recording.set_sinks(sink)
        recording.send_recording_name(realm)
        recording.send_blueprint(waiting_blueprint())
        log_markdown(recording, WAITING, f"Waiting for a router at {endpoint}.")
        say(f"realm {realm}, live at {sink.uri}; more viewers: rerun {sink.uri}")
        with _viewer(sink.uri, show, address, say) as viewer:

            def is_over() -> bool:
                return stop.is_set() or _has_ended(viewer)

            with listening(endpoint, tls, realm, is_over, past_s=_PAST_S) as heard:
                if heard is not None:
                    _draw(recording, LivePicture(recording, known), heard, stop, is_over)
        recording.disconnect()
    if viewer is not None and not stop.is_set():
        check_ended_well(viewer.returncode)
    return 0


def _draw(
    recording: rr.RecordingStream,
    picture: LivePicture,
    heard: Listening,
    stop: threading.Event,
    is_over: Callable[[], bool],
) -> None:
    """Draw what comes until the viewer is closed or a signal comes."""
    shown = ""
    while not is_over():
        for one in heard.heard():
            picture.take(one)
            if stop.is_set():
                return
        picture.flush()
        if picture.is_empty:
            hint = elsewhere_line(heard.realm, heard.elsewhere)
            page = f"# Realm {heard.realm}\n\nNobody drives yet.\n\n{hint or ''}"
            if page != shown:
                log_markdown(recording, WAITING, page)
                shown = page
                if hint is not None:
                    _log.warning("%s", hint)
        stop.wait(_PERIOD_S)


@contextlib.contextmanager
def _viewer(
    uri: str, show: Show | None, address: str, say: Callable[[str], None]
) -> Iterator[subprocess.Popen[bytes] | None]:
    """The viewer of a server; it ends with this."""
    if show is None:
        yield None
        return
    arguments = viewer_arguments(uri, web=False, address=address)
    if show == "web":
        port = _free_port(address, 0)
        arguments[1:1] = ["--serve-web", "--web-viewer-port", str(port)]
        # The words in its pictures are meant for a dark page.
        page = f"http://{address}:{port}?url={quote(uri, safe='')}&theme=dark"
        say(f"in a browser: {page}")
        threading.Thread(target=_open_browser, args=(page, address, port), daemon=True).start()
    # Of a Ctrl-C this process hears, and ends the viewer.
    with subprocess.Popen(arguments, start_new_session=True) as process:
        try:
            yield process
        finally:
            process.terminate()


def _open_browser(page: str, address: str, port: int) -> None:
    """Open a page as soon as it is served; who has no browser here has been told where it is."""
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
            f"--listen {address}: is no IPv4 address; one of this machine is expected, as 127.0.0.1"
        ) from None
    if not ip.is_loopback:
        _log.warning("whoever reaches %s sees what is shown: nobody is asked who they are", address)


def _free_port(address: str, port: int) -> int:
    """A port at which nobody listens: Rerun takes another one's for its own without a word."""
    with socket.socket() as probe:
        try:
            probe.bind((address, port))
        except OSError as error:
            raise FailureError(
                f"cannot listen at {address}, port {port}: {error.strerror}; give another --port"
            ) from None
        return int(probe.getsockname()[1])
