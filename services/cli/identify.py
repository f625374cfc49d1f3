"""The command `driveby identify`: identify crossings of recordings, print and write results."""

import logging
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from schemas.results import (
    RESOLVED,
    AtEnds,
    BridgeResult,
    CrossingResult,
    Derived,
    Results,
    is_torsion_declared,
    results_json,
    unresolved_names,
)
from schemas.settings import IdentificationSettings
from schemas.site import Bridge, Site
from schemas.validation_records import VehicleBridgePair
from services.catalogue.contents import summarise_recording
from services.cli.bridge_table import (
    level_lines,
    print_bridge,
    print_elements,
    print_finding,
    print_reasons,
    states_level,
)
from services.cli.settings import IdentifyOptions
from services.common.errors import FailureError, InputError
from services.common.files import (
    check_folder_writable,
    check_writable,
    replaced_atomically,
    write_atomically,
)
from services.common.language import ENGLISH
from services.common.naming import count_of
from services.common.options import validations_folder
from services.common.progress import parts_bar, reading_bar, steps_bar
from services.execution.dispatch import CrossingExecutor
from services.execution.inline import InlineExecutor
from services.execution.offline import identify_drives, messages_of_trucks, site_of
from services.finding.order import index_messages
from services.history.draws import Draws, DrawsOfCrossing, check_draws, write_draws
from services.history.validation_files import (
    ValidatedPairs,
    check_validations,
    passed_validations,
)
from services.identification.baseline_cautions import RealmsOfBridges, baseline_cautions
from services.identification.bridge_remarks import bridge_remarks
from services.identification.bridge_state import FusionSettings
from services.identification.methods import lacks_noise
from services.ledger.baselines import Baselines, baselines_of, realms_of_bridges
from services.notebook.inference import groups_beside, origin_of
from services.recordings.recording import read_messages
from services.recordings.remote import Source, all_fetched, is_folder_of_recordings

if TYPE_CHECKING:
    from rich.console import Console


_log = logging.getLogger(__name__)


def identify_command(
    asked: IdentifyOptions,
    executing: AbstractContextManager[CrossingExecutor | None] | None,
    console: "Console",
) -> int:
    """Identify every crossing in the recordings, print a table and write the requested files.

    `executing` is entered once there is something to do; its value None means this process.

    Raise InputError for a file that cannot be read or written, or has no accelerations or
    positions, for an invalid folder of validation records, and if draws of another executor are
    requested.
    """
    _check(asked, executing)
    with all_fetched(asked.recordings) as files:
        request = _request(asked, files)
        known = request.site
        draws: dict[str, Draws] = {}
        found = _found(request, draws, executing, console)
        _print(console, found, known)
        print_validation(console, found, known, validations_folder(asked.validations))
        now = realms_of_bridges(found.crossings)
        warn_of_baselines(found.bridges, now, request.baselines)
        if asked.json is not None:
            write_atomically(asked.json, results_json(found))
        if asked.rrd is not None:
            _write_rerun(asked.rrd, found, request, (asked.site or files[0]).parent, console)
    if asked.figures is not None:
        from services.viewer.pictures import write_pictures

        with steps_bar(f"drawing into {asked.figures}", console) as drawn:
            written = write_pictures(asked.figures, found, known, drawn, request.fusing.baselines)
        line = f"{count_of(len(written), 'figure')} in {asked.figures}"
        console.print(line, soft_wrap=True)
    if asked.draws is not None:
        some = [crossing for crossing in found.crossings if crossing.crossing_id in draws]
        kept = (
            DrawsOfCrossing(c.crossing_id, c.vehicle, c.bridge, draws[c.crossing_id]) for c in some
        )
        write_draws(asked.draws, kept, groups_beside(asked.draws, some), origin_of(found))
    return 0


