"""Misspecification study: the uncertainty where truck and bridge have out-of-model effects.

The crossings are those of `studies.simulation.out_of_model`, each effect alone and all together.
Records are appended to a file of JSON lines as soon as they are computed, and existing ones are not
computed again: hours of crossings can be resumed. Another program, method version, site or settings
give other crossings.
"""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import NORMAL_975
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import site_hash
from schemas.validation_records import METHOD_EDITION
from services.common.errors import InputError
from services.common.naming import processes_in_words
from services.common.progress import Steps, no_step_progress
from services.recordings.recording import program_version
from services.simulation.drawn import identify_simulated
from services.simulation.effects import SURFACE
from studies.simulation.drive_wide import Width
from studies.simulation.out_of_model import draw_out_of_model, drive_out_of_model
from studies.validation.bound import bound_at_truth
from studies.validation.calibration import Record, StudyTarget, in_processes, record

KeyT = TypeVar("KeyT")
_COVERAGE = (0.93, 0.99)
_LARGEST_MEAN_Z = 0.4
_LARGEST_Z = 5.0
_FEWEST = 48
"""Fewest crossings of an effect whose statistics are targets; with fewer they are only shown."""
_KEYS = {"departed": "left"}
"""Keys of records that differ from the names of fields: records of earlier runs stay readable."""


class EffectSummary(NamedTuple):
    """Statistics of the crossings of one effect; None where there is nothing to count."""

    effect: str
    crossings: int
    answered: float
    """Share that is not rejected."""
    good: float
    coverage: float | None
    """Share of the 95 % intervals of EI that contain the truth, over all answers and elements."""
    coverage_good: float | None
    mean_z: float | None
    """Mean standardised error of ln EI over crossings and elements."""
    worst_mean_z: float | None
    """Mean of the element, from the start, whose mean over crossings is furthest from zero.

    It exists only where all bridges have the same number of elements.
    """
    rms_z: float | None
    largest_z_good: float | None
    std: float | None
    """Median of the relative standard deviation of EI."""
    over_bound: float | None = None
    """Median of its ratio to the Cramér–Rao bound at the truth, with the mismatch in its noise."""


def one_effect(site: Site, effect: str, seed: int, settings: IdentificationSettings) -> Record:
    """Simulate, identify and judge one crossing; see `calibration.record`."""
    case = draw_out_of_model(site, effect, seed)
    departed, paths = case.effects.departed, case.truth.paths
    drawn = drive_out_of_model(case, seed)
    found = identify_simulated([drawn.run], drawn.site, settings)
    seen = found[0] if len(found) == 1 else None
    # Only there does the truth contain noise that a model of one road lacks.
    is_comparable = effect == SURFACE and seen is not None and seen.result.parameters is not None
    line = record(seed, drawn, seen, bound_at_truth(seen, drawn) if seen and is_comparable else {})
    derived = seen.result.derived if seen is not None else None
    return line | {
        "identity": identity_of(site, settings),
        "effect": effect,
        "world": {_KEYS.get(name, name): value for name, value in case.effects._asdict().items()}
        | {
            "left": None if departed is None else departed._asdict(),
            "wheel_paths": None
            if paths is None
            else {
                "front": paths.front._asdict(),
                "rear": paths.rear._asdict(),
                "wander_m": paths.wander_m,
                "pavement": paths.pavement._asdict(),
            },
            "width": None if case.width is None else _width_of(case.width),
            "friction_length_m": case.truth.car.friction_length_m,
            "interior_supports_m": case.site.bridges[0].interior_supports_m,
        },
        "derived": None if derived is None else derived.model_dump(mode="json"),
    }


def _width_of(width: Width) -> Record:
    """Return the out-of-plane parameters of a crossing, as JSON."""
    return width._asdict() | {
        "paths": {
            "front": width.paths.front._asdict(),
            "rear": width.paths.rear._asdict(),
            "wander_m": width.paths.wander_m,
        },
        "torsion": None if width.torsion is None else width.torsion._asdict(),
        "sensors": [sensor._asdict() for sensor in width.sensors],
    }


def identity_of(site: Site, settings: IdentificationSettings) -> str:
    """Return what must be equal for a record not to be computed again."""
    method = f"{program_version()} {METHOD_EDITION}"
    return f"{method} {site_hash(site)} {settings.model_dump_json()}"


def crossings_start(processes: int) -> str:
    """Return the start line of a study for `steps_bar`."""
    return f"validating {{steps}} simulated crossings on {processes_in_words(processes)}"


def run_effects(
    site: Site,
    effects: Sequence[str],
    crossings: int,
    path: Path,
    settings: IdentificationSettings,
    processes: int,
    progress: Steps = no_step_progress,
) -> list[Record]:
    """Return the records of seeds 0 to crossings - 1 of these effects; run missing ones."""
    wanted = [(effect, seed) for seed in range(crossings) for effect in effects]
    identity = identity_of(site, settings)
    known = {
        (line["effect"], line["seed"]): line
        for line in read_records(path)
        if line.get("identity") == identity
    }
    return completed(
        path,
        wanted,
        known,
        lambda line: (line["effect"], line["seed"]),
        lambda key: partial(one_effect, site, *key, settings),
        processes,
        progress,
    )


def completed(
    path: Path,
    wanted: Sequence[KeyT],
    known: dict[KeyT, Record],
    key_of: Callable[[Record], KeyT],
    job_of: Callable[[KeyT], Callable[[], Record]],
    processes: int,
    progress: Steps,
) -> list[Record]:
    """Return the wanted records; compute those that are not `known` and append them to `path`."""
    missing = [key for key in wanted if key not in known]

    def keep(line: Record) -> None:
        append_record(path, line)
        # In the form of the file: lists, where tuples were.
        known[key_of(line)] = json.loads(json.dumps(line))
        progress(sum(key in known for key in wanted), len(wanted))

    progress(len(wanted) - len(missing), len(wanted))
    in_processes([job_of(key) for key in missing], processes, keep)
    return [known[key] for key in wanted]


