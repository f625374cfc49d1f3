"""The command `driveby demo`: logger, worker and truck as three processes.

A crossing of the paper's scenario 6 (element 4 at 40 %) is simulated, published as a truck that
drives now, recorded by the logger, identified by the worker, received by this process as a
subscriber to the live result, and drawn. It can be watched live (`--live`).
"""

import contextlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from pre_core.paper import experiment
from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult, load_results
from schemas.results_on_the_wire import estimate_to_crossing
from schemas.site import Site
from schemas.site_file import site_toml
from services.bus.playback import set_by_signals
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.common.errors import FailureError, InputError
from services.common.files import write_atomically
from services.common.interrupts import handled_by
from services.recordings.recording import read_info, read_messages
from services.simulation.drive import (
    DrivenRoad,
    Measurement,
    SimulatedDrive,
    declared_site,
    paper_site,
    simulate_drive,
    write_drive,
)

if TYPE_CHECKING:
    from rich.console import Console

Live = Literal["window", "web"]
"""Display of a running demo."""

SCENARIO = 6
REALM = "sim-demo"
ROAD_CLASS = "A"
SEED = 1
"""Seed of the simulation; any other shows a crossing as well."""
_READY_S = 600.0
"""Longest time in s to readiness: compiling the kernels takes minutes on a slow or busy machine."""
_RESULT_S = 300.0
"""Longest time in s from the truck's last message to the result; the usual one is seconds."""
_STOP_S = 10.0
"""Longest time in s for the end of a service; nothing is running then."""
_RECORDING, _RESULTS, _TEXT = "recording.mcap", "results.mcap", "results.json"
_VIEWS, _FIGURE = "demo.rrd", "demo.png"
_INTERVAL = 0.95
"""Probability with which an interval contains its element's true value."""

_Printer = Callable[[str], None]


class _Services(NamedTuple):
    endpoint: str
    site: Path
    folder: Path
    method: str


def demo_command(
    *, out: Path | None, speed: float, noise: float, console: "Console", live: Live | None = None
) -> int:
    """Run the demonstration; 0 only if the crossing was recorded, identified and received.

    With a `noise` in µg/√Hz the receiver has realistic errors, too; with zero everything is exact,
    and the method is the one without a noise model. `live` shows it meanwhile, in a window or a
    browser, and afterwards until that is closed.

    Raise FailureError with the step that failed, InputError if the folder exists.
    """
    folder = _new_folder(out)
    try:
        return _run(folder, speed, noise, console, live)
    except KeyboardInterrupt:
        shutil.rmtree(folder, ignore_errors=True)  # half a demo is useless
        raise


def _run(folder: Path, speed: float, noise: float, console: "Console", live: Live | None) -> int:
    began = time.monotonic()
    with _terminated_as_interrupted(), contextlib.ExitStack() as watching:
        status = watching.enter_context(
            console.status("simulating a crossing of the paper's bridge", spinner="dots")
        )
        site = declared_site(paper_site(), noise, 1000.0)
        drive = simulate_drive(
            site,
            experiment.scenario_ratios(SCENARIO),
            DrivenRoad(ROAD_CLASS, SEED),
            Measurement(noise, has_receiver_errors=noise > 0.0),
        )
        temporary = Path(
            watching.enter_context(tempfile.TemporaryDirectory(prefix="driveby-demo-"))
        )
        source, site_path = temporary / "drive.mcap", temporary / "site.toml"
        sent = write_drive(source, drive, site)
        write_atomically(site_path, site_toml(site))
        method = "pre" if noise > 0.0 else "least-squares"
        services = _Services(_free_endpoint(), site_path, folder, method)
        view = None if live is None else watching.enter_context(_view(services, live))
        crossing = _live(services, source, speed, status.update)
        _check_recording(folder / _RECORDING, sent)
        status.update("drawing")
        _draw(folder, crossing, drive, site)
        status.stop()
        _print(console, crossing, drive, site)
        _print_outputs(console, folder, time.monotonic() - began)
        if view is not None:
            _wait_until_closed(view, console)
    return 0


@contextlib.contextmanager
def _view(services: _Services, live: Live) -> Iterator["_ChildProcess"]:
    """Run the live view in a process of its own; it closes its viewer when it is stopped."""
    where = ("--endpoint", services.endpoint, "--realm", REALM, "--site", str(services.site))
    web = ("--web",) if live == "web" else ()
    with _process(services.folder, "view", "live", *where, *web) as view:
        try:
            yield view
        finally:
            view.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                view.process.wait(timeout=_STOP_S)


