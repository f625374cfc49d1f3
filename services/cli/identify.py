"""`driveby identify`: identifies the crossings of recordings, prints and writes what was found."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from schemas.certificates import Pair
from schemas.results import (
    AtEnds,
    Crossing,
    Derived,
    Results,
    resolution,
    results_json,
)
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.cli.bridge_table import print_bridge, print_elements
from services.cli.parsing import CERTIFICATES
from services.common.errors import FailureError, InputError
from services.common.files import (
    check_folder_writable,
    check_writable,
    replaced_atomically,
    write_atomically,
)
from services.common.progress import parts_bar, reading_bar, steps_bar
from services.drives.survey import survey
from services.execution.dispatch import Execution
from services.execution.offline import identify_drives, site_of
from services.execution.overview import look_over, messages_of_trucks
from services.history.baselines import baselines_of
from services.history.certificates import found_in
from services.history.draws import Draws, DrawsOfCrossing, check_draws, write_draws
from services.identification.bridge_state import Fusing
from services.recordings.away import Source, all_at_hand, is_folder_of_recordings
from services.recordings.recording import read_messages

if TYPE_CHECKING:
    from rich.console import Console


_log = logging.getLogger(__name__)


def identify_command(
    *,
    recordings: Sequence[Source],
    site: Path | None,
    method: str,
    json_path: Path | None,
    rrd_path: Path | None,
    draws_path: Path | None,
    figures: Path | None,
    certificates: Path | None = None,
    seed: int,
    baseline: Path | None,
    fuse_suspect: bool,
    executing: AbstractContextManager[Execution | None] | None = None,
    console: "Console",
) -> int:
    """Identify every crossing in the recordings, print a table and write what was asked for.

    `executing` is entered when it is known that there is something to do: None, in this process.
    InputError: a file that cannot be read or written, or has no accelerations or positions; a
    folder of certificates that is none; draws are wanted from elsewhere.
    """
    check_certificates(certificates)
    for source in recordings:
        if is_folder_of_recordings(source):
            raise InputError(
                f"{source}: is a folder; give recordings, or --into DIR for its results"
            )
    if draws_path is not None:
        check_draws(draws_path, method)
        if executing is not None:
            raise InputError("--draws: are kept in this process only, leave --scheduler out")
    for path in (json_path, rrd_path, draws_path):
        if path is not None:
            check_writable(path)
    if figures is not None:
        check_folder_writable(figures)
    with all_at_hand(recordings) as files:
        known = site_of(files, site)
        beside = None if site is None else site.parent
        fusing = Fusing(baselines_of(known, beside, baseline), fuse_suspect)
        settings = IdentificationSettings.model_validate({"method": method, "seed": seed})
        warn_of_no_noise(known, method)
        asked = _Asked(
            files,
            known,
            settings,
            fusing,
            found_in(certificates or CERTIFICATES, known, settings),
        )
        draws: dict[str, Draws] = {}
        found = _found(asked, draws, executing, console)
        _print(console, found, known)
        if json_path is not None:
            write_atomically(json_path, results_json(found))
        if rrd_path is not None:
            _write_rerun(rrd_path, files, found, known, (site or files[0]).parent, console)
    if figures is not None:
        from services.viewer.pictures import write_pictures

        with steps_bar(f"drawing into {figures}", console) as drawn:
            written = write_pictures(figures, found, known, drawn)
        console.print(f"{len(written)} pictures in {figures}", highlight=False, soft_wrap=True)
    if draws_path is not None:
        kept = (
            DrawsOfCrossing(c.crossing_id, c.vehicle, c.bridge, draws.get(c.crossing_id, {}))
            for c in found.crossings
        )
        write_draws(draws_path, kept)
    return 0


class _Asked(NamedTuple):
    """What is to be identified, and how."""

    recordings: list[Path]
    site: Site
    settings: IdentificationSettings
    fusing: Fusing
    certificates: Mapping[Pair, str]


def _found(
    asked: _Asked,
    draws: dict[str, Draws],
    executing: AbstractContextManager[Execution | None] | None,
    console: "Console",
) -> Results:
    """What the recordings give; `draws` gets those of each crossing."""
    recordings, known = asked.recordings, asked.site
    seen = _crossings_seen(recordings, known, console)
    with reading_bar("reading", recordings, console) as next_file:
        drives = look_over(
            ", ".join(map(str, recordings)), messages_of_trucks(recordings, next_file), known
        )
    with (
        executing or nullcontext() as execution,
        parts_bar("crossing", seen, console) as report,
    ):
        return identify_drives(
            drives,
            known,
            asked.settings,
            report,
            keep=draws.__setitem__,
            fusing=asked.fusing,
            certificates=asked.certificates,
            execution=execution,
        )


def check_certificates(certificates: Path | None) -> None:
    """InputError if a folder of certificates is none."""
    if certificates is not None and not certificates.is_dir():
        raise InputError(f"--validations: {certificates} is no folder of certificates")


def warn_of_no_noise(site: Site, method: str) -> None:
    """Say so where a method cannot believe in sensors without noise."""
    from services.identification.placed import middle_sensor

    noise = (middle_sensor(site.sensor, one).noise_density_ug_per_rthz for one in site.vehicles)
    if method == "pre" and not any(map(any, noise)):
        _log.warning(
            "the site says that the sensors have no noise, which method pre cannot believe; "
            "simulations without noise are for --method least-squares"
        )


def _write_rerun(
    path: Path,
    recordings: list[Path],
    found: Results,
    site: Site,
    beside: Path,
    console: "Console",
) -> None:
    """The Rerun file of what was found; baselines are looked for `beside`."""
    from services.viewer.bridge_view import views_of_bridges
    from services.viewer.residuals import residual_cells
    from services.viewer.vehicle_signals import signals_of_messages
    from services.viewer.view import write_views

    messages = chain.from_iterable(map(read_messages, recordings))
    with steps_bar("what fits leave over", console) as progress:
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
            write_views(
                temporary,
                vehicles=vehicles,
                crossings=found.crossings,
                site=site,
                overviews=views_of_bridges(found, site, beside),
                residuals=left,
                drawing=drawing,
            )
    except RuntimeError as error:  # so Rerun says that its file could not be written
        raise FailureError(f"{path}: could not be written: {error}") from error


def _crossings_seen(recordings: list[Path], site: Site, console: "Console") -> int:
    """How many a bar is of; 0 without a terminal, where nobody sees it."""
    if not console.is_terminal:
        return 0
    with reading_bar("looking for crossings", recordings, console) as next_file:
        return sum(len(survey(path, site, progress=next_file()).passings) for path in recordings)


def _print(console: "Console", found: Results, site: Site) -> None:
    if not found.crossings:
        bridges = ", ".join(bridge.id for bridge in site.bridges)
        console.print(f"no crossing of a known bridge ({bridges})")
        return
    for number, crossing in enumerate(found.crossings):
        if number > 0:
            console.print()
        _print_crossing(console, crossing, site)
    for name, state in found.bridges.items():
        crossed = [crossing for crossing in found.crossings if crossing.bridge == name]
        if len(crossed) > 1 or state.probability_of_loss is not None:
            console.print()
            print_bridge(console, site.bridge(name), state)


def _print_crossing(console: "Console", crossing: Crossing, site: Site) -> None:
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
    print_elements(
        console,
        bridge,
        crossing.parameters,
        "no_noise_model" not in crossing.reasons,
        None if crossing.derived is None else _below(crossing.derived),
    )
    words = resolution(crossing)
    if words is not None:
        console.print(f"[bold]{words}[/]", highlight=False)
    for line in _remarks(crossing):
        console.print(line, highlight=False)


def _below(derived: Derived) -> dict[str, dict[str, float]] | None:
    below = derived.probability_below_90_percent_of_baseline
    return None if below is None else {name: {"10": share} for name, share in below.items()}


def _of_ends_and_springs(derived: Derived) -> Iterator[str]:
    """What was decided about things that may be there or not."""

    def at_ends(likely: AtEnds) -> str:
        return f"{100.0 * likely.start:.0f} % at the start, {100.0 * likely.end:.0f} % at the end"

    if derived.probability_sprung is not None:
        yield f"a spring holds the end of the bridge: {at_ends(derived.probability_sprung)}"
    if derived.probability_giving is not None:
        yield f"a bearing gives under load: {at_ends(derived.probability_giving)}"
    if derived.probability_torsion:
        likely = f"{100.0 * derived.probability_torsion:.0f} %"
        yield f"probability that the deck twists under the truck: {likely}"
    if derived.springs_believed is not None:
        yield f"the truck's springs are believed to {100.0 * derived.springs_believed:.0f} %"


def _of_level_and_road(crossing: Crossing) -> Iterator[str]:
    """The coarser picture, and by how much the axles' roads differ."""
    derived = crossing.derived
    if derived is not None and derived.ei_level is not None and derived.ei_thirds is not None:
        thirds = (derived.ei_thirds.left, derived.ei_thirds.middle, derived.ei_thirds.right)
        told = ", ".join(f"{p.mean:.2f} ± {p.std:.2f}" for p in thirds)
        level = derived.ei_level
        yield f"EI of nominal: mean {level.mean:.2f} ± {level.std:.2f}; thirds {told}"
    if crossing.road is not None and crossing.road.mismatch is not None:
        mismatch = crossing.road.mismatch
        yield (
            f"the axles' roads differ by {mismatch.A_m3:.2g} m³ at long waves, a quarter of it at "
            f"{mismatch.n_0_per_m:.1f} cycles/m"
        )


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
    yield from _of_level_and_road(crossing)
    if crossing.derived is not None:
        yield from _of_ends_and_springs(crossing.derived)
    if "relative_misfit" in diagnostics:
        yield (
            f"the two roads differ by {diagnostics['residual_rms_m'] * 1e6:.2f} µm rms, "
            f"{100.0 * diagnostics['relative_misfit']:.2g} % of the road"
        )
    if "seconds" in diagnostics:
        yield f"{diagnostics['seconds']:.1f} s"
