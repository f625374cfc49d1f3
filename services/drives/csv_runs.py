"""Runs of CSV files: in the form of the contract directly, in any other by map or guess.

The exact reader comes first; only files that it refuses, or whose numbers contradict it, are read
as a vendor's table. Guesses that change numbers must be confirmed.
"""

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from schemas.site import Site
from services.common.errors import InputError
from services.common.progress import Steps, no_step_progress
from services.drives.csv_import import read_folder, read_pair
from services.drives.plausible import check_plausible, notes_of
from services.drives.runs import Run
from services.drives.tables.findings import Target
from services.drives.tables.guesses import grouped
from services.drives.tables.mapping import ImportMap
from services.drives.tables.reading import InterpretedRuns, interpret
from services.finding.placed import rates_hz

_log = logging.getLogger(__name__)
_MAX_SHOWN = 3
_OTHER_FORM = re.compile(
    r": line 1: |: line 2: (?!\S+ is ([-+.\d]|inf|nan))|holds no accel_NN.csv|is not UTF-8 text"
)
"""Errors of the exact reader for files of another form; in line 2 may be words, such as units."""


class ReadOptions(NamedTuple):
    """Options for files that are not in the form of the contract."""

    mapping: ImportMap | None = None
    zone: str | None = None
    start: str | None = None
    accepts_guesses: bool = False
    is_draft: bool = False
    """Whether the drive is only shown and mapped, with a missing zone or unit left open."""
    reading: Steps = no_step_progress
    """Callback for the number of files read."""


AS_WRITTEN = ReadOptions()


def csv_runs(
    sources: Sequence[Path], site: Site, vehicle_id: str, how: ReadOptions = AS_WRITTEN
) -> list[Run]:
    """Return the runs of a folder or of a pair of files, axes and gravity as the site declares.

    Raise InputError, in one line, if they cannot be read, or only by unconfirmed guesses.
    """
    found = interpreted_runs(sources, site, vehicle_id, how)
    conversions = found.conversions()
    if conversions and not how.accepts_guesses:
        shown = "; ".join(conversions[:_MAX_SHOWN])
        more = len(conversions) - _MAX_SHOWN
        if more > 0:
            shown += f"; and {more} more {'guess' if more == 1 else 'guesses'}"
        raise InputError(
            f"{sources[0]}: is read by guesses that change numbers ({shown}): driveby import "
            "--preview shows them, --yes or a map (--preview --write-map MAP.toml, then --map "
            "MAP.toml) confirms them"
        )
    for guess in grouped(found.guesses):
        _log.log(logging.INFO if guess.kind == "form" else logging.WARNING, "%s", guess.text)
    return found.runs


def interpreted_runs(
    sources: Sequence[Path], site: Site, vehicle_id: str, how: ReadOptions = AS_WRITTEN
) -> InterpretedRuns:
    """Return the runs with all guesses, confirmed or not."""
    if len(sources) > 2 or (len(sources) == 2 and any(path.is_dir() for path in sources)):
        raise InputError(
            f"{len(sources)} files or folders given, one folder or accel.csv gps.csv expected; "
            "import each folder alone, driveby identify takes several recordings"
        )
    vehicle = site.vehicle(vehicle_id)
    exact: InputError | None = None
    if how.mapping is None:
        try:
            runs = exact_runs(sources, vehicle.channels, how.reading)
            for run in runs:
                check_plausible(run, site, vehicle)
        except InputError as error:
            exact = error
            if not all(path.exists() for path in sources):
                raise
        else:
            return InterpretedRuns(runs, notes_of(runs, site, vehicle), ImportMap())
    declared = next(iter(rates_hz(site.sensor, vehicle).values()))
    target = Target(site, vehicle, declared, how.zone, how.start, how.is_draft)
    try:
        found = interpret(sources, how.mapping or ImportMap(), target)
        for run in found.runs:
            check_plausible(run, site, None)
    except InputError as error:
        raise _better(exact, error) from error
    return found._replace(guesses=[*found.guesses, *notes_of(found.runs, site, vehicle)])


def exact_runs(
    sources: Sequence[Path], channels: tuple[str, ...] | None, reading: Steps = no_step_progress
) -> list[Run]:
    """Return the runs of files in the form of the contract; InputError for other files."""
    if len(sources) == 1 and sources[0].suffix == ".csv":
        raise InputError(f"{sources[0]}: the positions are missing, give accel.csv and gps.csv")
    if len(sources) == 1:
        return read_folder(sources[0], reading, channels)
    return [read_pair(sources[0], sources[1], channels)]


def _better(exact: InputError | None, general: InputError) -> InputError:
    """Return the more helpful error: the exact one where the files have the contract's form."""
    if exact is None:
        return general
    if "no such file" in str(exact) or "holds no table" in str(general):
        return exact
    is_other_form = _OTHER_FORM.search(str(exact)) is not None
    return general if is_other_form or "--" in str(general) else exact
