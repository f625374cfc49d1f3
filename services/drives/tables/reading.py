"""Vendors' tables as runs: by a map, or by guesses that are to be confirmed.

The runs equal those of files in the form of docs/contract.md: accelerations in m/s² with axes and
gravity as the site file declares them. All findings form a map, by which the same files are read
again without a guess.
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from schemas.signals import MAX_RATE_HZ
from services.common.errors import InputError
from services.drives.runs import Run, sampling_rate_hz
from services.drives.tables.accelerations import as_declared, scaled
from services.drives.tables.clocks import begins, check_overlap
from services.drives.tables.dialect import read_sheet
from services.drives.tables.findings import Findings, Target
from services.drives.tables.guesses import Guess, conversions
from services.drives.tables.mapping import FileMap, ImportMap
from services.drives.tables.parts import TablePart, read_part
from services.drives.tables.positions import track
from services.drives.tables.rows import fixes, samples
from services.drives.tables.stamps import zone_of

_NUMBER: Final = re.compile(r"\d+(?=\D*$)")
_SUFFIXES: Final = (".csv", ".txt", ".tsv", ".dat", ".asc")


class InterpretedRuns(NamedTuple):
    """Runs, the guesses made to read them, and the complete map."""

    runs: list[Run]
    guesses: list[Guess]
    mapping: ImportMap

    def conversions(self) -> list[str]:
        """Return the guesses that are to be confirmed."""
        return conversions(self.guesses)


def interpret(sources: Sequence[Path], given: ImportMap, target: Target) -> InterpretedRuns:
    """Read a folder, or the files of one run; InputError in one line if that is impossible."""
    paths = _files(sources, given)
    guesses: list[Guess] = []
    zone = None if target.zone is None else zone_of(target.zone, "--zone")
    parts: list[TablePart] = []
    for path in paths:
        file_map = given.of(path.name) or FileMap(name=path.name)
        own = zone if file_map.time.zone is None else zone_of(file_map.time.zone, f"{path}: zone")
        sheet = read_sheet(path, file_map)
        channels = target.vehicle.channels
        parts.append(read_part(sheet, file_map, channels, target.declared_hz, own, guesses))
    runs: list[Run] = []
    maps: list[tuple[FileMap, str]] = []
    groups = _groups(parts, is_one=len(sources) > 1)
    for run_name, group in groups.items():
        run, found = _read(group, run_name, len(groups), target, guesses)
        runs.append(run)
        maps += [(one, run_name) for one in found]
    runs.sort(key=lambda run: float(run.accel_time_s[0]))
    for before, after in pairwise(runs):
        if after.accel_time_s[0] <= before.accel_time_s[-1]:
            raise InputError(
                f"{after.source}: begins before {before.source} ends, runs of one truck must "
                "follow one another: give each its start in [file.time] of a map (--map)"
            )
    return InterpretedRuns(runs, list(dict.fromkeys(guesses)), _merged(maps))


def _files(sources: Sequence[Path], given: ImportMap) -> list[Path]:
    if len(sources) > 1 or not sources[0].is_dir():
        return list(sources)
    folder = sources[0]
    paths = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in _SUFFIXES and not path.name.startswith(".")
    )
    used = [path for path in paths if not (given.of(path.name) or FileMap()).skip]
    if not used:
        raise InputError(
            f"{folder}: holds no table ({', '.join(_SUFFIXES)}), a drive as CSV files expected"
        )
    return used


def _run_name(part: TablePart) -> str:
    file_map = part.given.run_of(part.name)
    if file_map is not None:
        return file_map
    digits = re.findall(r"\d+", Path(part.name).stem)
    return digits[-1] if digits else ""


def _groups(parts: list[TablePart], *, is_one: bool) -> dict[str, list[TablePart]]:
    """Return the files of each run: those whose names end in the same number."""
    for part in parts:
        if not part.has_fixes() and not part.channels():
            raise InputError(
                f"{part.sheet.path}: has neither accelerations nor positions: set skip = true "
                "in its [[file]] of a map (--map) if it is no part of the drive"
            )
    groups: dict[str, list[TablePart]] = defaultdict(list)
    for part in parts:
        groups["" if is_one else _run_name(part)].append(part)
    if all(_is_whole(group) for group in groups.values()):
        return dict(groups)
    if _is_whole(parts):
        return {"": parts}
    for group in groups.values():
        if not _is_whole(group):
            missing = "positions" if not any(p.has_fixes() for p in group) else "accelerations"
            if any(p.has_fixes() for p in group) and any(p.channels() for p in group):
                missing = "one file of positions, and each channel once,"
            names = ", ".join(p.name for p in group)
            raise InputError(
                f"{group[0].sheet.path.parent}: {names}: {missing} expected next to it: files of "
                "one run end in the same number, or set run = in each [[file]] of a map (--map)"
            )
    raise AssertionError("unreachable: an incomplete group was found")


def _is_whole(group: Sequence[TablePart]) -> bool:
    channels = [name for part in group for name in part.channels()]
    return (
        sum(part.has_fixes() for part in group) == 1
        and bool(channels)
        and len(set(channels)) == len(channels)
    )


def _read(
    parts: list[TablePart], run: str, runs: int, target: Target, guesses: list[Guess]
) -> tuple[Run, list[FileMap]]:
    """Return a run, and the map of each of its files."""
    found = Findings(parts, guesses)
    with_samples = [part for part in parts if part.channels()]
    (with_fixes,) = [part for part in parts if part.has_fixes()]
    begin = begins(parts, run, runs, target, found)
    source = str(with_samples[0].sheet.path)
    time_s, channels = samples(with_samples, begin, target, found)
    positions = fixes(with_fixes, begin[with_fixes.name], found)
    check_overlap(source, time_s, with_fixes, positions)
    rate_hz = sampling_rate_hz(time_s)
    if not 1 <= rate_hz <= MAX_RATE_HZ:
        raise InputError(
            f"{source}: its times give a rate of {rate_hz:g} Hz, 1 to {MAX_RATE_HZ:g} Hz "
            "expected: give format in [file.time] of a map (--map)"
        )
    owner = {name: part for part in with_samples for name in part.channels()}
    accelerations = scaled(channels, rate_hz, owner, target, found)
    declared = channels
    if accelerations is not None:
        declared = as_declared(accelerations, owner, target, found)
    driven = track(with_fixes, positions, target, found)
    return Run(source, time_s, rate_hz, declared, driven), found.maps()


def _merged(maps: Sequence[tuple[FileMap, str]]) -> ImportMap:
    """Return one map for files of several runs that are read alike."""
    by_pattern: dict[str, list[tuple[FileMap, str]]] = defaultdict(list)
    for one, run in maps:
        by_pattern[_NUMBER.sub("*", one.name)].append((one, run))
    found: list[FileMap] = []
    for name, files in by_pattern.items():
        alike = {one.model_copy(update={"name": name}).model_dump_json() for one, _ in files}
        first = files[0][0].model_copy(update={"name": name})
        # A pattern must match the same runs again, and each file once.
        if len(alike) == 1 and all(first.run_of(one.name) == run for one, run in files):
            found.append(first)
        else:
            found += [one.model_copy(update={"run": run or "0"}) for one, run in files]
    return ImportMap.model_validate({"file": tuple(found)})
