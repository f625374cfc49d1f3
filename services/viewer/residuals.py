"""Residuals of a crossing's fit by kind, segment and band, computed again for a picture.

A result has chi2 and no residuals. Where the samples of its crossing are available they are
computed from the result (`crossing.fitted_residuals`): a second a crossing, no search.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from pre_core.crossing.fitted_residuals import FittedResiduals, FittedValues, fitted_residuals
from pre_core.crossing.preparation import CrossingInputs
from pre_core.diagnostics import quality
from pre_core.parameters import names
from schemas.results import CrossingResult
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.topics import Message
from services.common.arrays import Floats
from services.common.progress import Steps, no_step_progress
from services.execution.blas import one_blas_thread
from services.finding.crossing_data import CrossingData, wide_window
from services.finding.finder import crossings_in
from services.finding.placed import first_axle, middle_of
from services.identification.methods import METHODS
from services.identification.pre_method import inputs_of
from services.identification.result_parts import nominal_parameters
from services.viewer.crossing_view import ResidualCells

BANDS_HZ = (0.0, 6.0, 12.0, 30.0, np.inf)
"""Bands that the verdict uses, Hz (docs/verdicts.md)."""
_SAME_CHI2 = 0.1
"""Relative tolerance of chi2 within which residuals belong to the result."""
_AROUND_NS = 30 * 10**9
"""Time in ns before and after a crossing of the fixes and samples of its identification."""
_BELIEVED = 0.999


class _CrossingWithData(NamedTuple):
    """Data of a crossing, detected again, with its result."""

    data: CrossingData
    result: CrossingResult


def residual_cells(
    crossings: Iterable[CrossingResult],
    messages: Iterable[Message],
    site: Site,
    progress: Steps = no_step_progress,
    most: int = 12,
) -> dict[str, ResidualCells]:
    """Return the residual bins of crossings by method `pre` with samples, by crossing_id.

    A crossing is skipped if its chi2 differs: its samples or its site file are not those of its
    identification. Of more than `most` the newest count, as each takes half a second. `progress` is
    called for each.
    """
    fitted = [
        c for c in crossings if METHODS[c.method].has_noise_model and c.parameters is not None
    ]
    newest = sorted(fitted, key=lambda one: one.entry_time)[-most:]
    wanted = {crossing.crossing_id: crossing for crossing in newest}
    if not wanted:
        return {}
    found = {}
    with one_blas_thread():
        seen = _detect_again(wanted, messages, site)
        for number, (data, result) in enumerate(seen):
            progress(number, len(seen))
            cells = _cells(data, result)
            if cells is not None:
                found[result.crossing_id] = cells
    return found


def _detect_again(
    wanted: Mapping[str, CrossingResult], messages: Iterable[Message], site: Site
) -> list[_CrossingWithData]:
    """Return the data of identified crossings, detected again; nothing is fitted."""
    times = np.array([(1e9 * c.entry_time, 1e9 * c.exit_time) for c in wanted.values()])
    begin, end = times[:, 0] - _AROUND_NS, times[:, 1] + _AROUND_NS
    near = (
        (message.key, message.payload)
        for message in messages
        if message.key.owner == "vehicle"
        and message.key.stream in ("accel", "gnss")
        and bool(np.any((begin <= message.log_time_ns) & (message.log_time_ns <= end)))
    )
    found = {one.crossing_id: one for one in crossings_in(near, site, wide_window)}
    return [_CrossingWithData(found[name], wanted[name]) for name in wanted if name in found]


def _cells(data: CrossingData, result: CrossingResult) -> ResidualCells | None:
    inputs = _inputs(data)
    if inputs is None or result.chi2_per_dof is None:
        return None
    left = fitted_residuals(inputs, _found(data, result))
    if not abs(left.chi2_per_dof / result.chi2_per_dof - 1.0) < _SAME_CHI2:
        return None
    return _by_band(left)


def _inputs(data: CrossingData) -> CrossingInputs | None:
    """Return the unbroken samples around the crossing, as inputs of method `pre`."""
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


def _found(data: CrossingData, result: CrossingResult) -> FittedValues:
    parameters = result.parameters or {}
    theta: Floats = nominal_parameters(data.vehicle, data.bridge)
    for n, name in enumerate(names(data.bridge.elements, first_axle(data.vehicle))):
        if name in parameters:
            theta[n] = parameters[name].q50
    believed = None if result.derived is None else result.derived.springs_believed
    return FittedValues(
        theta,
        result.diagnostics.get("position_shift_m", 0.0),
        result.road is not None and result.road.mismatch is not None,
        believed is None or believed > _BELIEVED,
        result.hum_hz(),
    )


def _by_band(left: FittedResiduals) -> ResidualCells:
    kinds, bands = left.white.shape[1], len(BANDS_HZ) - 1
    mean_square, excess = np.full((kinds, 3, bands), np.nan), np.zeros((kinds, 3, bands))
    found = quality.residual_bins(left.white, left.segment, left.step_s, np.array(BANDS_HZ))
    for place, cell in found.items():
        # Of a tandem that shares its load no body equation is a residual.
        if cell.size and left.white[:, place[0]].any():
            mean_square[place], excess[place] = cell.mean_square, quality.bin_excess(cell)
    return ResidualCells(mean_square, excess, BANDS_HZ)
