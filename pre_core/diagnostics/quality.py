"""Statistics of signals and residuals that decide whether a result is reliable; no verdicts.

Before the fit, from four accelerations alone: whether a channel is stuck or saturated, and whether
the channels satisfy the body equation, which has no unknown input. After it, from the whitened
residuals: their mean square for each kind of residual, segment of the drive and frequency band, and
its significance. The thresholds belong to the verdicts.
"""

from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.diagnostics.converter import converter_step

_BODY_BAND_HZ = (0.7, 10.0)
"""Band in which bodies vibrate on their springs; wheels hop above it."""
_BODY_FACTOR = 4.0
"""Largest ratio of k/m and of c/m to their known values, and of the known k/m to k/m."""
_LARGEST_COUPLING = 0.6
"""Largest absolute coupling m_12/m of front and rear through the pitch inertia."""
_SAME = 1e-6
"""Relative tolerance within which two channel assignments explain equally well."""


_BINS = 100
"""Bins of a signal between its median and an end of its range."""
_FINE = 0.2
"""Largest converter step, relative to a bin, that does not show in it."""
_FEWEST_LEVELS = 12
"""Fewest levels of a signal that show how its density decreases."""


# Signals.


def longest_hold(values: FloatArray) -> int:
    """Return the length of the longest run of equal values (n,), in samples."""
    changes = np.flatnonzero(np.diff(values) != 0.0)
    edges = np.concatenate([[-1], changes, [values.size - 1]])
    return int(np.diff(edges).max())


def smallest_difference(signals: FloatArray) -> float:
    """Return the smallest RMS difference of two signals of (c, n), relative to both's joint RMS."""
    smallest = np.inf
    for i in range(signals.shape[0]):
        for j in range(i):
            power = float(signals[i] @ signals[i] + signals[j] @ signals[j])
            difference = signals[i] - signals[j]
            if power > 0.0:
                smallest = min(smallest, float(np.sqrt(difference @ difference / power)))
    return smallest


def repeated_extremes(values: FloatArray) -> int:
    """Return how often a signal (n,) takes its maximum or its minimum, whichever is more frequent.

    It is zero for coarse values (least step above 1e-5 of the largest), where repeats are
    expected.
    """
    distinct = np.unique(values)
    if distinct.size < 3 or np.diff(distinct).min() > 1e-5 * np.abs(distinct).max():
        return 0
    return max(
        int(np.count_nonzero(values == distinct[0])), int(np.count_nonzero(values == distinct[-1]))
    )


class SaturationEvidence(NamedTuple):
    """Accumulation of a signal's values at an end of its range; see `pile_up`."""

    ratio: float
    """Number of samples in the fullest outer bin, divided by the mean of five bins inside it."""
    visits: int
    """Number of separate stays in this bin or beyond it."""
    level: float
    """Middle of this bin, relative to the signal's median."""


def pile_up(values: FloatArray) -> SaturationEvidence:
    """Return how strongly a signal (n,) piles up at an end of its range, as when saturated.

    The density of an unsaturated signal decreases towards its ends: even a smooth peak stays in its
    uppermost hundredth only 2.4 times as long as in the next. A saturated signal stays in the last
    bin for all the time that it should have been beyond. The worse of both ends is returned. Bins
    are at least as wide as the steps of a converter; otherwise some would hold two values and some
    none.
    """
    centred = values - np.median(values)
    step = converter_step(values)
    worst = SaturationEvidence(0.0, 0, 0.0)
    for sign in (1.0, -1.0):
        side = sign * centred
        top = float(side.max())
        if not top > 0.0:
            continue
        if step * _BINS > _FINE * top:
            width = step * np.ceil(top / (_BINS * step))
            count = int(top / width + 0.5) + 1
            if count < _FEWEST_LEVELS:
                continue
            place = np.floor(side / width + 0.5).astype(np.int64).clip(-1, count - 1)
        else:
            count = _BINS
            place = np.floor(side * (_BINS / top)).astype(np.int64).clip(-1, _BINS - 1)
        counts = np.bincount(place[place >= 0], minlength=count).astype(np.float64)
        # A filter after the clipping overshoots the rail slightly.
        for k in range(count - 1, int(0.8 * count), -1):
            inside = counts[k - 6 : k - 1].mean()
            ratio = counts[k] / max(inside, 1.0)
            if ratio > worst.ratio:
                there = place >= k
                visits = int(np.count_nonzero(there[1:] & ~there[:-1])) + int(there[0])
                worst = SaturationEvidence(float(ratio), visits, sign * top * (k + 0.5) / count)
    return worst


