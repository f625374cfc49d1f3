"""The view of the residuals: a table of coloured bins, as Rerun has no plot of y over x.

Coordinates are in units of a bin: bands from left to right, segments from top to bottom.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from services.common.arrays import Floats
from services.viewer.crossing_scene import CrossingScene, Panel
from services.viewer.crossing_view import ResidualCells
from services.viewer.rerun_parts import RerunStream, flat_view, log_labels

_KINDS = ("profiles", "front body", "rear body")
_STRETCHES = ("before", "on", "after")
_PIXELS = 40
"""Height and width of a bin in pixels; fewer would be drawn blurred."""
_SHADES = ((0.0, (30, 58, 82)), (3.0, (58, 78, 92)), (6.0, (213, 94, 0)))
"""Colours by standard deviations above the expectation; grey without data."""
_NOTHING = (42, 46, 50)
_GAP = 0.3
"""Gap between the kinds."""


def _layout(scene: CrossingScene, _: ResidualCells) -> rrb.View:
    return flat_view(f"{scene.root}/residuals", "Residuals", (-2.8, 4.2), (-1.3, 10.7))


def _log(recording: RerunStream, scene: CrossingScene, cells: ResidualCells) -> None:
    """Draw the mean square of each bin over the declared noise power."""
    crossing, entity = scene.crossing, f"{scene.root}/residuals"
    kinds, stretches, bands = cells.mean_square.shape
    shades = _shades(cells)
    across: Floats = np.arange(bands, dtype=np.float64) + 0.5
    down = _rows(kinds, stretches)
    for kind in range(kinds):
        block = np.repeat(np.repeat(shades[kind], _PIXELS, axis=0), _PIXELS, axis=1)
        place = f"{entity}/cells/{kind}"
        top = down[kind * stretches] - 0.5
        at = rr.Transform3D(translation=(0.0, top, 0.0), scale=1.0 / _PIXELS)
        recording.log(place, at, static=True)
        recording.log(place, rr.Image(block), static=True)
    x, y = np.tile(across, kinds * stretches), np.repeat(down - 0.35, bands)
    values = cells.mean_square.reshape(-1)
    known = np.isfinite(values)
    numbers = [f"{value:.2f}" for value in values[known]]
    log_labels(recording, f"{entity}/value", numbers, x[known], y[known], colour="#FFFFFF")
    log_labels(recording, f"{entity}/band", band_names(cells), across, np.full(bands, -0.85))
    names = [f"{kind}, {stretch}" for kind in _KINDS for stretch in _STRETCHES]
    log_labels(recording, f"{entity}/name", names, np.full(down.size, -1.5), down - 0.35)
    chi2 = "–" if crossing.chi2_per_dof is None else f"{crossing.chi2_per_dof:.2f}"
    wording = [f"reduced chi-square of all residuals {chi2}; 1 is expected everywhere", "Hz"]
    places = np.array([0.7, -1.5]), np.array([down[-1] + 0.75, -0.85])
    log_labels(recording, f"{entity}/chi2", wording, *places)


def band_names(cells: ResidualCells) -> list[str]:
    """Return the names of the bands: `0–6`, … and `over 30`."""
    low, high = cells.edges_hz[:-1], cells.edges_hz[1:]
    return [
        f"{a:g}–{b:g}" if np.isfinite(b) else f"over {a:g}" for a, b in zip(low, high, strict=True)
    ]


def _rows(kinds: int, stretches: int) -> Floats:
    """Return the middles of all rows from top to bottom, with gaps between the kinds."""
    number = np.arange(kinds * stretches)
    return np.asarray(number + 0.5 + _GAP * (number // stretches), dtype=np.float64)


def _shades(cells: ResidualCells) -> NDArray[np.uint8]:
    at = [z for z, _ in _SHADES]
    channels = np.array([colour for _, colour in _SHADES], dtype=np.float64).T
    mixed = np.stack([np.interp(cells.excess_std, at, one) for one in channels], axis=-1)
    mixed[~np.isfinite(cells.mean_square)] = _NOTHING
    shades: NDArray[np.uint8] = np.rint(mixed).astype(np.uint8)
    return shades


PANEL: Final = Panel(lambda scene: scene.crossing.residuals, _layout, _log)