def _wait_until_closed(view: "_ChildProcess", console: "Console") -> None:
    """Wait until the window is closed or the demo ended; results are printed before."""
    address = re.search(r"in a browser: (http://\S+)", view.log.read_text(errors="replace"))
    notice = "The live view stays until its window is closed, or Ctrl-C."
    if address is not None:
        notice = f"The live view stays until Ctrl-C, at {address[1]}"
    console.print(f"\n{notice}", soft_wrap=True)
    code: int | None = None
    with contextlib.suppress(KeyboardInterrupt):
        code = view.process.wait()
    if code:
        raise FailureError(f"the live view ended with {code}: {_last_line(view.log)}")


@contextlib.contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM end the processes too, as Ctrl-C does, instead of leaving them behind."""
    with handled_by(signal.default_int_handler, signal.SIGTERM):
        yield


def _new_folder(out: Path | None) -> Path:
    moment = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    folder = out or Path("recordings") / f"demo-{moment}"
    try:
        folder.mkdir(parents=True, exist_ok=False)
    except FileExistsError:
        raise InputError(f"{folder}: exists, the demo needs a new folder") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot be created: {error.strerror}") from None
    return folder


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _live(services: _Services, source: Path, speed: float, show: _Printer) -> CrossingResult:
    """Run the three processes until the result has been received; return it."""
    endpoint, site, folder, method = services
    common = ["--realm", REALM, "--site", str(site)]
    show("starting the logger, which hosts the router")
    with contextlib.ExitStack() as stack:
        logger = stack.enter_context(
            _process(
                folder, "logger", "--listen", endpoint, "--file", str(folder / _RECORDING), *common
            )
        )
        bus = stack.enter_context(open_session(connect=endpoint, timeout_s=_READY_S))
        health = stack.enter_context(
            Subscription(bus, f"driveby/v1/{REALM}/service/worker/health", capacity=100)
        )
        bridge = stack.enter_context(
            Subscription(bus, f"driveby/v1/{REALM}/bridge/**", capacity=1000)
        )
        show("starting the worker (the very first start compiles its kernels)")
        worker = stack.enter_context(
            _process(
                folder,
                "worker",
                *("--endpoint", endpoint, "--file", str(folder / _RESULTS), "--method", method),
                *common,
            )
        )
        _wait(health, lambda received: True, [logger, worker], _READY_S, "the worker is not ready")
        show(f"the truck drives, at {speed:g} times real speed")
        truck = stack.enter_context(
            _process(
                folder,
                "truck",
                str(source),
                *("--endpoint", endpoint, "--realm", REALM, "--speed", f"{speed:g}"),
            )
        )

        def is_estimate(received: RawSample) -> bool:
            if received.key().stream == "crossing":
                state = decode("driveby.v1.Crossing", received.payload)
                assert isinstance(state, pb.Crossing)  # noqa: S101 - by `decode`
                show(f"crossing {pb.CrossingState.Name(state.state).lower().replace('_', ' ')}")
            return received.key().stream == "estimate"

        estimate = _wait(
            bridge, is_estimate, [logger, worker, truck], _RESULT_S, "no result was received"
        )
        show("stopping")
        _finish(truck, None)
        _finish(worker, signal.SIGTERM)
        health.close()
        bridge.close()
        bus.close()  # type: ignore[no-untyped-call]
        _finish(logger, signal.SIGTERM)
    crossing, _ = estimate_to_crossing(pb.Estimate.FromString(estimate.payload))
    if crossing.parameters is None:
        raise FailureError(f"the crossing was rejected: {' '.join(crossing.reason_texts)}")
    return crossing


class _ChildProcess(NamedTuple):
    name: str
    process: subprocess.Popen[bytes]
    log: Path


@contextlib.contextmanager
def _process(folder: Path, name: str, *arguments: str) -> Iterator[_ChildProcess]:
    """Start a sub-command as a process of its own; its log stays in the folder if it fails."""
    log = folder / f"{name}.log"
    process: subprocess.Popen[bytes] | None = None
    try:
        with log.open("wb") as file, _defer_signals():
            process = subprocess.Popen(
                [sys.executable, "-m", "services", name, *arguments],
                stdout=file,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
            )
        yield _ChildProcess(name, process, log)
    finally:
        if process is not None:
            if process.poll() is None:
                process.kill()
            process.wait()
    log.unlink()


@contextlib.contextmanager
def _defer_signals() -> Iterator[None]:
    """Defer signals that end the demo to the end of this context.

    An interrupt within `Popen` would leave an unknown process behind.
    """
    with set_by_signals(signal.SIGINT, signal.SIGTERM) as caught:
        yield
    if caught.is_set():
        raise KeyboardInterrupt


def _wait(
    subscription: Subscription,
    wanted: Callable[[RawSample], bool],
    running: list[_ChildProcess],
    timeout_s: float,
    otherwise: str,
) -> RawSample:
    """Return the first matching message; FailureError if a process dies or the time runs out."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        received = subscription.receive(0.1)
        if received is not None and wanted(received):
            return received
        for one in running:
            # A truck that has driven may leave; a service may not, even with exit code 0.
            if one.process.poll() not in (None, 0 if one.name == "truck" else None):
                raise FailureError(f"the {one.name} ended early: {_last_line(one.log)}")
    log = running[0].log
    raise FailureError(f"{otherwise} after {timeout_s:.0f} s; see the logs next to {log}")


