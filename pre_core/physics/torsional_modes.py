"""Torsion of the deck for the coupled simulation: many sines of every span, and the remainder.

The equations are those of `torsion`; the identification uses eight sines of each span and a coarser
mesh.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.physics.bridge import Beam
from pre_core.physics.torsion import sine_cubics, span_ends_m

_MODES = 40
"""Number of modes of each span; higher ones respond quasi-statically."""


class TorsionalModes(NamedTuple):
    """Torsional modes (k,) of a deck; empty if it does not twist."""

    eigenvalues_per_s2: FloatArray  # (k,)
    damping_per_s: FloatArray  # (k,)
    cubics: FloatArray  # (elements, 4, k), as `bridge.element_cubics` of mass-normalised modes


def torsional_modes(beam: Beam) -> TorsionalModes:
    """Return the sines of every span, mass-normalised in the coordinate e theta.

    Raise ValueError for a deck that twists without a torsional wave speed.
    """
    lengths = beam.element_lengths_m
    flexibility, speed = beam.torsional_flexibility_per_n, beam.torsional_wave_speed_m_per_s
    if flexibility == 0.0:
        return TorsionalModes(np.zeros(0), np.zeros(0), np.zeros((lengths.size, 4, 0)))
    if not speed > 0.0:
        raise ValueError("a deck that twists needs a torsional wave speed")
    edges = np.concatenate([[0.0], np.cumsum(lengths)])
    spans = span_ends_m(lengths, beam.interior_supports)
    omega = np.arange(1, _MODES + 1) * np.pi * speed / np.diff(spans, axis=1)
    cubics = np.zeros((lengths.size, 4, omega.size))
    for number, span in enumerate(spans):
        own = slice(number * _MODES, (number + 1) * _MODES)
        scale = np.sqrt(2.0 * flexibility * speed**2 / (span[1] - span[0]))
        for e in np.flatnonzero((edges[:-1] >= span[0]) & (edges[1:] <= span[1])):
            cubics[e, :, own] = scale * sine_cubics(edges[e : e + 2], span, _MODES)
    eigenvalues = np.ravel(omega) ** 2
    damping = beam.rayleigh_alpha_per_s + beam.rayleigh_beta_s * eigenvalues
    return TorsionalModes(eigenvalues, damping, cubics)


def quasi_static_twist(beam: Beam, wheels_m: FloatArray) -> FloatArray:
    """Return the flexibility (steps, 2, 2) in m/N of all higher modes at wheels (steps, 2).

    Entry i, j is the deflection at wheel i by a unit load on wheel j. A deck that does not twist
    has no rows: (0, 2, 2).
    """
    if beam.torsional_flexibility_per_n == 0.0:
        return np.zeros((0, 2, 2))
    out = np.zeros((wheels_m.shape[0], 2, 2))
    j = np.arange(1, _MODES + 1)
    for begin, end in span_ends_m(beam.element_lengths_m, beam.interior_supports):
        length = end - begin
        place = np.clip(wheels_m - begin, 0.0, length)  # no twist at a support
        sines = np.sin(place[:, :, None] * (j * np.pi / length)) / (j * np.pi)
        low, high = place.min(axis=1), place.max(axis=1)
        for w in range(2):
            own = place[:, w] * (length - place[:, w]) / length
            out[:, w, w] += own - 2.0 * length * np.sum(sines[:, w] ** 2, axis=1)
        across = low * (length - high) / length
        across -= 2.0 * length * np.sum(sines[:, 0] * sines[:, 1], axis=1)
        out[:, 0, 1] += across
        out[:, 1, 0] += across
    return beam.torsional_flexibility_per_n * out
