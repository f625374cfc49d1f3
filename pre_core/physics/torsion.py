"""Uniform St. Venant torsion of the deck under wheels off its axis.

A deck of torsional rigidity GJ whose twist is fixed at every support rotates by theta under the
moment e P of a wheel pair whose centre is at the lateral distance e from the axis, and the centre
of that axle sinks by e theta. Only g = e²/(GJ) affects the motion of an axle's centre:

    y(x) = g G(x, x') P,   G(x, x') = (min(x, x') - a) (b - max(x, x')) / (b - a)

under a static load P at x' in the same span from a to b. In motion theta is a sum of sines in each
span. The j-th vibrates at j c/(2 (b - a)), where c is the torsional wave speed, the root of GJ over
the rotational inertia of a metre of deck. The lowest `MODES` of each span are marched as modes
(modal_response.py); the others respond quasi-statically (`flexibility_remainder`).

Torsion and bending are independent, as in a deck that is symmetric about its axis, and the axis is
the line between the ends given in the site file.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import ComplexArray, FloatArray
from pre_core.kernels.lanes import LANES, inner
from pre_core.parameters import ALPHA, BETA, TORSION
from pre_core.physics.beam_basis import modal_damping
from pre_core.physics.modal_response import COEFFICIENTS, mode_coefficients

GROUPS = 2
"""Number of groups of `LANES` modes for each span, one mode in each vector lane."""
MODES = GROUPS * LANES
"""Number of dynamic modes of each span."""


class TorsionBasis(NamedTuple):
    """The data that all evaluations of a twisting deck share; empty for one that does not twist.

    `cubics` (parts, 4, modes) has unit sines of the part's span, in powers of the local coordinate
    0..1 of the part.
    """

    cubics: FloatArray
    span_of_part: NDArray[np.int64]  # (parts,)
    ends_m: FloatArray  # (spans, 2) chainages
    wave_speed_m_per_s: float
    load_factor: float
    """Factor of g for a crossing at another distance from the axis: the squared ratio of the two
    distances."""


NO_TORSION: Final = TorsionBasis(
    np.zeros((0, 4, MODES)), np.zeros(0, dtype=np.int64), np.zeros((0, 2)), 0.0, 1.0
)
"""Basis of a deck that does not twist."""


def torsion_basis(
    part_lengths_m: FloatArray,
    supports: tuple[int, ...],
    wave_speed_m_per_s: float,
    load_factor: float = 1.0,
) -> TorsionBasis:
    """Return the basis of a deck of parts (parts,) whose twist is fixed at ends and `supports`.

    `supports` are nodes between parts.
    """
    spans = span_ends_m(part_lengths_m, supports)
    span_of_part = np.searchsorted(np.array(supports), np.arange(part_lengths_m.size), side="right")
    edges = np.concatenate([[0.0], np.cumsum(part_lengths_m)])
    cubics = np.zeros((part_lengths_m.size, 4, MODES))
    for part, span in enumerate(span_of_part):
        shapes = sine_cubics(edges[part : part + 2], spans[span], MODES)
        cubics[part] = shapes
    return TorsionBasis(
        cubics, span_of_part.astype(np.int64), spans, wave_speed_m_per_s, load_factor
    )


def span_ends_m(part_lengths_m: FloatArray, supports: tuple[int, ...]) -> FloatArray:
    """Return the chainages (spans, 2) of the spans' ends, for the lengths (parts,) of the elements.

    `supports` are the numbers of elements before the interior supports.
    """
    edges = np.concatenate([[0.0], np.cumsum(part_lengths_m)])
    held = edges[[0, *supports, part_lengths_m.size]]
    return np.stack([held[:-1], held[1:]], axis=1)


def sine_cubics(part_m: FloatArray, span_m: FloatArray, modes: int) -> FloatArray:
    """Return cubics (4, modes) of a part (2,) through a span's (2,) unit sines.

    They are in the local coordinate 0..1 of the part. Values and slopes are those of the sines at
    both ends of the part (Hermite).
    """
    length = part_m[1] - part_m[0]
    wave = np.arange(1, modes + 1) * np.pi / (span_m[1] - span_m[0])
    phase = wave[None, :] * (part_m[:, None] - span_m[0])
    value, slope = np.sin(phase), np.cos(phase) * wave * length
    rise = value[1] - value[0]
    return np.stack(
        [value[0], slope[0], 3.0 * rise - 2.0 * slope[0] - slope[1], slope.sum(axis=0) - 2.0 * rise]
    )


def mean_receptance(basis: TorsionBasis, theta: FloatArray, omega: FloatArray) -> ComplexArray:
    """Return the receptance (f,) of a deck of g = 1/N at an axle, averaged over the bridge, in m.

    It is the deflection by a harmonic force at the same place, at angular frequencies (f,), of the
    dynamic modes, damped as by `theta` (p,), and of the quasi-static ones; zero for `NO_TORSION`.
    """
    squared = (1j * omega) ** 2
    lengths = np.diff(basis.ends_m, axis=1)[:, 0]
    total = np.zeros(omega.size, dtype=np.complex128)
    for length in lengths:
        wave = np.arange(1, MODES + 1)[:, None] * np.pi / length
        eigenvalue = (wave * basis.wave_speed_m_per_s) ** 2
        damping = 1j * omega * (theta[ALPHA] + theta[BETA] * eigenvalue)
        dynamic = basis.wave_speed_m_per_s**2 / (eigenvalue + damping + squared) - wave**-2.0
        total += length / lengths.sum() * (length / 6.0 + dynamic.sum(axis=0) / length)
    return total


@inner
def torsion_filters(
    basis: TorsionBasis,
    theta: FloatArray,
    step_s: float,
    cubics: FloatArray,
    feedback: FloatArray,
) -> bool:
    """Write the torsional modes of `theta` (p,) into the last groups, `GROUPS` for each span.

    The form is that of `modal_response.modal_filters`: `cubics` (parts, groups, 4, 4) and
    `feedback` (groups, 5, 4). Return False if a value is not finite.
    """
    first = feedback.shape[0] - GROUPS * basis.ends_m.shape[0]
    flexibility = max(theta[TORSION], 0.0) * basis.load_factor
    one = np.empty(COEFFICIENTS)
    for span in range(basis.ends_m.shape[0]):
        length = basis.ends_m[span, 1] - basis.ends_m[span, 0]
        # In the coordinate e theta a metre of deck has the mass 1/(g c²); a sine moves half of it.
        per_mass = 2.0 * flexibility * basis.wave_speed_m_per_s**2 / length
        for j in range(MODES):
            omega = (j + 1) * np.pi * basis.wave_speed_m_per_s / length
            eigenvalue = omega * omega
            total = mode_coefficients(eigenvalue, modal_damping(theta, eigenvalue), step_s, one)
            if not total > 0.0:
                return False
            group, lane = first + span * GROUPS + j // LANES, j % LANES
            for i in range(COEFFICIENTS):
                feedback[group, i, lane] = one[i]
            scale = np.sqrt(total * per_mass)
            for part in range(cubics.shape[0]):
                for power in range(4):
                    inside = basis.span_of_part[part] == span
                    value = scale * basis.cubics[part, power, j] if inside else 0.0
                    cubics[part, group, power, lane] = value
    return True


@inner
def flexibility_remainder(
    basis: TorsionBasis, part: int, place: float, at_m: float, other: int, there: float, to_m: float
) -> float:
    """Return G(x, x') in m between two places, without the share of the dynamic modes.

    Each place is given by its part (-1: off the bridge), the local coordinate 0..1 in this part and
    the chainage: `part`, `place`, `at_m` and `other`, `there`, `to_m`.
    """
    if part < 0 or other < 0 or basis.span_of_part[part] != basis.span_of_part[other]:
        return 0.0
    span = basis.span_of_part[part]
    begin, end = basis.ends_m[span, 0], basis.ends_m[span, 1]
    length = end - begin
    total = (min(at_m, to_m) - begin) * (end - max(at_m, to_m)) / length
    here, far = basis.cubics[part], basis.cubics[other]
    for j in range(MODES):
        a = ((here[3, j] * place + here[2, j]) * place + here[1, j]) * place + here[0, j]
        b = ((far[3, j] * there + far[2, j]) * there + far[1, j]) * there + far[0, j]
        total -= 2.0 * length * a * b / ((j + 1) * np.pi) ** 2
    return total