def _check(
    asked: IdentifyOptions,
    executing: AbstractContextManager[CrossingExecutor | None] | None,
) -> None:
    """Raise InputError for inputs and outputs that cannot be used."""
    check_validations(asked.validations)
    for source in asked.recordings:
        check_no_tables(source)
        if is_folder_of_recordings(source):
            raise InputError(
                f"{source}: is a folder; give recordings, or --into DIR for its results"
            )
    if asked.draws is not None:
        check_draws(asked.draws, asked.search_method)
        if executing is not None:
            raise InputError("--draws: draws are kept in this process only; leave --scheduler out")
    for path in (asked.json, asked.rrd, asked.draws):
        if path is not None:
            check_writable(path)
    if asked.figures is not None:
        check_folder_writable(asked.figures)
    if asked.json is not None and asked.json.suffix != ".json":
        _log.warning("%s: the file will hold JSON; its usual name ends in .json", asked.json)


def check_no_tables(source: Source) -> None:
    """Raise InputError if a local folder has CSV files and no recording."""
    if isinstance(source, Path) and any(source.glob("*.csv")) and not any(source.rglob("*.mcap")):
        raise InputError(
            f"{source}: is a folder of CSV files, a recording is expected; "
            f"driveby import {source} --site SITE.toml -o DRIVE.mcap makes one"
        )


class _IdentifyRequest(NamedTuple):
    """Recordings to identify, with settings."""

    recordings: list[Path]
    site: Site
    settings: IdentificationSettings
    fusing: FusionSettings
    certificates: Mapping[VehicleBridgePair, str]
    baselines: Baselines


def _request(asked: IdentifyOptions, files: list[Path]) -> _IdentifyRequest:
    site = site_of(files, asked.site)
    beside = None if asked.site is None else asked.site.parent
    baselines = baselines_of(site, beside, asked.baseline)
    fusing = FusionSettings(baselines.states, asked.fuse_suspect)
    method, seed = asked.search_method, asked.seed
    settings = IdentificationSettings.model_validate({"method": method, "seed": seed})
    warn_of_no_noise(site, method)
    records = passed_validations(validations_folder(asked.validations), site, settings)
    return _IdentifyRequest(files, site, settings, fusing, records, baselines)


def _found(
    request: _IdentifyRequest,
    draws: dict[str, Draws],
    executing: AbstractContextManager[CrossingExecutor | None] | None,
    console: "Console",
) -> Results:
    """Return the results of the recordings; `draws` receives those of each crossing."""
    recordings, known = request.recordings, request.site
    seen = _crossings_seen(recordings, known, console)
    with reading_bar("reading", recordings, console) as next_file:
        drives = index_messages(
            ", ".join(map(str, recordings)), messages_of_trucks(recordings, next_file), known
        )
    with (
        executing or nullcontext() as execution,
        parts_bar("crossing", seen, console) as report,
    ):
        return identify_drives(
            drives,
            known,
            request.settings,
            execution or InlineExecutor(report=report, keep=draws.__setitem__),
            report,
            request.fusing,
            request.certificates,
        )


def warn_of_no_noise(site: Site, method: str) -> None:
    """Warn where a method cannot use sensors without noise."""
    if lacks_noise(site, method):
        _log.warning(
            "noise_density_ug_per_rthz in [sensor] of the site file is 0, which method pre cannot "
            "use; simulations without noise are for --method least-squares"
        )


def warn_of_baselines(
    states: Mapping[str, BridgeResult], realms: RealmsOfBridges, baselines: Baselines
) -> None:
    """Warn where a bridge is compared with a misleading baseline, as `baseline_cautions`.

    `realms` are those of the crossings of the states.
    """
    for line in baseline_cautions(states, baselines.states, realms, baselines.realms):
        _log.warning("%s", line)


