"""Preview of a drive as it is read, in lines of text: guesses, first rows, curves."""

from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise
from typing import Final

import numpy as np

from services.common.arrays import Floats
from services.common.language import utc_second
from services.common.naming import count_of
from services.drives.runs import Run, grid_index
from services.drives.tables.guesses import grouped
from services.drives.tables.reading import InterpretedRuns

_ROWS: Final = 3
_BARS: Final = "▁▂▃▄▅▆▇█"
_KINDS: Final = {
    "converts": "guess",
    "columns": "guess",
    "lost": "note",
    "open": "open",
    "form": "form",
}
_GAP: Final = 1


def preview_lines(found: InterpretedRuns, width: int) -> list[str]:
    """Return the lines printed before anything is written, each at most `width` long."""
    lines = [f"{_KINDS[one.kind]}: {one.text}" for one in grouped(found.guesses)]
    if not lines:
        lines = ["the files have driveby's own format (docs/contract.md); nothing is guessed"]
    for run in found.runs:
        lines += ["", *_of_run(run, width)]
    return lines


def _of_run(run: Run, width: int) -> list[str]:
    seconds = float(run.accel_time_s[-1] - run.accel_time_s[0])
    gaps = int(np.sum(np.diff(grid_index(run.accel_time_s)) > _GAP))
    table: list[Sequence[object]] = [("time (UTC)", *run.channels)]
    for row in range(min(_ROWS, run.accel_time_s.size)):
        values = [f"{v[row]:.4f}" for v in run.channels.values()]
        table.append((_clock(run.accel_time_s[row]), *values))
    fixes: list[Sequence[object]] = [
        ("time (UTC)", "latitude", "longitude", "altitude m", "speed m/s")
    ]
    gnss = run.gnss
    fixes += [
        (
            _clock(gnss.time_s[row]),
            f"{gnss.latitude_deg[row]:.6f}",
            f"{gnss.longitude_deg[row]:.6f}",
            "unknown" if np.isnan(gnss.altitude_m[row]) else f"{gnss.altitude_m[row]:.1f}",
            f"{gnss.speed_m_per_s[row]:.2f}",
        )
        for row in range(min(_ROWS, gnss.time_s.size))
    ]
    curves = {f"{name} m/s²": values for name, values in run.channels.items()}
    curves |= {"speed m/s": gnss.speed_m_per_s}
    label = max(len(name) for name in curves)
    head = (
        f"{run.source}: {utc_second(float(run.accel_time_s[0]))} UTC, "
        f"{seconds:.1f} s at {run.rate_hz:g} Hz, "
        f"{count_of(gaps, 'gap')}, {gnss.time_s.size} fixes"
    )
    return [
        head,
        *_aligned(table),
        *_aligned(fixes),
        *(_curve(name.ljust(label), values, width) for name, values in curves.items()),
    ]


def _aligned(table: Sequence[Sequence[object]]) -> list[str]:
    widths = [max(len(str(row[k])) for row in table) for k in range(len(table[0]))]
    return [
        "  " + "  ".join(str(cell).rjust(w) for cell, w in zip(row, widths, strict=True))
        for row in table
    ]


def _curve(name: str, values: Floats, width: int) -> str:
    """Return a line of bars: the largest magnitude in each of as many segments as fit."""
    size = np.abs(values)
    room = max(8, width - len(name) - 16)
    edges = np.unique(np.linspace(0, size.size, min(room, size.size) + 1).astype(int))
    peaks = np.array([size[a:b].max() for a, b in pairwise(edges)])
    top = float(peaks.max())
    heights = np.rint(7.0 * peaks / max(top, 1e-12)).astype(int)
    return f"  {name} {''.join(_BARS[h] for h in heights)} at most {top:.3g}"


def _clock(time_s: float) -> str:
    return f"{datetime.fromtimestamp(round(float(time_s), 6), UTC):%H:%M:%S.%f}"