def read_records(path: Path) -> list[Record]:
    """Return all complete records of the file; skip a truncated last line.

    Raise InputError if the file cannot be read or is another file.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as records of crossings: {error}") from error
    records = []
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            found = json.loads(line)
        except json.JSONDecodeError:
            found = None
        if isinstance(found, dict) and {"effect", "seed", "verdict"} <= found.keys():
            records.append(found)
        elif number == 1:
            raise InputError(
                f"{path}: line 1 is no record of a crossing, name another file for the records"
            )
    return records


def append_record(path: Path, line: Record) -> None:
    """Append one line, on a line of its own even after a truncated one."""
    with path.open("ab+") as file:
        if file.tell() > 0:
            file.seek(-1, 2)
            if file.read(1) != b"\n":
                file.write(b"\n")
        file.write(json.dumps(line).encode() + b"\n")


def lines_of(records: Sequence[Record]) -> list[EffectSummary]:
    """Return one line for each effect, in the order of their first records."""
    return [
        _line(effect, [line for line in records if line["effect"] == effect])
        for effect in dict.fromkeys(line["effect"] for line in records)
    ]


def _line(effect: str, records: list[Record]) -> EffectSummary:
    answered = [line for line in records if line["estimates"]]
    good = [line for line in answered if line["verdict"] == "good"]
    z = [_z(line) for line in answered]
    pooled = np.concatenate(z) if z else np.empty(0)
    worst = None
    if len({each.size for each in z}) == 1:
        means = np.mean(z, axis=0)
        worst = float(means[np.abs(means).argmax()])
    return EffectSummary(
        effect,
        len(records),
        len(answered) / len(records),
        sum(line["verdict"] == "good" for line in records) / len(records),
        _coverage(answered),
        _coverage(good),
        float(pooled.mean()) if z else None,
        worst,
        float(np.sqrt(np.mean(pooled**2))) if z else None,
        max(float(np.abs(_z(line)).max()) for line in good) if good else None,
        float(np.median([s for line in answered for s in _stds(line)])) if z else None,
        _over_bound(answered),
    )


def _rigidities(line: Record) -> list[str]:
    return [name for name in line["truth"] if name.startswith("EI_")]


def _z(line: Record) -> NDArray[np.float64]:
    """Return the standardised errors of ln EI (n,), from the quantiles.

    Standardised errors of EI would not show whether wide intervals are right: EI known to 55 % has
    a skewed posterior, 0.2 % of which lie more than 5 standard deviations above the mean.
    """
    truth = np.array([line["truth"][name] for name in _rigidities(line)])
    low, middle, high = (
        np.array([line["estimates"][name][key] for name in _rigidities(line)])
        for key in ("q025", "q50", "q975")
    )
    return np.asarray(np.log(middle / truth) / (np.log(high / low) / (2.0 * NORMAL_975)))


def _stds(line: Record) -> list[float]:
    return [line["estimates"][n]["std"] / line["truth"][n] for n in _rigidities(line)]


def _over_bound(records: list[Record]) -> float | None:
    ratios = [
        std / line["bound"]["std"][name]
        for line in records
        if line.get("bound")
        for name, std in zip(_rigidities(line), _stds(line), strict=True)
    ]
    return float(np.median(ratios)) if ratios else None


def _coverage(records: list[Record]) -> float | None:
    covered = [
        line["estimates"][name]["q025"] <= line["truth"][name] <= line["estimates"][name]["q975"]
        for line in records
        for name in _rigidities(line)
    ]
    return float(np.mean(covered)) if covered else None


def effect_checks(records: Sequence[Record]) -> list[StudyTarget]:
    """Return the targets: no wrong good crossing; with enough of them coverage and no bias."""
    found = []
    for line in lines_of(records):
        if line.largest_z_good is not None:
            found.append(
                StudyTarget(
                    f"{line.effect}: largest |z| among good", line.largest_z_good, 0.0, _LARGEST_Z
                )
            )
        if line.crossings >= _FEWEST:
            found.append(StudyTarget(f"{line.effect}: coverage", line.coverage, *_COVERAGE))
            is_pooled = line.worst_mean_z is None
            mean = line.mean_z if is_pooled else line.worst_mean_z
            size = None if mean is None else abs(mean)
            name = "mean z" if is_pooled else "mean z of the worst element"
            found.append(StudyTarget(f"{line.effect}: {name}", size, 0.0, _LARGEST_MEAN_Z))
    return found


HEADINGS = (
    "effect",
    "n",
    "answered",
    "good",
    "covered",
    "of good",
    "mean z",
    "worst",
    "rms",
    "max",
    "std",
    "of bound",
)


def cells(line: EffectSummary) -> list[str]:
    """Return the cells of a row of the table under HEADINGS."""

    def percent(value: float | None, digits: int = 0) -> str:
        return "–" if value is None else f"{100.0 * value:.{digits}f} %"

    def number(value: float | None, sign: str = "+") -> str:
        return "–" if value is None else f"{value:{sign}.2f}"

    return [
        line.effect,
        str(line.crossings),
        percent(line.answered),
        percent(line.good),
        percent(line.coverage, 1),
        percent(line.coverage_good, 1),
        number(line.mean_z),
        number(line.worst_mean_z),
        number(line.rms_z, ""),
        number(line.largest_z_good, ""),
        percent(line.std, 1),
        number(line.over_bound, ""),
    ]
