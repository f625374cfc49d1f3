"""Detection of a change of a channel's delay or gain within the record, from a fit's residuals.

A sensor that loses samples publishes the later ones too early: its delay changes by a step. The
search estimates one delay and one gain for the whole record, so a step biases truck and bridge
instead. Residuals are linear in the signals, and a unit step of channel c at time t_0 adds

    g = dr/d(delay of c), of the signals from t_0 on alone,

with velocity and displacement integrated from the changed acceleration, as in `channels`. The score
test projects the whitened residuals on the part of g that the fit's coordinates do not explain:

    z = (g'r - g'J S J'r) / sqrt(g'g - g'J S J'g),    S = (J'J)^-1,

a standard normal without a change, for every channel and every t_0.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.channels import A_1, A_2, A_3, A, V, Z
from pre_core.crossing.layout import CHANNELS
from pre_core.crossing.posterior import PosteriorProblem, points
from pre_core.crossing.residuals import evaluate_white
from pre_core.search.levenberg_marquardt import LMState

DELAY, GAIN = range(2)
_MOMENTS = ((24, 0.0), (10, 0.15))
"""For delay and gain of every channel: number of evenly spaced times at which it may change, and
share of the record at either end that has no such times."""
_STEP = 1e-4
"""Step of the difference in s, and relative for the gain: the residuals are linear in it."""
_LEAST_SHARE = 1e-3
"""Smallest norm of a step's effect relative to the largest; near an end it affects few residuals.
"""


class Step(NamedTuple):
    """The most significant step of one channel's delay or gain."""

    kind: int
    """Kind of the step: `DELAY` or `GAIN`."""
    channel: int
    time_s: float
    """Time since the first sample of the model's signals."""
    size: float
    """Time in s by which the later samples come early, or the relative change of the gain."""
    z: float
    """Size over its standard deviation, for residuals of unit variance."""


def largest_step(problem: PosteriorProblem, state: LMState, covariance: FloatArray) -> Step:
    """Return the most significant step at the optimum `state` with `covariance` (f, f) of y."""
    crossing = problem.crossing
    m = problem.noise.reciprocal.size
    white, jacobian = state.residual[:m], state.jacobian[:m]
    # With mismatch the residuals also respond to noise in the signals. Its mean effect on the fit's
    # gradient is `noise_slope`; g has the same effect, as far as the fit's columns explain g.
    gradient = state.jacobian.T @ state.residual
    gradient[: problem.noise_slope.size] += problem.noise_slope
    slope = covariance @ gradient
    at = points(problem, state.y[None, :])
    n = crossing.signals.shape[2]
    worst = Step(DELAY, 0, 0.0, 0.0, 0.0)
    changed, rows = np.empty_like(crossing.signals), np.empty((1, m))
    for kind, (count, aside) in enumerate(_MOMENTS):
        moments = (n * np.linspace(aside, 1.0 - aside, count + 2)[1:-1]).astype(np.int64)
        for channel in range(CHANNELS):
            columns = np.empty((count, m))
            for k, moment in enumerate(moments.tolist()):
                changed[:] = crossing.signals
                changed[channel] += _STEP * unit_step(
                    crossing.signals[channel], kind, moment, crossing.step_s
                )
                evaluate_white(
                    crossing._replace(signals=changed),
                    problem.rows,
                    problem.noise,
                    problem.works,
                    at,
                    rows,
                )
                columns[k] = (rows[0] - white) / _STEP
            explained = columns @ jacobian
            norm = np.sum(columns**2, axis=1)
            left = norm - np.sum((explained @ covariance) * explained, axis=1)
            score = columns @ white - explained @ slope
            is_seen = left > _LEAST_SHARE * norm.max()
            z = np.where(is_seen, score / np.sqrt(np.where(is_seen, left, 1.0)), 0.0)
            k = int(np.argmax(np.abs(z)))
            if abs(z[k]) > abs(worst.z):
                size = float(score[k] / left[k])
                time_s = float(moments[k]) * crossing.step_s
                worst = Step(kind, channel, time_s, size, float(z[k]))
    return worst


def unit_step(signals: FloatArray, kind: int, moment: int, step_s: float) -> FloatArray:
    """Return the effect of a unit step at sample `moment` on the signals (6, n) of one channel."""
    out = np.zeros_like(signals)
    own, new = signals[:, moment:], out[:, moment:]
    since_s = step_s * np.arange(own.shape[1])
    if kind == DELAY:
        new[V] = own[A] - own[A, 0]
        new[Z] = own[V] - own[V, 0] - own[A, 0] * since_s
        new[A], new[A_1], new[A_2] = own[A_1], own[A_2], own[A_3]
    else:
        new[V] = own[V] - own[V, 0]
        new[Z] = own[Z] - own[Z, 0] - own[V, 0] * since_s
        new[A:] = own[A:]
    return out
