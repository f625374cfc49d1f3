"""The command `driveby validate --site`: validation records of a site file's pairs."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from schemas.settings import IdentificationSettings
from schemas.site import Site, Vehicle
from schemas.site_file import load_site
from schemas.validation_records import (
    ValidationCrossing,
    ValidationRecord,
    VehicleBridgePair,
    pair_hash,
    validation_path,
)
from services.common.child_process import ChildPool
from services.common.errors import InputError
from services.common.files import check_writable, make_folder
from services.common.language import ENGLISH
from services.common.naming import count_of, processes_in_words
from services.common.progress import progress_bar, start_line
from services.common.road_class import assumed_road
from services.common.truck_choice import TRUCK_CHOICES, truck_to_try
from services.history.validation_files import frequent_reasons, save
from services.simulation.trial_truth import CROSSINGS
from services.simulation.validation_options import SiteValidationOptions
from services.simulation.validation_trial import (
    ValidationTrial,
    conditions_of,
    run_trial,
    single_pair_site,
)

if TYPE_CHECKING:
    from rich.console import Console


_AFTER_FAILURE: Final = (
    "Do not rely on intervals of a pair that failed: check the site file, try {remedy}, and "
    "validate again"
)

_SURFACE: Final = (
    "axles follow different paths; computing 2-D road surfaces, so the first crossing takes minutes"
)
_UNLIKE_PATHS: Final = ("twin_tyre_distance_m", "rear_axle_offset_m")
"""Keys of a vehicle whose axles do not follow the same path."""


def validate_site_command(asked: SiteValidationOptions, console: "Console") -> int:
    """Validate every pair of the site, print a line for each; return 1 if one failed.

    InputError: a bad site file, an unknown vehicle or bridge, or a folder that is not writable.
    """
    known = load_site(asked.site)
    pairs = _pairs(known, asked)
    settings = IdentificationSettings()
    make_folder(asked.validations)
    for pair in pairs:
        check_writable(validation_path(asked.validations, pair_hash(known, pair, settings)))
    trials = count_of(len(pairs), "pair")
    start_line(
        console,
        f"validating {trials} of truck and bridge: at most {CROSSINGS} simulated crossings each, "
        f"on {processes_in_words(asked.processes)}",
    )
    failed, tried = set(), list[ValidationCrossing]()
    # A fork is impossible: the threads of numba and OpenBLAS would not survive it.
    with (
        progress_bar(console) as bar,
        ChildPool(asked.processes, "spawn") as pool,
    ):
        task = bar.add_task("simulated crossings", total=len(pairs))
        for done, pair in enumerate(pairs):
            if _has_surface(known, pair):
                start_line(console, f"{pair}: {_SURFACE}")
            trial = ValidationTrial(known, pair, settings, asked.seed)
            for share in run_trial(trial, pool, asked.processes):
                bar.update(task, completed=done + share)
            certificate = trial.certificate(time.time())
            path = save(asked.validations, certificate)
            if not certificate.passed:
                failed.add(truck_to_try(known.vehicle(pair.vehicle), known.bridge(pair.bridge)))
                tried += certificate.crossings
            console.print(line_of(certificate, path, known), soft_wrap=True)
    if failed:
        kind = min(failed, key=TRUCK_CHOICES.index)
        remedy = ENGLISH.text(f"caution.try.{kind}")
        advice = _AFTER_FAILURE.format(remedy=remedy)
        lines = " ".join(filter(None, (frequent_reasons(tried), advice)))
        console.print(lines, soft_wrap=True)
    return int(bool(failed))


def _has_surface(known: Site, pair: VehicleBridgePair) -> bool:
    """Return whether the crossings of a pair are simulated on a 2-D surface of the road."""
    alone = single_pair_site(known, pair)
    return conditions_of(alone.vehicles[0], alone.bridges[0], alone).road == "surface"


def _pairs(known: Site, asked: SiteValidationOptions) -> list[VehicleBridgePair]:
    """Return the requested pairs; InputError for an unknown vehicle or bridge."""
    vehicles, bridges = [v.id for v in known.vehicles], [b.id for b in known.bridges]
    truck, bridge = asked.truck, asked.bridge
    for option, wanted, ids in (("--truck", truck, vehicles), ("--bridge", bridge, bridges)):
        if wanted is not None and wanted not in ids:
            raise InputError(f"{option}: is {wanted}, {asked.site} has only {', '.join(ids[:20])}")
    return [
        VehicleBridgePair(v, b)
        for v in vehicles
        if truck in (None, v)
        for b in bridges
        if bridge in (None, b)
    ]


def line_of(certificate: ValidationRecord, path: Path, known: Site) -> str:
    """Return a validation record of a site's pair in one line."""
    figures = certificate.figures
    how = "passed" if certificate.passed else "FAILED"
    after = (
        ""
        if figures.crossings == CROSSINGS
        else f" after {figures.crossings} of at most {CROSSINGS} crossings"
    )
    std = "" if figures.std is None else f"; EI ± {100.0 * figures.std:.0f} %"
    if std and certificate.conditions.road == "groove":
        std += _one_profile(known.vehicle(certificate.vehicle))
    declared = known.bridge(certificate.bridge).road_class
    road = certificate.conditions.road_class
    assumed = assumed_road(road, declared, "road_class in the site file")
    std += assumed and f"; {assumed}"
    return f"{certificate.pair}: {how}{after}: {certificate.reason}{std}; {path}"


def _one_profile(vehicle: Vehicle) -> str:
    """Return the caution on a trial whose axles follow one profile, and what may be declared."""
    undeclared = [key for key in _UNLIKE_PATHS if getattr(vehicle, key) is None]
    two = f"; to simulate two profiles, declare {' or '.join(undeclared)}" if undeclared else ""
    return (
        " on one road profile under both axles, so real crossings are less accurate (driveby "
        f"survey forecasts how accurate{two})"
    )
