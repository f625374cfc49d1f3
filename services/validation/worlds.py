"""Is the uncertainty still true where truck and bridge have more physics than the method?

Crossings of `services.simulation.worlds`, each effect alone and all together. Records are appended
to a file of JSON lines as soon as they are there, and what is in it is not run again: hours of
crossings can be taken up where they were left. Another program, site or settings are other
crossings.
"""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import site_hash
from services.common.errors import InputError
from services.recordings.recording import program_version
from services.simulation.drawn import drive, see
from services.simulation.drive_wide import Width
from services.simulation.worlds import SURFACE, draw_world
from services.validation.bound import bound_at_truth
from services.validation.calibration import Check, Record, in_processes, record

KeyT = TypeVar("KeyT")
_COVERAGE = (0.93, 0.99)
_LARGEST_MEAN_Z = 0.4
_LARGEST_Z = 5.0
_FEWEST = 64
"""Crossings of an effect whose statistics are aims; of fewer they are only shown."""


class Line(NamedTuple):
    """What the crossings of one effect say; None where there is nothing to say."""

    effect: str
    crossings: int
    answered: float
    """Share that is not rejected."""
    good: float
    coverage: float | None
    """The share of the 95 % intervals of EI, of all elements of all crossings with an answer, that
    hold the truth."""
    coverage_good: float | None
    mean_z: float | None
    """Over crossings and elements."""
    worst_mean_z: float | None
    """The mean of that element, counted from the start, whose mean over crossings is furthest from
    zero; only where all bridges have the same number of elements."""
    rms_z: float | None
    largest_z_good: float | None
    std: float | None
    """Median of the relative standard deviation of EI."""
    over_bound: float | None = None
    """Median of that over the Cramér-Rao bound at the truth, with the mismatch in its noise."""


def one_world(site: Site, effect: str, seed: int, settings: IdentificationSettings) -> Record:
    """Draw, drive, identify and judge one crossing; see `calibration.record`."""
    world = draw_world(site, effect, seed)
    left, paths = world.beyond.left, world.truth.paths
    drawn = drive(world.site, world.truth, seed)
    found = see([drawn.run], drawn.site, settings)
    seen = found[0] if len(found) == 1 else None
    # Only there does the truth tell of noise that a model of one road has not.
    is_comparable = effect == SURFACE and seen is not None and seen.result.parameters is not None
    line = record(seed, drawn, seen, bound_at_truth(seen, drawn) if seen and is_comparable else {})
    derived = seen.result.derived if seen is not None else None
    return line | {
        "identity": identity_of(site, settings),
        "effect": effect,
        "world": world.beyond._asdict()
        | {
            "left": None if left is None else left._asdict(),
            "wheel_paths": None
            if paths is None
            else {
                "front": paths.front._asdict(),
                "rear": paths.rear._asdict(),
                "wander_m": paths.wander_m,
            },
            "width": None if world.truth.width is None else _width_of(world.truth.width),
            "friction_length_m": world.truth.car.friction_length_m,
            "interior_supports_m": world.site.bridges[0].interior_supports_m,
        },
        "derived": None if derived is None else derived.model_dump(mode="json"),
    }


def _width_of(width: Width) -> Record:
    """What a crossing has beyond the plane, as JSON."""
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
    """What has to be the same for a record not to be run again."""
    return f"{program_version()} {site_hash(site)} {settings.model_dump_json()}"


def run_worlds(
    site: Site,
    effects: Sequence[str],
    crossings: int,
    path: Path,
    settings: IdentificationSettings,
    processes: int,
    progress: Callable[[int, int], None] = lambda done, jobs: None,
) -> list[Record]:
    """The records of seeds 0 to crossings - 1 of these effects; those that `path` lacks are run."""
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
        lambda key: partial(one_world, site, *key, settings),
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
    progress: Callable[[int, int], None],
) -> list[Record]:
    """The wanted records; those that are not `known` are made, and appended to `path` at once."""
    missing = [key for key in wanted if key not in known]

    def keep(line: Record) -> None:
        append_record(path, line)
        # As the file has them: lists, where tuples were.
        known[key_of(line)] = json.loads(json.dumps(line))
        progress(sum(key in known for key in wanted), len(wanted))

    progress(len(wanted) - len(missing), len(wanted))
    in_processes([job_of(key) for key in missing], processes, keep)
    return [known[key] for key in wanted]


def read_records(path: Path) -> list[Record]:
    """All whole records of the file; a last line that was cut off is left out.

    InputError if the file cannot be read or is another file.
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
    """Add one line, on a line of its own even after one that was cut off."""
    with path.open("ab+") as file:
        if file.tell() > 0:
            file.seek(-1, 2)
            if file.read(1) != b"\n":
                file.write(b"\n")
        file.write(json.dumps(line).encode() + b"\n")


def lines_of(records: Sequence[Record]) -> list[Line]:
    """One line for each effect, in the order of their first records."""
    return [
        _line(effect, [line for line in records if line["effect"] == effect])
        for effect in dict.fromkeys(line["effect"] for line in records)
    ]


def _line(effect: str, records: list[Record]) -> Line:
    answered = [line for line in records if line["estimates"]]
    good = [line for line in answered if line["verdict"] == "good"]
    z = [_z(line) for line in answered]
    pooled = np.concatenate(z) if z else np.empty(0)
    worst = None
    if len({each.size for each in z}) == 1:
        means = np.mean(z, axis=0)
        worst = float(means[np.abs(means).argmax()])
    return Line(
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
    """Error over standard deviation of EI, element by element."""
    return np.array(
        [
            (line["estimates"][name]["mean"] - line["truth"][name]) / line["estimates"][name]["std"]
            for name in _rigidities(line)
        ]
    )


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


def world_checks(records: Sequence[Record]) -> list[Check]:
    """The aims: of no effect a wrong good one; of enough crossings true intervals and no bias."""
    found = []
    for line in lines_of(records):
        if line.largest_z_good is not None:
            found.append(
                Check(
                    f"{line.effect}: largest |z| among good", line.largest_z_good, 0.0, _LARGEST_Z
                )
            )
        if line.crossings >= _FEWEST:
            found.append(Check(f"{line.effect}: coverage", line.coverage, *_COVERAGE))
            mean = line.mean_z if line.worst_mean_z is None else line.worst_mean_z
            size = None if mean is None else abs(mean)
            found.append(Check(f"{line.effect}: mean z", size, 0.0, _LARGEST_MEAN_Z))
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


def cells(line: Line) -> list[str]:
    """The cells of a row of the table under HEADINGS."""

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