def spikes(values: FloatArray, height: float = 20.0) -> int:
    """Return the number of single samples (n,) that deviate from smooth neighbours.

    A sample's distance from the cubic through its four nearest neighbours counts if it is more than
    `height` times the typical one, and if the two nearest are within a seventh of that distance
    from the others' cubic: a kink or step, as an impact causes, is not a single sample.
    """
    if values.size < 9:
        return 0
    x = values
    centre = x[3:-3]
    distance = np.abs(centre - (4.0 * (x[2:-4] + x[4:-2]) - x[1:-5] - x[5:-1]) / 6.0)
    before = np.abs(x[2:-4] - (-0.3 * x[:-6] + x[1:-5] + 0.5 * x[4:-2] - 0.2 * x[5:-1]))
    after = np.abs(x[4:-2] - (-0.3 * x[6:] + x[5:-1] + 0.5 * x[2:-4] - 0.2 * x[1:-5]))
    typical = np.median(distance)
    alone = np.maximum(before, after) < distance / 7.0
    return int(np.count_nonzero((distance > height * typical) & alone)) if typical > 0.0 else 0


class ChannelAssignment(NamedTuple):
    """Assignment of four channels to body and axle, front and rear; see `assign_channels`."""

    recorded: float
    """Share of the body's motion that the body equations do not explain, channels as recorded."""
    upright: tuple[float, float]
    """Unexplained share of the front and of the rear pair."""
    reversed_: tuple[float, float]
    """Unexplained shares with the axle's sign reversed."""
    best: float
    """Unexplained share of the best other assignment."""
    best_order: tuple[int, int, int, int]
    """Channels of the best other assignment: sprung front and rear, unsprung front and rear."""


def assign_channels(
    acceleration_m_per_s2: FloatArray,
    step_s: float,
    stiffness_per_mass: FloatArray,
    damping_per_mass: FloatArray,
) -> ChannelAssignment:
    """Test the order and the signs of four accelerations (4, n) by the body equations.

    a_s + (c/m)(v_s - v_u) + (k/m)(z_s - z_u) + (m_12/m) a_s,other = 0 holds for the right channels
    on any road and bridge, and for hardly any others. k/m is free within a factor of 4 of its known
    value, c/m from 0 to 4 times its known value, the coupling m_12/m within 0.6. Known values are
    (2,), front and rear. The band is 0.7 to 10 Hz.
    """
    spectrum, omega = _spectrum(acceleration_m_per_s2, step_s, _BODY_BAND_HZ)
    left: dict[tuple[int, int, int, int, bool], float] = {}

    def unexplained(w: int, s: int, u: int, other: int, *, upright: bool = True) -> float:
        key = (w, s, u, other, upright)
        if key not in left:
            left[key] = _unexplained(
                spectrum[s],
                spectrum[u] if upright else -spectrum[u],
                spectrum[other],
                omega,
                float(stiffness_per_mass[w]),
                float(damping_per_mass[w]),
            )
        return left[key]

    upright = (unexplained(0, 0, 2, 1), unexplained(1, 1, 3, 0))
    best, best_order = np.inf, (0, 1, 2, 3)
    # The assignment that moves the fewest channels comes first: swapping both pairs as well is
    # equally good within rounding.
    for order in sorted(permutations(range(4)), key=_moved_channels):
        s_1, s_2, u_1, u_2 = order
        # Swapping both pairs changes neither equation: that is for `same_place.axle_correlation`.
        if order in ((0, 1, 2, 3), (1, 0, 3, 2)):
            continue
        value = max(unexplained(0, s_1, u_1, s_2), unexplained(1, s_2, u_2, s_1))
        if value < best * (1.0 - _SAME):
            best, best_order = value, (s_1, s_2, u_1, u_2)
    return ChannelAssignment(
        max(upright),
        upright,
        (unexplained(0, 0, 2, 1, upright=False), unexplained(1, 1, 3, 0, upright=False)),
        best,
        best_order,
    )


