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
from pre_core.crossing.rows import RESIDUALS, RowFilter
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


def mismatch_power(
    rows: RowFilter,
    trucks: list[NoisePath],
    channels: GainsAndDelays,
    density: FloatArray,
    force: FloatArray,
    stretch: ComparedStretch,
) -> FloatArray:
    """Return E[r' C_0^-1 (r_k - r)] per residual sample by the mismatch alone: (trucks - 1,).

    With r the residuals of the first truck and r_k those of another, each with its `channels`, E =
    M_k M_0^-1 - 1 describes how the latter mixes the input profiles, which differ by d; the front
    axle's residuals are taken when its wheel was at the rear's present place. `density` (4,) is
    that of the sensors, `force` (2, shapes) the suspension noise in N²/Hz. Of the deck only the
    torsional flexibility may differ.
    """
    at = folded(rows, _FREQUENCIES)
    road = stretch.mismatch

    def crossed(omega: FloatArray, power: FloatArray) -> NDArray[np.complex128]:
        """(w, 3, f): E[(r_k - r)_l conj(r_0)], of which r_0, the mismatch, is d itself."""
        s = 1j * omega
        deck = stretch.torsion
        receptance = mean_receptance(deck, trucks[0].theta, omega)

        def estimation(k: int) -> NDArray[np.complex128]:
            channel = (1.0 + channels.gain[k])[:, None] * np.exp(np.outer(channels.delay_s[k], s))
            equations = estimation_matrix(trucks[k], omega)
            if receptance.any():
                flexibility = trucks[k].theta[TORSION] * deck.load_factor
                equations[:2] -= omega**2 * (flexibility * receptance) * _axle_masses(trucks[k])
            return np.moveaxis(equations * channel, 2, 0)

        inverse = np.linalg.inv(estimation(0))
        of_front, of_rear = (omega**4 * power * one for one in _mismatch.cross_spectra(road, omega))
        turn = np.exp(s * stretch.wheelbase_m / road.speed_m_per_s)
        out = np.empty((len(trucks) - 1, RESIDUALS, omega.size), dtype=np.complex128)
        for number in range(len(out)):
            e = np.moveaxis(estimation(1 + number) @ inverse, 0, 2) - np.eye(4)[:, :, None]
            out[number, 0] = of_front * (e[0, 0] - turn * e[1, 0])
            out[number, 0] += of_rear * (turn.conj() * e[0, 1] - e[1, 1])
            out[number, 1] = of_front * e[2, 0] + of_rear * turn.conj() * e[2, 1]
            out[number, 2] = of_front * turn * e[3, 0] + of_rear * e[3, 1]
        return out

    weight = np.linalg.inv(folded_spectrum(at, trucks[0], density, force, road))[:, 0]
    both = crossed(at.below, at.power_below) + crossed(at.above, at.power_above).conj()
    return np.einsum("fl,wlf->w", weight, both).real / _FREQUENCIES


def _axle_masses(truck: NoisePath) -> FloatArray:
    """Return the masses (2, 4, 1) in kg that multiply the readings in the axles' tyre forces.

    The receptance of a twisting deck times these forces is part of the input profiles, which are
    the road's less each axle's own deflection.
    """
    unsprung = np.diag(truck.theta[M_U1 : M_U1 + 2])
    return np.asarray(np.hstack([force_masses(truck), unsprung])[:, :, None])
