"""Gradient of the likelihood that the profile mismatch causes at the truth.

The wheels respond to their own profiles. So the mismatch d is in the residuals and, by the response
of truck and bridge, in the accelerations from which these are computed: errors in variables. They
would bias the estimate towards trucks that respond less to d.

A bridge responds, too: an axle deflects it by the force that its own profile causes. In bending
that correlation is negligible (below 0.06 in the gradient of every coordinate for 30 m and 16 t),
because the beam's mass isolates it from the axles' frequencies. In torsion it is not (1.2).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import mismatch as _mismatch
from pre_core.crossing.channels import GainsAndDelays
from pre_core.crossing.mismatch import Mismatch
from pre_core.crossing.noise import (
    NoisePath,
    estimation_matrix,
    folded,
    folded_spectrum,
    force_masses,
)
from pre_core.crossing.rows import RowFilter
from pre_core.parameters import M_U1, TORSION
from pre_core.physics.torsion import NO_TORSION, TorsionBasis, mean_receptance

_FREQUENCIES = 512
"""Number of frequencies that resolves the phase between the axles."""


class ComparedStretch(NamedTuple):
    """A stretch of road on which the axles' profiles are compared."""

    mismatch: Mismatch
    wheelbase_m: float
    torsion: TorsionBasis = NO_TORSION
    """The deck that carries the stretch, if it twists."""


class MismatchWeights(NamedTuple):
    """Weights of a truck's equations in the correlation of its residuals with the mismatch."""

    omega: FloatArray  # (f,)
    weight: NDArray[np.complex128]
    """Weights (4, 4, f) of the equations (`noise.estimation_matrix`) of any truck."""
    torsion: TorsionBasis
    receptance: NDArray[np.complex128]
    """Mean receptance (f,) of the twisting deck at unit flexibility, damped as in the first truck's
    theta."""


def mismatch_weights(
    rows: RowFilter,
    truck: NoisePath,
    channels: GainsAndDelays,
    density: FloatArray,
    force: FloatArray,
    stretch: ComparedStretch,
) -> MismatchWeights:
    """Return the weights for the residuals of a truck with the `channels` of one point (1, 4).

    Another truck with the equations M_k mixes the input profiles, which differ by d, by M_k M_0^-1;
    the front axle's residuals are taken when its wheel was at the rear's present place. `density`
    (4,) is that of the sensors, `force` (2, shapes) the suspension noise in N²/Hz. Of the deck only
    the torsional flexibility may differ.
    """
    at = folded(rows, _FREQUENCIES)
    road, deck = stretch.mismatch, stretch.torsion
    near = np.linalg.inv(folded_spectrum(at, truck, density, force, road))[:, 0].T
    white = np.concatenate([near, near.conj()], axis=1) / _FREQUENCIES
    omega = np.concatenate([at.below, at.above])
    power = np.concatenate([at.power_below, at.power_above])
    of_front, of_rear = (omega**4 * power * one for one in _mismatch.cross_spectra(road, omega))
    turn = np.exp(1j * omega * stretch.wheelbase_m / road.speed_m_per_s)
    # Of the mixed profiles, by residual: d itself, then both body equations.
    mixed = np.zeros((4, 4, omega.size), dtype=np.complex128)
    mixed[0, 0], mixed[0, 1] = white[0] * of_front, white[0] * of_rear * turn.conj()
    mixed[1, 0], mixed[1, 1] = -white[0] * of_front * turn, -white[0] * of_rear
    mixed[2, 0], mixed[2, 1] = white[1] * of_front, white[1] * of_rear * turn.conj()
    mixed[3, 0], mixed[3, 1] = white[2] * of_front * turn, white[2] * of_rear
    unmixed = MismatchWeights(omega, mixed, deck, mean_receptance(deck, truck.theta, omega))
    equations = _equations(unmixed, truck)
    equations *= channel_factors(omega, channels.gain[0], channels.delay_s[0])
    inverse = np.linalg.inv(np.moveaxis(equations, 2, 0))
    weight = np.moveaxis(np.moveaxis(mixed, 2, 0) @ np.swapaxes(inverse, 1, 2), 0, 2)
    return unmixed._replace(weight=np.ascontiguousarray(weight))


def correlation(
    weights: MismatchWeights, truck: NoisePath, gain: FloatArray, delay_s: FloatArray
) -> float:
    """Return E[r' C_0^-1 r_k] per residual sample, for mismatch alone.

    Here r are the residuals of the first truck and r_k those of `truck`; `gain` (4,) and `delay_s`
    (4,) are those of its channels.
    """
    equations = _equations(weights, truck) * channel_factors(weights.omega, gain, delay_s)
    return float(np.vdot(weights.weight.conj(), equations).real)


def channel_factors(
    omega: FloatArray, gain: FloatArray, delay_s: FloatArray
) -> NDArray[np.complex128]:
    """Return the factors (4, f) of channels with relative gain errors (4,) and delays (4,)."""
    return np.asarray((1.0 + gain)[:, None] * np.exp(1j * np.outer(delay_s, omega)))


def _equations(weights: MismatchWeights, truck: NoisePath) -> NDArray[np.complex128]:
    """Return the equations (4, 4, f) of a truck, of profiles less each axle's own deflection."""
    equations = estimation_matrix(truck, weights.omega)
    if weights.receptance.any():
        flexibility = truck.theta[TORSION] * weights.torsion.load_factor
        equations[:2] -= weights.omega**2 * (flexibility * weights.receptance) * _axle_masses(truck)
    return equations


def mismatch_power(
    rows: RowFilter,
    trucks: list[NoisePath],
    channels: GainsAndDelays,
    density: FloatArray,
    force: FloatArray,
    stretch: ComparedStretch,
) -> FloatArray:
    """Return E[r' C_0^-1 (r_k - r)] per residual sample, for mismatch alone: (trucks - 1,).

    Here r are the residuals of the first truck and r_k those of another, each with its `channels`;
    the other arguments are as in `mismatch_weights`.
    """
    weights = mismatch_weights(rows, trucks[0], channels, density, force, stretch)
    found = [
        correlation(weights, truck, gain, delay_s)
        for truck, gain, delay_s in zip(trucks, channels.gain, channels.delay_s, strict=True)
    ]
    return np.asarray(found[1:]) - found[0]


def _axle_masses(truck: NoisePath) -> FloatArray:
    """Return the masses (2, 4, 1) in kg that multiply the readings in the axles' tyre forces.

    The receptance of a twisting deck times these forces is part of the input profiles, which are
    the road's less each axle's own deflection.
    """
    unsprung = np.diag(truck.theta[M_U1 : M_U1 + 2])
    return np.asarray(np.hstack([force_masses(truck), unsprung])[:, :, None])