def unexplained_by_axle(
    acceleration_m_per_s2: FloatArray,
    step_s: float,
    stiffness_per_mass: FloatArray,
    damping_per_mass: FloatArray,
) -> tuple[float, float]:
    """Return `ChannelAssignment.upright` of channels (4, n); other orders are not tested."""
    spectrum, omega = _spectrum(acceleration_m_per_s2, step_s, _BODY_BAND_HZ)
    front, rear = (
        _unexplained(
            spectrum[w],
            spectrum[2 + w],
            spectrum[1 - w],
            omega,
            float(stiffness_per_mass[w]),
            float(damping_per_mass[w]),
        )
        for w in range(2)
    )
    return front, rear


def _moved_channels(order: tuple[int, ...]) -> int:
    return sum(channel != place for place, channel in enumerate(order))


def stiffness_per_mass(
    acceleration_m_per_s2: FloatArray,
    step_s: float,
    known_stiffness: FloatArray,
    known_damping: FloatArray,
) -> tuple[float, float]:
    """Return k/m in 1/s² of front and rear from the body equations of accelerations (4, n).

    Known values (2,) bound the fit as in `assign_channels`.
    """
    spectrum, omega = _spectrum(acceleration_m_per_s2, step_s, _BODY_BAND_HZ)
    found = [
        float(known_stiffness[w])
        * float(
            _constants(
                spectrum[w],
                spectrum[2 + w],
                spectrum[1 - w],
                omega,
                float(known_stiffness[w]),
                float(known_damping[w]),
            )[0][0]
        )
        for w in (0, 1)
    ]
    return found[0], found[1]


