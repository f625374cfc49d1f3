"""`driveby identify`: recordings become results, offline, through the worker's own engine."""

import logging
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.results import Crossing, Header, Results, results, results_json
from schemas.settings import IdentificationSettings
from schemas.site import Site, load_site, parse_site, site_hash
from services.common.errors import FailureError, InputError
from services.common.files import check_writable, replaced_atomically, write_atomically
from services.execution.dispatch import awaited, dispatched
from services.execution.here import Here
from services.history.draws import Draws, check_draws, write_draws
from services.identification.engine import Engine
from services.identification.identify import Keep
from services.identification.outputs import Output, Work
from services.identification.streams import device_time_ns
from services.recordings.recording import Message, program_version, read_messages, read_site

if TYPE_CHECKING:
    from rich.console import Console


_log = logging.getLogger(__name__)


def identify_command(
    *,
    recordings: list[Path],
    site: Path | None,
    method: str,
    json_path: Path | None,
    rrd_path: Path | None,
    draws_path: Path | None,
    seed: int,
    console: "Console",
) -> int:
    """Identify every crossing in the recordings, print a table and write what was asked for.

    InputError: a file that cannot be read or written, or has no accelerations or positions.
    """
    if draws_path is not None:
        check_draws(draws_path, method)
    for path in (json_path, rrd_path, draws_path):
        if path is not None:
            check_writable(path)
    known = site_of(recordings, site)
    settings = IdentificationSettings.model_validate({"method": method, "seed": seed})
    if method == "pre" and not any(known.sensor.noise_density_ug_per_rthz):
        _log.warning(
            "the site says that the sensors have no noise, which method pre cannot believe; "
            "simulations without noise are for --method least-squares"
        )
    draws: dict[str, Draws] = {}
    with console.status("reading", spinner="dots") as status:
        found = identify_recordings(
            recordings, known, settings, status.update, keep=draws.__setitem__
        )
    _print(console, found, known)
    if json_path is not None:
        write_atomically(json_path, results_json(found))
    if rrd_path is not None:
        from services.viewer.crossing_view import view_of_crossing
        from services.viewer.rerun_file import bridges_of_site, write_rrd
        from services.viewer.vehicle_signals import signals_of_messages

        try:
            with replaced_atomically(rrd_path) as temporary:
                write_rrd(
                    temporary,
                    vehicles=signals_of_messages(_all_messages(recordings)),
                    bridges=bridges_of_site(known),
                    crossings=[
                        view_of_crossing(c, known.bridge(c.bridge)) for c in found.crossings
                    ],
                )
        except RuntimeError as error:  # so Rerun says that its file could not be written
            raise FailureError(f"{rrd_path}: could not be written: {error}") from error
    if draws_path is not None:  # last: several crossings do not fit into every kind of file
        write_draws(draws_path, draws)
    return 0


def site_of(recordings: list[Path], site: Path | None) -> Site:
    """The site file given, or else the one stored in the first recording that has one."""
    if site is not None:
        return load_site(site)
    for path in recordings:
        text = read_site(path)
        if text is not None:
            return parse_site(text, f"{path}: site.toml")
    raise InputError(f"{recordings[0]}: no site file is stored in it, give one with --site")


def identify_recordings(
    recordings: list[Path],
    site: Site,
    settings: IdentificationSettings,
    say: Callable[[str], None] = lambda text: None,
    keep: Keep = lambda crossing_id, draws: None,
) -> Results:
    """Results of all crossings in the recordings, in order of time; `keep` is given their draws."""
    header = Header(
        version=program_version(),
        created=time.time(),
        site_hash=site_hash(site),
        settings=settings.model_dump(mode="json"),
        seed=settings.seed,
    )
    engine = Engine(site, settings, header)
    execution = Here(
        report=lambda crossing, stage, fraction: say(f"{crossing}: {stage}"), keep=keep
    )
    messages: dict[str, list[Message]] = {"accel": [], "gnss": [], "info": []}
    for message in _all_messages(recordings):
        if message.key.owner == "vehicle" and message.key.stream in messages:
            messages[message.key.stream].append(message)
    for stream, what in (("accel", "accelerations (accel)"), ("gnss", "positions (gnss)")):
        if not messages[stream]:
            raise InputError(f"{_names(recordings)}: no {what}, a recording of a truck is expected")
    _check_vehicles(recordings, site, [*messages["accel"], *messages["gnss"]])
    for message in messages["gnss"]:
        engine.expect(message.key, message.payload)
    outputs = chain(
        chain.from_iterable(
            dispatched(engine, execution, _said(recordings, engine, message))
            for message in _as_it_happened(
                recordings, [m for one in messages.values() for m in one]
            )
        ),
        dispatched(engine, execution, engine.finish()),
        awaited(engine, execution),
    )
    found = [output.result for output in outputs if output.result is not None]
    found.sort(key=lambda crossing: crossing.entry_time)
    return results(header, found, engine.bridges())


