"""Selection of a table's rows: complete ones, each time once, in order of time."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.naming import count_of
from services.drives.tables.evidence import sentinels
from services.drives.tables.findings import Findings, Target
from services.drives.tables.mapping import POSITION_COLUMNS
from services.drives.tables.parts import TablePart
from services.drives.tables.stamps import kept_rows

_NO_FIX: Final = (91.0, 181.0, 99.0, 999.0, 9999.0, 99999.0, 99.9999, 999.9999)
"""Latitudes and longitudes that receivers write without a fix."""
_MAX_OUT: Final = 0.5
_HELD: Final = 0.5
"""Share of fixes equal to their predecessor where fixes are held between measurements."""


def samples(
    parts: Sequence[TablePart], begin: Mapping[str, float], target: Target, found: Findings
) -> tuple[Floats, dict[str, Floats]]:
    """Return times and channels of all files with accelerations."""
    read = [_samples_of(part, begin[part.name], target, found) for part in parts]
    time_s, channels = read[0]
    for part, (other_s, others) in zip(parts[1:], read[1:], strict=True):
        common, here, there = np.intersect1d(
            np.rint(time_s * 1e5), np.rint(other_s * 1e5), return_indices=True
        )
        if common.size < 0.9 * max(time_s.size, other_s.size):
            raise InputError(
                f"{part.sheet.path}: is not sampled at the times of {parts[0].name}: "
                f"{common.size} of {other_s.size} times are common; one table of all channels "
                "is expected"
            )
        if (lost := max(time_s.size, other_s.size) - common.size) > 0:
            missing = count_of(lost, "sample")
            found.guess(part, f"left out: {missing} that not every file has", "lost")
        time_s = time_s[here]
        channels = {n: v[here] for n, v in channels.items()}
        channels |= {n: v[there] for n, v in others.items()}
    if time_s.size < 2:
        raise InputError(f"{parts[0].sheet.path}: has {time_s.size} samples, at least 2 needed")
    return time_s, channels


def _samples_of(
    part: TablePart, begin_s: float, target: Target, found: Findings
) -> tuple[Floats, dict[str, Floats]]:
    names = part.channels()
    values = np.column_stack([part.columns[name] for name in names])
    absent = np.column_stack([sentinels(values[:, k]) for k in range(len(names))])
    if absent.any():
        shown = ", ".join(f"{value:g}" for value in np.unique(values[absent])[:3])
        cells = count_of(int(absent.sum()), "cell")
        found.guess(part, f"{shown} stands for a missing value in {cells}", "lost")
        values = np.where(absent, np.nan, values)
    whole = np.isfinite(values).all(axis=1) & np.isfinite(part.times.time_s)
    if not whole.any():
        raise InputError(f"{part.sheet.path}: no row has all of {', '.join(names)}")
    if not whole.all():
        first = part.sheet.numbers[int(np.flatnonzero(~whole)[0])]
        empty = count_of(int((~whole).sum()), "row")
        text = f"left out as a gap: {empty} with empty cells (first in line {first})"
        found.guess(part, text, "lost")
    values, time_s = values[whole], part.times.time_s[whole]
    declared = target.declared_hz
    even = part.given.time.even
    kept = kept_rows(time_s, values, declared, even=even, where=str(part.sheet.path))
    if kept.repeated:
        found.guess(part, f"repeated rows left out: {kept.repeated}", "lost")
    if kept.late:
        found.guess(part, f"rows not later than the row before left out: {kept.late}", "lost")
    if kept.is_even and even is None:
        found.guess(part, f"stamps are rounded; the samples are evenly spaced at {declared:g} Hz")
    found.time(part, even=kept.is_even)
    channels = {n: np.ascontiguousarray(values[kept.rows, k]) for k, n in enumerate(names)}
    return kept.time_s + begin_s, channels


def fixes(part: TablePart, begin_s: float, found: Findings) -> dict[str, Floats]:
    """Return the fixes as in the file, by quantity, and `time_s`."""
    names = [name for name in POSITION_COLUMNS if name in part.columns]
    table = np.column_stack([part.times.time_s, *(part.columns[name] for name in names)])
    is_out = np.isin(np.abs(table[:, 1:3]), _NO_FIX).any(axis=1)
    table[is_out & (is_out.mean() < _MAX_OUT), 1:3] = np.nan
    there = np.isfinite(table[:, :3]).all(axis=1) & np.any(table[:, 1:3] != 0.0, axis=1)
    if "speed_mps" in names:
        there &= np.isfinite(table[:, 1 + names.index("speed_mps")])
    if not part.channels() and not there.all():
        rows = count_of(int((~there).sum()), "row")
        found.guess(part, f"left out: {rows} without a fix", "lost")
    table = table[there]
    if not table.size:
        raise InputError(f"{part.sheet.path}: has no fix, at least 2 expected")
    held = part.given.held_fixes
    is_held = np.concatenate([[False], np.all(np.diff(table[:, 1:3], axis=0) == 0, axis=1)])
    if held is None and part.channels():
        held = float(is_held.mean()) > _HELD
        if held:
            found.guess(part, "each fix is repeated until the next one; its first row counts")
    if held:
        table = table[~is_held]
    found.file(part, held_fixes=bool(held))
    is_moving = np.concatenate([[True], np.any(np.diff(table[:, 1:3], axis=0) != 0, axis=1)])
    rate_hz = _fixes_per_second(table[is_moving, 0])
    even = part.given.time.even if not part.channels() and rate_hz else False
    kept = kept_rows(table[:, 0], table[:, 1:3], rate_hz, even=even, where=str(part.sheet.path))
    if kept.is_even:
        found.time(part, even=True)
        if even is None:
            found.guess(part, f"stamps are rounded; the fixes are evenly spaced at {rate_hz:g} Hz")
    if kept.repeated + kept.late:
        late = count_of(kept.repeated + kept.late, "fix", "fixes")
        found.guess(part, f"left out: {late} with a repeated or earlier time", "lost")
    table = table[kept.rows]
    if table.shape[0] < 2:
        raise InputError(f"{part.sheet.path}: has 1 fix, at least 2 expected")
    columns = {name: table[:, 1 + k] for k, name in enumerate(names)}
    return columns | {"time_s": kept.time_s + begin_s}


def _fixes_per_second(time_s: Floats) -> float:
    """Return the rate of fixes whose stamps repeat, by their number in each; 0 if they do not."""
    _, counts = np.unique(time_s, return_counts=True)
    steps = np.diff(np.unique(time_s))
    if counts.size < 3 or np.median(counts) < 2:
        return 0.0
    return float(np.median(counts) / np.median(steps))