def _spectrum(
    signals: FloatArray, step_s: float, band_hz: tuple[float, float]
) -> tuple[NDArray[np.complex128], FloatArray]:
    n = signals.shape[1]
    window = np.hanning(n)
    centred = signals - (signals @ window / window.sum())[:, None]
    spectrum = np.fft.rfft(centred * window, axis=1)
    frequency = np.fft.rfftfreq(n, step_s)
    inside = (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    return spectrum[:, inside], np.asarray(2.0 * np.pi * frequency[inside], dtype=np.float64)


def _unexplained(
    body: NDArray[np.complex128],
    axle: NDArray[np.complex128],
    other: NDArray[np.complex128],
    omega: FloatArray,
    stiffness_per_mass: float,
    damping_per_mass: float,
) -> float:
    """Return the smallest |residual|^2 of the body equation over |body|^2 within the bounds."""
    power = float(np.vdot(body, body).real)
    if not power > 0.0:
        return 1.0
    return _constants(body, axle, other, omega, stiffness_per_mass, damping_per_mass)[1] / power


def _constants(
    body: NDArray[np.complex128],
    axle: NDArray[np.complex128],
    other: NDArray[np.complex128],
    omega: FloatArray,
    stiffness_per_mass: float,
    damping_per_mass: float,
) -> tuple[FloatArray, float]:
    """Fit the body equation: return factors of k/m and c/m, the coupling, and |residual|^2."""
    stroke = body - axle
    columns = np.stack(
        [
            -stiffness_per_mass * stroke / omega**2,
            damping_per_mass * stroke / (1j * omega),
            other,
        ],
        axis=1,
    )
    matrix = np.concatenate([columns.real, columns.imag])
    right = -np.concatenate([body.real, body.imag])
    low = [1.0 / _BODY_FACTOR, 0.0, -_LARGEST_COUPLING]
    high = [_BODY_FACTOR, _BODY_FACTOR, _LARGEST_COUPLING]
    return bounded_least_squares(matrix, right, np.array(low), np.array(high))


def bounded_least_squares(
    matrix: FloatArray, right: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, float]:
    """Return the minimiser x (k,) of |matrix x - right|^2 within low <= x <= high, and the minimum.

    `matrix` (m, k) has full rank and few columns: every face of the box is tried (3^k). As the
    problem is convex, the best of the minima within the box is the solution. (scipy.optimize
    handles any number, but its import takes longer than a tenth of a crossing.)
    """
    k = low.size
    root = np.asarray(np.linalg.qr(np.column_stack([matrix, right]), mode="r"))
    triangle, image = root[:k, :k], root[:k, k]
    best, least = low, np.inf
    for is_free in product((True, False), repeat=k):  # all of them first
        free = np.array(is_free)
        ends = [(np.nan,) if one else (low[i], high[i]) for i, one in enumerate(is_free)]
        x = np.array(list(product(*ends))).T  # (k, faces): all with the same free coordinates
        if free.any():
            rest = image[:, None] - triangle[:, ~free] @ x[~free]
            x[free] = np.linalg.lstsq(triangle[:, free], rest, rcond=None)[0]
        inside = np.all((x >= low[:, None]) & (x <= high[:, None]), axis=0)
        cost = np.sum((triangle @ x - image[:, None]) ** 2, axis=0)
        cost[~inside] = np.inf
        face = int(np.argmin(cost))
        if cost[face] < least:
            best, least = x[:, face], float(cost[face])
        if free.all() and inside[0]:
            break
    return best, least + float(np.sum(root[k:, k] ** 2))


# Whitened residuals.


class ResidualBin(NamedTuple):
    """Whitened residuals of one kind, segment of the drive and band: mean square and number."""

    mean_square: float
    size: int


def bin_excess(part: ResidualBin, expected: float = 1.0) -> float:
    """Return how far a bin's mean square exceeds `expected`, in standard deviations.

    Wilson and Hilferty: the cube root of chi squared over its degrees of freedom is nearly normal.
    """
    if part.size == 0:
        return 0.0
    spread = 2.0 / (9.0 * part.size)
    return float((np.cbrt(part.mean_square / expected) - 1.0 + spread) / np.sqrt(spread))


def residual_bins(
    white: FloatArray, segments: NDArray[np.int64], step_s: float, edges_hz: FloatArray
) -> dict[tuple[int, int, int], ResidualBin]:
    """Return mean squares of whitened residuals (m, kinds) by kind, segment and band.

    `segments` (m,) has the number of the segment of each row. The cosine transform of a segment is
    orthogonal: for white residuals of unit variance every coefficient is a standard normal, and
    coefficient k of n belongs to the frequency k/(2 n step). Band b lies between `edges_hz` b and b
    + 1.
    """
    found: dict[tuple[int, int, int], ResidualBin] = {}
    for segment in np.unique(segments).tolist():
        rows = white[segments == segment]
        power = cosine_transform(rows) ** 2
        frequency = np.arange(rows.shape[0]) / (2.0 * rows.shape[0] * step_s)
        band = np.searchsorted(edges_hz, frequency, side="right") - 1
        for b in range(edges_hz.size - 1):
            chosen = power[band == b]
            for kind in range(white.shape[1]):
                count = chosen.shape[0]
                mean = float(chosen[:, kind].mean()) if count else 0.0
                found[kind, segment, b] = ResidualBin(mean, count)
    return found


def cosine_transform(rows: FloatArray) -> FloatArray:
    """Return the orthogonal cosine transform (DCT-II) of columns (n, c).

    It is the Fourier transform of the columns and their mirror image. (scipy.fft has it, and takes
    longer to import than this takes.)
    """
    n = rows.shape[0]
    mirrored = np.fft.rfft(np.concatenate([rows, rows[::-1]]), axis=0)[:n]
    turn = np.exp(-0.5j * np.pi * np.arange(n) / n) * np.sqrt(0.5 / n)
    turn[:1] *= np.sqrt(0.5)
    return np.asarray((turn[:, None] * mirrored).real)


def merge_bins(parts: list[ResidualBin]) -> ResidualBin:
    """Return several bins as one."""
    count = sum(part.size for part in parts)
    total = sum(part.mean_square * part.size for part in parts)
    return ResidualBin(total / count if count else 0.0, count)