def _finish(running: _ChildProcess, with_signal: signal.Signals | None) -> None:
    if with_signal is not None:
        running.process.send_signal(with_signal)
    try:
        code = running.process.wait(timeout=_STOP_S)
    except subprocess.TimeoutExpired:
        raise FailureError(f"the {running.name} does not end; see {running.log}") from None
    if code != 0:
        raise FailureError(f"the {running.name} ended with {code}: {_last_line(running.log)}")


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"see {log}"


def _check_recording(path: Path, sent: int) -> None:
    """Check that every message of the truck is in the recording, which was closed properly."""
    info = read_info(path)
    recorded = sum(count for key, count in info.messages.items() if "/vehicle/" in key)
    if info.end is None or info.truncated or recorded != sent:
        raise FailureError(f"{path}: holds {recorded} of the truck's {sent} messages")


def _draw(folder: Path, crossing: CrossingResult, drive: SimulatedDrive, site: Site) -> None:
    from services.viewer.bridge_view import views_of_bridges
    from services.viewer.crossing_view import view_of_crossing
    from services.viewer.figure import crossing_figure, true_road_as_measured
    from services.viewer.rerun_file import RerunContent, write_rrd
    from services.viewer.residuals import residual_cells
    from services.viewer.vehicle_signals import signals_of_messages

    content = RerunContent(
        signals_of_messages(read_messages(folder / _RECORDING)),
        [crossing],
        site,
        views_of_bridges(load_results(folder / _TEXT), site),
        residual_cells([crossing], read_messages(folder / _RECORDING), site),
    )
    write_rrd(folder / _VIEWS, content)
    crossing_figure(
        folder / _FIGURE,
        crossing=view_of_crossing(crossing, site.bridge(crossing.bridge)),
        element_truth=drive.rigidity_ratios.tolist(),
        road_truth=true_road_as_measured(crossing.road, drive.road) if crossing.road else None,
    )


def _print(console: "Console", crossing: CrossingResult, drive: SimulatedDrive, site: Site) -> None:
    from rich.table import Table

    parameters = crossing.parameters or {}
    nominal = site.bridge(crossing.bridge).nominal_flexural_rigidity_nm2
    has_meaning = "no_noise_model" not in crossing.reasons
    table = Table(
        title="Flexural rigidity EI relative to the undamaged bridge", title_justify="left"
    )
    table.add_column("element")
    misses = 0
    for heading in ("truth", "estimate", "95 % interval", "contains the truth"):
        table.add_column(heading, justify="right")
    for number, (nominal_ei, truth) in enumerate(
        zip(nominal, drive.rigidity_ratios, strict=True), start=1
    ):
        p = parameters.get(f"EI_{number}")
        if p is None:
            table.add_row(f"EI_{number}", f"{truth:.3f}", "—", "—", "—")
            continue
        interval, holds = "not valid *", "—"
        if has_meaning:
            interval = f"{p.q025 / nominal_ei:.3f} … {p.q975 / nominal_ei:.3f}"
            holds = "yes" if p.q025 <= truth * nominal_ei <= p.q975 else "no"
            misses += holds == "no"
        table.add_row(f"EI_{number}", f"{truth:.3f}", f"{p.mean / nominal_ei:.3f}", interval, holds)
    console.print(table)
    if has_meaning and parameters:
        console.print("A 95 % interval contains the truth in 95 of 100 cases.")
    if misses:
        share = 100.0 * (1.0 - _INTERVAL ** len(nominal))
        console.print(
            f"At least one of {len(nominal)} such intervals misses the truth "
            f"in {share:.0f} % of crossings."
        )
    if not has_meaning:
        console.print(
            "* The method least-squares has no noise model, so its uncertainty is unknown."
        )
    if not crossing.reasons:
        console.print(f"verdict {crossing.verdict}")
    for code, text in zip(crossing.reasons, crossing.reason_texts, strict=True):
        console.print(f"verdict {crossing.verdict} ({code}): {text}")


def _print_outputs(console: "Console", folder: Path, seconds: float) -> None:
    lines = [
        f"\n{folder}/ ({seconds:.0f} s)",
        f"  {_RECORDING:<16} recording by the logger; driveby identify {folder / _RECORDING}",
        f"  {_RESULTS:<16} results of the worker; {_TEXT} has them as text",
        f"  {_VIEWS:<16} all signals and results for the viewer; driveby view {folder / _VIEWS}",
        f"  {_FIGURE:<16} figure of flexural rigidity and road profiles",
    ]
    for line in lines:
        console.print(line, soft_wrap=True)