def _write_rerun(
    path: Path,
    found: Results,
    request: _IdentifyRequest,
    beside: Path,
    console: "Console",
) -> None:
    """Write the Rerun file of the results; baselines of the site file are relative to `beside`."""
    from services.viewer.bridge_view import views_of_bridges
    from services.viewer.rerun_file import RerunContent, write_rrd
    from services.viewer.residuals import residual_cells
    from services.viewer.vehicle_signals import signals_of_messages

    recordings, site = request.recordings, request.site
    messages = chain.from_iterable(map(read_messages, recordings))
    with steps_bar("computing residuals", console) as progress:
        left = residual_cells(found.crossings, messages, site, progress)
    with reading_bar("reading", recordings, console) as next_file:
        vehicles = signals_of_messages(
            message for one in recordings for message in read_messages(one, next_file())
        )
    try:
        with (
            replaced_atomically(path) as temporary,
            steps_bar(f"drawing {path.name}", console) as drawing,
        ):
            states = views_of_bridges(found, site, beside, request.fusing.baselines)
            content = RerunContent(vehicles, found.crossings, site, states, left)
            write_rrd(temporary, content, drawing)
    except RuntimeError as error:  # Rerun's error for a file that cannot be written
        raise FailureError(f"{path}: could not be written: {error}") from error


def _crossings_seen(recordings: list[Path], site: Site, console: "Console") -> int:
    """Return the number of crossings for a progress bar; 0 without a terminal."""
    if not console.is_terminal:
        return 0
    with reading_bar("searching for crossings", recordings, console) as next_file:
        return sum(
            len(summarise_recording(path, site, progress=next_file()).passings)
            for path in recordings
        )


def _print(console: "Console", found: Results, site: Site) -> None:
    if not found.crossings:
        bridges = ", ".join(bridge.id for bridge in site.bridges)
        console.print(f"no crossing of a known bridge ({bridges})", highlight=True)
        return
    crossed = Counter(crossing.bridge for crossing in found.crossings)
    alone = {
        name: state
        for name, state in found.bridges.items()
        if crossed[name] == 1 and state.probability_of_loss is None
    }
    stated = {name for name, state in alone.items() if states_level(state)}
    for number, crossing in enumerate(found.crossings):
        if number > 0:
            console.print()
        _print_crossing(console, crossing, site, is_level_stated=crossing.bridge in stated)
    for name, state in found.bridges.items():
        if name not in alone:
            console.print()
            print_bridge(console, site.bridge(name), state, found.crossings)
        elif state.between_crossing_std is not None:
            console.print(_as_state(site.bridge(name), state))
            print_finding(console, site.bridge(name), state)


def print_validation(console: "Console", found: Results, site: Site, folder: Path) -> None:
    """Print which site validations cover the intervals, and which are missing, by bridge."""
    from rich.markup import escape

    pairs = ValidatedPairs(found.crossings)
    for bridge in dict.fromkeys(crossing.bridge for crossing in found.crossings):
        for note in pairs.notes(folder, site, bridge):
            console.print(f"[bold]{bridge}:[/] {escape(note)}", soft_wrap=True)


def _as_state(bridge: Bridge, state: BridgeResult) -> str:
    """Return the lowest element of a state of one crossing, as reports and figures show it."""
    nominal = bridge.nominal_flexural_rigidity_nm2
    ratio, low, high, name = min(
        (one.mean / ei, one.q025 / ei, one.q975 / ei, name)
        for (name, one), ei in zip(state.elements.items(), nominal, strict=True)
    )
    return (
        "lowest EI/nominal in reports (interval includes between-crossing variability): "
        f"{name} {ratio:.3f} ({low:.3f} … {high:.3f})"
    )


def _print_crossing(
    console: "Console", crossing: CrossingResult, site: Site, *, is_level_stated: bool
) -> None:
    from rich.markup import escape

    method = crossing.method.replace("_", " ")
    console.print(
        f"[bold]{crossing.crossing_id}[/]\n"
        f"{crossing.vehicle} over {crossing.bridge}, {crossing.direction.replace('_', ' ')}, "
        f"{crossing.speed_m_per_s:.2f} m/s, method {method}"
    )
    console.print(f"verdict [bold]{crossing.verdict}[/]")
    remedies = {code.value: ENGLISH.remedy(code, crossing.method) for code in crossing.reasons}
    print_reasons(console, crossing.reasons, crossing.reason_texts, remedies)
    if crossing.parameters is None:
        return
    bridge = site.bridge(crossing.bridge)
    print_elements(
        console,
        bridge,
        crossing.parameters,
        "no_noise_model" not in crossing.reasons,
        None if crossing.derived is None else _below(crossing.derived),
        is_doubtful=crossing.verdict != "good",
    )
    unresolved = unresolved_names(crossing)
    if unresolved:
        console.print(
            f"[bold]not resolved: {', '.join(unresolved)}[/] (standard deviation above "
            f"{100.0 * RESOLVED:.0f} %)"
        )
    for line in _fit_lines(crossing, is_level_stated=is_level_stated):
        console.print(line)
    for remark in bridge_remarks([crossing]):
        console.print(f"[bold]remark:[/] {escape(remark)}", soft_wrap=True)


