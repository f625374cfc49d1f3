"""Display of a recording, a result or a Rerun file in the Rerun viewer.

The viewer listens on 127.0.0.1 only and its analytics are switched off. Background tiles of the map
come from the internet when there is one; tracks and bridges are drawn without.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator
from importlib import resources
from pathlib import Path

from google.protobuf.message import DecodeError
from rich.console import Console

from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult, load_results
from schemas.results_on_the_wire import estimate_to_crossing
from schemas.site_file import load_site
from schemas.topics import Message
from services.catalogue.contents import summarise_recording
from services.common.errors import FailureError, InputError
from services.common.progress import (
    Offset,
    Steps,
    no_progress,
    no_step_progress,
    progress_bar,
)
from services.finding.drive import Drives
from services.ledger.site_of_results import site_of_results
from services.recordings.recording import check_envelope, check_message, read_messages
from services.viewer.bridge_view import views_of_bridges
from services.viewer.crossing_view import ResidualCells
from services.viewer.recording_page import detected_views, recording_page
from services.viewer.rerun_file import RerunContent, write_rrd
from services.viewer.residuals import residual_cells
from services.viewer.vehicle_signals import signals_of

SUFFIXES = (".rrd", ".mcap", ".json")
_SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
"""Variables of which a screen on Linux sets at least one."""
_MAX_RESIDUALS = 3
"""Maximum number of crossings with residuals, as the user waits; `identify` computes more."""


def view_command(*, target: str | Path, web: bool, console: Console) -> int:
    """Open a Rerun file (.rrd), a recording (.mcap) or results (.json) until it is closed.

    `web` serves the viewer for a browser instead of opening a window. Return the exit code. Raise
    InputError for a missing or unknown file, FailureError if the viewer does not start.
    """
    path = Path(target)
    if not path.is_file():
        raise InputError(f"{path}: no such file, one of {', '.join(SUFFIXES)} is expected")
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: is not one of {', '.join(SUFFIXES)}")
    prepare_viewer(window=not web)
    with tempfile.TemporaryDirectory(prefix="driveby-view-") as folder:
        shown = path
        if path.suffix != ".rrd":
            shown = Path(folder) / f"{path.stem}.rrd"
            with progress_bar(console) as bar:
                reading = bar.add_task(f"reading {path.name}", total=path.stat().st_size)
                drawn = bar.add_task("drawing", total=None, visible=False)
                convert(
                    path,
                    shown,
                    progress=lambda offset: bar.update(reading, completed=offset),
                    drawing=lambda done, steps: bar.update(
                        drawn, completed=done, total=steps, visible=True
                    ),
                )
        return run_viewer(shown, web=web)


def convert(
    target: Path,
    rrd: Path,
    *,
    site: Path | None = None,
    progress: Offset = no_progress,
    drawing: Steps = no_step_progress,
) -> None:
    """Write the Rerun file of a recording (.mcap) or of results (.json).

    `progress` is called while the recording is read, `drawing` while the file is written.

    Results do not contain the position of their bridge: `site` does, or a recording in the same
    folder. Crossings of a recording that were not identified are shown with their signals.
    """
    if target.suffix == ".json":
        results = load_results(target)
        bridges = site_of_results(target, results, site)
        states = views_of_bridges(results, bridges, (site or target).parent)
        write_rrd(rrd, RerunContent({}, results.crossings, bridges, states), drawing)
        return
    drives, estimates = Drives(), list[Message]()

    def take(message: Message) -> None:
        if message.key.owner == "vehicle":
            check_envelope(target, message)
            if not drives.add(message):  # decodable messages are valid
                check_message(target, message)
        elif message.key.stream == "estimate":
            estimates.append(message)

    with _paused_gc():
        found = summarise_recording(
            target, None if site is None else load_site(site), take, progress
        )
    if not found.info.messages:
        raise InputError(f"{target}: holds no driveby message; a recording of a truck is expected")
    crossings = crossings_of_messages(estimates)
    residuals: dict[str, ResidualCells] = {}
    if crossings and found.site is not None:
        messages = read_messages(target)
        residuals = residual_cells(crossings, messages, found.site, most=_MAX_RESIDUALS)
    content = RerunContent(
        signals_of(drives.all()),
        crossings,
        found.site,
        residuals=residuals,
        passings=detected_views(found, crossings),
        about=recording_page(found),
    )
    write_rrd(rrd, content, drawing)


@contextlib.contextmanager
def _paused_gc() -> Iterator[None]:
    """Pause the search for reference cycles among messages, a fifth of the time.

    There are no cycles in messages.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def crossings_of_messages(messages: Iterable[Message]) -> list[CrossingResult]:
    """Return the results in a recording; undecodable ones are skipped."""
    crossings = []
    for message in messages:
        if message.key.stream != "estimate":
            continue
        try:
            crossing, _ = estimate_to_crossing(pb.Estimate.FromString(message.payload))
        except (DecodeError, ValueError):
            continue
        crossings.append(crossing)
    return crossings


def viewer_program() -> Path:
    """Return the viewer itself: the `rerun` wrapper leaves it running when killed."""
    return Path(str(resources.files("rerun_cli") / "rerun"))


def viewer_arguments(shown: Path | str, *, web: bool, address: str = "127.0.0.1") -> list[str]:
    """Return the command line of the viewer of a file or a server.

    It listens at one address; without `--bind` it would listen on every interface.
    """
    arguments = [str(viewer_program()), "--bind", address, "--port", "auto"]
    if web:
        arguments += ["--web-viewer", "--web-viewer-port", "0"]
    return [*arguments, str(shown)]


def prepare_viewer(*, window: bool) -> None:
    """Switch the viewer's statistics off.

    Raise FailureError if the viewer is not installed, or if there is no screen for a `window`: it
    would print ten log lines of its own.
    """
    linux = sys.platform.startswith("linux")
    if window and linux and not any(os.environ.get(name) for name in _SCREENS):
        raise FailureError("no screen for a window (DISPLAY is not set); try --web")
    program = viewer_program()
    if not program.is_file():
        raise FailureError(f"{program}: the Rerun viewer is not installed for this platform")
    subprocess.run([program, "analytics", "disable"], check=False, capture_output=True)


def check_ended_well(code: int) -> None:
    """Raise FailureError if the viewer ended other than by being closed."""
    if code not in (0, -signal.SIGTERM):
        raise FailureError(f"the Rerun viewer ended with code {code}; without a screen, try --web")


def run_viewer(shown: Path, *, web: bool) -> int:
    """Show a Rerun file until it is closed; return the exit code.

    Raise FailureError if the viewer did not start, or ended abnormally.
    """
    prepare_viewer(window=not web)
    # The viewer would keep running if only this program received the signal to stop, also while the
    # viewer is being started.
    stop_requested = threading.Event()
    previous = signal.signal(signal.SIGTERM, lambda *_: stop_requested.set())
    try:
        with subprocess.Popen(viewer_arguments(shown, web=web)) as viewer:
            signal.signal(signal.SIGTERM, lambda *_: viewer.terminate())
            if stop_requested.is_set():
                viewer.terminate()
            try:
                code = viewer.wait()
            except KeyboardInterrupt:
                viewer.terminate()
                code = 0
    finally:
        signal.signal(signal.SIGTERM, previous)
    check_ended_well(code)
    return 0
