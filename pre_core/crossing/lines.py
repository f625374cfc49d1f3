"""Spectral lines in the residuals: hum of the mains, or an engine at constant speed.

A sensor that picks up a steady vibration or hum adds a sinusoid to residuals which otherwise fit.
Neither road nor bridge nor truck explains it, so a crossing with 0.003 m/s² of it ends as a misfit.
Such a line is detected in the whitened residuals of a failed search, and the search is repeated
with waves of its frequency in each kind of residual, of unknown amplitudes that change within a
second: all residuals are projected orthogonally to these waves, which is least squares with
uninformative amplitudes (Golub & Pereyra 1973). This loses the information within half a hertz of
the line.

A line is above 10 Hz, where neither body nor bridge of a short span vibrates, narrow, and as strong
before the bridge as on and after it, unlike any response of truck or bridge to a road.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing import splines

_KNOT_S = 1.0
"""Knot spacing of the waves' amplitudes and phases."""
_DEGREE = 3
_LOWEST_HZ = 10.0
_HIGHEST_SHARE = 0.95
"""Highest frequency relative to half the residuals' rate."""
_WITHIN_HZ, _BESIDE_HZ = 0.4, 2.5
"""Half width of a line, and distance of its reference band."""
_WITHIN_BINS = 2.5
"""Half width of a line in a short record, by Hann's window."""
_MIN_PROMINENCE = 30.0
"""Smallest ratio of a line's peak in the periodogram to the mean of the adjacent frequencies. For
noise alone the highest ratio in a record is 10; wheel hop has peaks 1 Hz wide and more."""
_FEWEST = 40
"""Fewest frequencies for a detection."""
_PARTS = 4
_STEADY = 0.25
"""Smallest ratio of a line's power in a quarter of the record to its mean over the quarters."""
_PEAKS = 4
"""Number of highest peaks that are tested."""


class _Spectra(NamedTuple):
    """Periodogram (f, kinds) of residuals at frequencies (f,), each kind divided by its median."""

    hz: FloatArray
    power: FloatArray


def line_waves(lines_hz: Sequence[float], count: int, apart_s: float) -> FloatArray:
    """Return orthonormal columns (count, w) that span waves of all lines at the residuals.

    The waves are cosine and sine of each line, times cubic splines with knots a second apart.
    """
    time = apart_s * np.arange(count, dtype=np.float64)
    spans = max(1, round(float(time[-1]) / _KNOT_S))
    knots = splines.clamped_knots(np.linspace(0.0, float(time[-1]), spans + 1), _DEGREE)
    slow = splines.basis(knots, _DEGREE, time)
    phase = 2.0 * np.pi * np.outer(lines_hz, time)
    quick = np.concatenate([np.cos(phase), np.sin(phase)])
    columns = (quick[:, :, None] * slow).transpose(1, 0, 2).reshape(count, -1)
    return np.asarray(np.linalg.qr(columns)[0])


def project_out(columns: FloatArray, rows: FloatArray) -> FloatArray:
    """Return residuals (k, m) minus their part in the span of orthonormal columns (m, w)."""
    return np.asarray(rows - (rows @ columns) @ columns.T)


def strongest_line_hz(white: FloatArray, apart_s: float) -> float:
    """Return the frequency in Hz of the clearest line in residuals (m, kinds), 0 if there is none.

    Residuals are `apart_s` apart; frequencies above half their rate alias.
    """
    whole = _spectra(white, apart_s)
    if whole is None:
        return 0.0
    total = whole.power.sum(axis=1)
    for at in np.argsort(total)[::-1][:_PEAKS]:
        hz = float(whole.hz[at])
        if _is_narrow(whole.hz, total, hz) and _is_steady(white, apart_s, hz):
            return hz
    return 0.0


def _spectra(white: FloatArray, apart_s: float) -> _Spectra | None:
    """Return the periodograms of all kinds with any power, from `_LOWEST_HZ` on."""
    count = white.shape[0]
    hz = np.arange(count // 2 + 1, dtype=np.float64) / (count * apart_s)
    asked = (hz >= _LOWEST_HZ) & (hz <= _HIGHEST_SHARE * 0.5 / apart_s)
    if asked.sum() < _FEWEST:
        return None
    power = np.abs(np.fft.rfft(white * np.hanning(count)[:, None], axis=0)[asked]) ** 2
    middle = np.median(power, axis=0)
    return _Spectra(hz[asked], power[:, middle > 0.0] / middle[middle > 0.0])


def _is_narrow(hz: FloatArray, power: FloatArray, line_hz: float) -> bool:
    """Return whether the power about a line is clearly above that on either side."""
    return bool(_prominence(hz, power[None, :], line_hz)[0] > _MIN_PROMINENCE)


def _prominence(hz: FloatArray, power: FloatArray, line_hz: float) -> FloatArray:
    """Return the peak at a line over the mean nearby, of each periodogram (k, f)."""
    apart = np.abs(hz - line_hz)
    within = max(_WITHIN_HZ, _WITHIN_BINS * float(hz[1] - hz[0]))
    beside = power[:, (apart > within) & (apart < within + _BESIDE_HZ)].mean(axis=1)
    return np.asarray(power[:, apart <= within].max(axis=1) / beside)


def _is_steady(white: FloatArray, apart_s: float, line_hz: float) -> bool:
    """Return whether each quarter of the residuals (m, kinds) has its share of a line."""
    found = [
        _power_at(part, apart_s, line_hz) for part in np.array_split(white, _PARTS) if part.size
    ]
    return min(found) > _STEADY * float(np.mean(found))


def _power_at(rows: FloatArray, apart_s: float, hz: float) -> float:
    """Return the power of the residuals (m, kinds) at a frequency, of all kinds."""
    count = rows.shape[0]
    wave = np.hanning(count) * np.exp(-2j * np.pi * hz * apart_s * np.arange(count))
    return float(np.sum(np.abs(wave @ rows) ** 2))


def folded_hz(hz: float, apart_s: float) -> float:
    """Return the alias of a sensor frequency in residuals that are `apart_s` apart."""
    return abs(hz - round(hz * apart_s) / apart_s)


def unfolded_hz(signals: FloatArray, step_s: float, apart_s: float, hz: float) -> float:
    """Return the frequency in Hz of signals (k, n) whose alias in the residuals is a line at `hz`.

    Signals are `step_s` apart and residuals `apart_s`. Of the frequencies with this alias, the one
    with the strongest line in any signal is returned.
    """
    count = signals.shape[1]
    at = np.arange(count // 2 + 1, dtype=np.float64) / (count * step_s)
    power = np.abs(np.fft.rfft(signals * np.hanning(count), axis=1)) ** 2

    return max((hz, 1.0 / apart_s - hz), key=lambda one: float(_prominence(at, power, one).max()))