def _below(derived: Derived) -> dict[str, dict[str, float]] | None:
    below = derived.probability_below_90_percent_of_baseline
    return None if below is None else {name: {"10": share} for name, share in below.items()}


def _support_lines(derived: Derived, *, torsion_declared: bool) -> Iterator[str]:
    """Describe the probabilities of what may be absent, and the suspension's weight."""

    def at_ends(likely: AtEnds) -> str:
        at_start, at_end = 100.0 * likely.start, 100.0 * likely.end
        return f"{at_start:.0f} % at the start, {at_end:.0f} % at the end (50 % if not determined)"

    if derived.probability_sprung is not None:
        yield f"probability of rotational restraint: {at_ends(derived.probability_sprung)}"
    if derived.probability_giving is not None:
        yield f"probability of bearing compliance: {at_ends(derived.probability_giving)}"
    if torsion_declared:
        yield "torsion of the deck: declared (the lane is off the axis)"
    elif derived.probability_torsion:
        likely = f"{100.0 * derived.probability_torsion:.0f} %"
        yield f"probability that the deck twists: {likely} (50 % if not determined)"
    if derived.springs_believed is not None:
        weight = f"{100.0 * derived.springs_believed:.0f} %"
        yield f"weight of the truck's body equations: {weight} (low with suspension friction)"


def _level_lines(crossing: CrossingResult, *, is_stated: bool) -> Iterator[str]:
    """Describe level and thirds of EI, and the mismatch of the road profiles."""
    derived = crossing.derived
    if derived is not None and derived.ei_level is not None and derived.ei_thirds is not None:
        yield from level_lines(derived.ei_level, derived.ei_thirds, is_stated=is_stated)
    if crossing.road is not None and crossing.road.mismatch is not None:
        mismatch = crossing.road.mismatch
        yield (
            f"profile mismatch: spectrum {mismatch.A_m3:.2g} m³ at long wavelengths, a quarter of "
            f"that at {mismatch.n_0_per_m:.1f} cycles/m"
            + (
                ""
                if mismatch.bridge_ratio is None
                else f"; amplitude × {mismatch.bridge_ratio:.1f} on the bridge"
            )
        )


def _fit_lines(crossing: CrossingResult, *, is_level_stated: bool = False) -> Iterator[str]:
    """Describe how well the model fits and what all intervals have in common."""
    diagnostics = crossing.diagnostics
    if crossing.scale_error is not None:
        yield (
            f"common scale uncertainty: {100.0 * crossing.scale_error:.1f} % "
            "(standard deviation, from mass and gain)"
        )
    if crossing.chi2_per_dof is not None:
        yield f"reduced chi-square: {crossing.chi2_per_dof:.2f} (expected 1)"
    if crossing.hum_hz():
        found = ", ".join(f"{hz:.1f} Hz" for hz in crossing.hum_hz())
        yield f"hum removed from the signals: {found}"
    yield from _level_lines(crossing, is_stated=is_level_stated)
    if crossing.derived is not None:
        declared = is_torsion_declared(crossing)
        yield from _support_lines(crossing.derived, torsion_declared=declared)
    if "relative_misfit" in diagnostics:
        yield (
            f"front and rear road profiles differ by {diagnostics['residual_rms_m'] * 1e6:.2f} µm "
            f"(RMS), {100.0 * diagnostics['relative_misfit']:.2g} % of the profile"
        )
    if "seconds" in diagnostics:
        yield f"computed in {diagnostics['seconds']:.1f} s"
