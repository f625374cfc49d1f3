"""What the fit of a crossing leaves over by kind, stretch and band: made again for a picture.

A result says chi2 and keeps no residual. Where its crossing's samples are at hand what was left
over is computed from the result (`pre_core.crossing.left_over`): a second a crossing, no search.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from pre_core import unknowns
from pre_core.crossing.left_over import Found, LeftOver, left_over
from pre_core.crossing.preparation import Inputs
from pre_core.diagnostics import quality
from schemas.results import Crossing, Header
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.common.progress import Steps, unwatched_steps
from services.execution.blas import one_blas_thread
from services.execution.dispatch import feed_all
from services.execution.here import Here
from services.identification.crossing_data import CrossingData, nominal_parameters
from services.identification.engine import Engine
from services.identification.placed import middle_of
from services.identification.pre_method import inputs_of
from services.recordings.recording import Message
from services.viewer.crossing_view import FloatArray, ResidualCells

BANDS_HZ = (0.0, 6.0, 12.0, 30.0, np.inf)
"""Those that the verdict looks at (docs/verdicts.md)."""
_SAME_CHI2 = 0.1
"""What is left over belongs to the result if chi2 comes out as the result's to this part of it."""
_AROUND_NS = 30 * 10**9
"""Fixes and samples so long before and after a crossing are what its identification looked at."""
_BELIEVED = 0.999


class _Seen(NamedTuple):
    """A crossing's data as the engine found them, with its result."""

    data: CrossingData
    result: Crossing


def residual_cells(
    crossings: Iterable[Crossing],
    messages: Iterable[Message],
    site: Site,
    progress: Steps = unwatched_steps,
    most: int = 12,
) -> dict[str, ResidualCells]:
    """By crossing_id, of crossings by method `pre` whose samples are in the messages.

    A crossing is left out if its chi2 does not come out again: its samples or its site file are not
    those that it was identified from. Of more than `most` the newest count: each
    takes half a second. `progress` is told of each.
    """
    fitted = [c for c in crossings if c.method == "pre" and c.parameters is not None]
    newest = sorted(fitted, key=lambda one: one.entry_time)[-most:]
    wanted = {crossing.crossing_id: crossing for crossing in newest}
    if not wanted:
        return {}
    found = {}
    with one_blas_thread():
        seen = _seen(wanted, messages, site)
        for number, (data, result) in enumerate(seen):
            progress(number, len(seen))
            cells = _cells(data, result)
            if cells is not None:
                found[result.crossing_id] = cells
    return found


def _seen(wanted: Mapping[str, Crossing], messages: Iterable[Message], site: Site) -> list[_Seen]:
    """What the engine finds again of crossings that have been identified; nothing is fitted."""
    times = np.array([(1e9 * c.entry_time, 1e9 * c.exit_time) for c in wanted.values()])
    begin, end = times[:, 0] - _AROUND_NS, times[:, 1] + _AROUND_NS
    found: dict[str, CrossingData] = {}

    def known(data: CrossingData, settings: IdentificationSettings, **_: Any) -> Crossing:
        found[data.crossing_id] = data
        return wanted.get(data.crossing_id, next(iter(wanted.values())))

    near = (
        (message.key, message.payload)
        for message in messages
        if message.key.owner == "vehicle"
        and message.key.stream in ("accel", "gnss")
        and bool(np.any((begin <= message.log_time_ns) & (message.log_time_ns <= end)))
    )
    header = Header(version="", created=0.0, site_hash="", settings={}, seed=0)
    engine = Engine(site, IdentificationSettings(), header, tells_states=False)
    for _ in feed_all(engine, Here(identify=known), near):
        pass
    return [_Seen(found[name], wanted[name]) for name in wanted if name in found]


def _cells(data: CrossingData, result: Crossing) -> ResidualCells | None:
    inputs = _inputs(data)
    if inputs is None or result.chi2_per_dof is None:
        return None
    left = left_over(inputs, _found(data, result))
    if not abs(left.chi2_per_dof / result.chi2_per_dof - 1.0) < _SAME_CHI2:
        return None
    return _by_band(left)


def _inputs(data: CrossingData) -> Inputs | None:
    """The unbroken samples around the crossing, as method `pre` takes them."""
    samples = data.samples
    channels = data.vehicle.channels
    if samples is None or any(name not in samples.channels for name in channels):
        return None
    acceleration = middle_of(data.vehicle, np.stack([samples.channels[name] for name in channels]))
    holes = np.flatnonzero(~np.isfinite(acceleration).all(axis=0))
    middle_s = 0.5 * (data.stay.entry_s + data.stay.exit_s)
    middle = round((middle_s - samples.start_s) * samples.rate_hz)
    begin = int(holes[holes < middle].max(initial=-1)) + 1
    stop = int(holes[holes >= middle].min(initial=acceleration.shape[1]))
    start_s = samples.start_s + begin / samples.rate_hz
    return inputs_of(data, IdentificationSettings(), acceleration[:, begin:stop], start_s)


def _found(data: CrossingData, result: Crossing) -> Found:
    parameters = result.parameters or {}
    theta: FloatArray = nominal_parameters(data.vehicle, data.bridge)
    for n, name in enumerate(unknowns.names(data.bridge.elements)):
        if name in parameters:
            theta[n] = parameters[name].q50
    believed = None if result.derived is None else result.derived.springs_believed
    return Found(
        theta,
        result.diagnostics.get("position_shift_m", 0.0),
        result.road is not None and result.road.mismatch is not None,
        believed is None or believed > _BELIEVED,
    )


def _by_band(left: LeftOver) -> ResidualCells:
    kinds, bands = left.white.shape[1], len(BANDS_HZ) - 1
    mean_square, excess = np.full((kinds, 3, bands), np.nan), np.zeros((kinds, 3, bands))
    found = quality.cells(left.white, left.stretch, left.step_s, np.array(BANDS_HZ))
    for place, cell in found.items():
        if cell.size:
            mean_square[place], excess[place] = cell.mean_square, quality.cell_excess(cell)
    return ResidualCells(mean_square, excess, BANDS_HZ)