def _check_vehicles(recordings: list[Path], site: Site, messages: list[Message]) -> None:
    """InputError if the site knows none of the trucks; a warning for each that it does not know."""
    known = {vehicle.id for vehicle in site.vehicles}
    drove = {message.key.identifier for message in messages}
    strangers = ", ".join(sorted(drove - known))
    if drove and not drove & known:
        raise InputError(
            f"{_names(recordings)}: {strangers} drove, but the site has no such vehicle"
        )
    if strangers:
        _log.warning("%s drove too, but the site has no such vehicle", strangers)


def _as_it_happened(recordings: list[Path], messages: list[Message]) -> list[Message]:
    """Boot by boot, by the truck's clock: a recording keeps the order in which messages came."""

    def moment(message: Message) -> tuple[int, str, str, int]:
        try:
            time_ns = -1  # what a truck says of itself holds for all of a boot
            if message.key.stream != "info":
                time_ns = device_time_ns(message.key.stream, message.payload)
        except ValueError as error:
            raise _malformed(recordings, message, error) from error
        return message.boot_id, message.key.realm, message.key.identifier, time_ns

    return sorted(messages, key=moment)


def _said(recordings: list[Path], engine: Engine, message: Message) -> Iterator[Output | Work]:
    try:
        return engine.feed(message.key, message.payload)
    except ValueError as error:
        wrong = _malformed(recordings, message, error)
        if message.key.stream == "info":  # nothing that it could say is needed
            _log.warning("%s", wrong)
            return iter(())
        raise wrong from error


def _malformed(recordings: list[Path], message: Message, error: ValueError) -> InputError:
    where = f"{_names(recordings)}: {message.key.stream} {message.sequence}"
    return InputError(f"{where}: {error}")


def _all_messages(recordings: list[Path]) -> Iterator[Message]:
    for path in recordings:
        yield from read_messages(path)


def _names(recordings: list[Path]) -> str:
    return ", ".join(str(path) for path in recordings)


def _print(console: "Console", found: Results, site: Site) -> None:
    if not found.crossings:
        bridges = ", ".join(bridge.id for bridge in site.bridges)
        console.print(f"no crossing of a known bridge ({bridges})")
        return
    for number, crossing in enumerate(found.crossings):
        if number > 0:
            console.print()
        _print_crossing(console, crossing, site)


def _print_crossing(console: "Console", crossing: Crossing, site: Site) -> None:
    from rich.table import Table

    method = crossing.method.replace("_", " ")
    console.print(
        f"[bold]{crossing.crossing_id}[/]\n"
        f"{crossing.vehicle} over {crossing.bridge}, {crossing.direction.replace('_', ' ')}, "
        f"{crossing.speed_m_per_s:.2f} m/s, method {method}",
        highlight=False,
    )
    console.print(f"verdict [bold]{crossing.verdict}[/]", highlight=False)
    for code, text in zip(crossing.reasons, crossing.reason_texts, strict=True):
        console.print(f"  {code}: {text}", highlight=False)
    if crossing.parameters is None:
        return
    bridge = site.bridge(crossing.bridge)
    has_meaning = "no_noise_model" not in crossing.reasons
    table = Table(box=None, pad_edge=False)
    for heading in ("element", "from (m)", "to (m)", "EI (GN·m²)"):
        table.add_column(heading, justify="right")
    if has_meaning:
        table.add_column("95 % interval", justify="right")
    table.add_column("of nominal", justify="right")
    if has_meaning:
        table.add_column("95 % interval", justify="right")
    start = 0.0
    for number, (length, sound) in enumerate(
        zip(bridge.lengths_m, bridge.nominal_flexural_rigidity_nm2, strict=True), start=1
    ):
        p = crossing.parameters[f"EI_{number}"]
        row = [f"EI_{number}", f"{start:.2f}", f"{start + length:.2f}"]
        for unit, digits in ((1e9, 2), (sound, 3)):
            row.append(f"{p.mean / unit:.{digits}f}")
            if has_meaning:
                row.append(f"{p.q025 / unit:.{digits}f} … {p.q975 / unit:.{digits}f}")
        table.add_row(*row)
        start += length
    console.print(table)
    for line in _remarks(crossing):
        console.print(line, highlight=False)


def _remarks(crossing: Crossing) -> Iterator[str]:
    """How well the model fits, and what of the intervals all elements have in common."""
    diagnostics = crossing.diagnostics
    if crossing.scale_error is not None:
        yield (
            f"of that common to all elements: {100.0 * crossing.scale_error:.1f} % "
            "(standard deviation; mass, gain)"
        )
    if crossing.chi2_per_dof is not None:
        yield f"misfit against the declared noise: chi2 {crossing.chi2_per_dof:.2f}, 1 expected"
    if "relative_misfit" in diagnostics:
        yield (
            f"the two roads differ by {diagnostics['residual_rms_m'] * 1e6:.2f} µm rms, "
            f"{100.0 * diagnostics['relative_misfit']:.2g} % of the road"
        )
    if "seconds" in diagnostics:
        yield f"{diagnostics['seconds']:.1f} s"
