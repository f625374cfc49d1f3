"""Observation of ln EI by one crossing, with its own and its shared errors.

It follows from the crossing's likelihood, normal in the compliances x and in all other variables v
(the other bridge parameters, the truck's with its mass and gain, the long waves of its wheel-path
group). With the parts L of its precision and P the prior precision of v, M = L_vv + P,

    C = (L_xx - L_xv M^-1 L_vx)^-1,    x^ = C (l_x - L_xv M^-1 l_v) = x + C L_xv M^-1 P v + own.

The effect of v on x^ is the same in all crossings that share v: it is kept as a loading on unit
normals z, v = P^-1/2 z. The rest of C is the crossing's own. In logarithms d ln EI = -dx/x.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.fusion.information import BridgePriors
from pre_core.fusion.joint import add_mass_parameter
from pre_core.fusion.likelihood import linearised_likelihood
from pre_core.fusion.path_groups import FusionInput, path_group_key, path_groups

_WEAK = 0.05
"""Precision of a compliance relative to nominal where the crossing does not determine an element.
"""


class SharedError(NamedTuple):
    """Errors that crossings with a common cause share."""

    name: str
    """Cause of the errors: the bridge, a truck, a wheel-path group."""
    loading: FloatArray
    """Effect (n, r) of its unit normals on ln EI."""


class Observation(NamedTuple):
    """Values of ln EI of n elements, EI in N·m², from one crossing or several."""

    value: FloatArray  # (n,)
    own: FloatArray  # (n, n) covariance
    shared: tuple[SharedError, ...]


def observation(
    part: FusionInput, priors: BridgePriors, ei_nm2: FloatArray, common_share: float
) -> Observation:
    """Return a crossing's observation, linearised about rigidities `ei_nm2` (n,).

    `common_share` is the share of the power of the mismatch's long waves that is common to the
    crossings of its wheel-path group.
    """
    of, n = part.likelihood, priors.elements
    b, t = len(of.bridge.names), len(of.truck.names)
    location = priors.coordinates.location[b - n :]
    centre = np.zeros(b)
    centre[b - n :] = location / ei_nm2
    track = path_groups([part]).get(path_group_key(part))
    waves = np.zeros((0, 0)) if track is None else track.whole
    if of.bends is not None:
        of = linearised_likelihood(of, of.bends.about, waves)
    precision, linear = add_mass_parameter(of, part.mass_spread, priors, centre)
    x = np.arange(b - n, b)
    v = np.setdiff1d(np.arange(linear.size), x)
    before = np.eye(v.size)
    q = waves.shape[0]
    half = np.eye(v.size)
    if q:
        before[-q:, -q:] = waves
        half[-q:, -q:] = np.linalg.cholesky(waves)
    across = precision[np.ix_(x, v)]
    solved = np.linalg.solve(
        precision[np.ix_(v, v)] + before, np.column_stack([across.T, linear[v], half])
    )
    within = precision[np.ix_(x, x)] - across @ solved[:, :n] + _WEAK * np.eye(n)
    covariance = np.linalg.inv(within)
    found = covariance @ (linear[x] - across @ solved[:, n] + _WEAK * centre[x])
    # `half` is a root of P = half half'; any root gives the same covariance.
    loading = covariance @ across @ solved[:, n + 1 :]
    own = covariance - loading @ loading.T
    if q:
        apart = np.sqrt(1.0 - common_share) * loading[:, -q:]
        own += apart @ apart.T
        loading[:, -q:] *= np.sqrt(common_share)
    by = -1.0 / centre[x]
    own = by[:, None] * own * by
    loading = by[:, None] * loading
    return Observation(
        np.log(ei_nm2) + by * (found - centre[x]),
        0.5 * (own + own.T),
        _shared(part, loading, b - n, t + 1, q if common_share > 0.0 else 0),
    )


def combine_observations(observations: list[Observation], elements: int) -> Observation:
    """Return several observations of one bridge as one, weighted by their own errors.

    Raise ValueError for an empty list.
    """
    if not observations:
        raise ValueError("no observations to fuse")
    if len(observations) == 1:
        return observations[0]
    weights = [np.linalg.inv(one.own) for one in observations]
    covariance = np.linalg.inv(np.sum(weights, axis=0))
    value = np.zeros(elements)
    shared: dict[str, FloatArray] = {}
    for one, weight in zip(observations, weights, strict=True):
        share = covariance @ weight
        value += share @ one.value
        for name, loading in one.shared:
            moved = share @ loading
            shared[name] = shared[name] + moved if name in shared else moved
    return Observation(
        value,
        0.5 * (covariance + covariance.T),
        tuple(SharedError(*item) for item in shared.items()),
    )


def _shared(
    part: FusionInput, loading: FloatArray, others: int, truck: int, waves: int
) -> tuple[SharedError, ...]:
    """Return the columns of the other bridge parameters, of the truck, and of the group's waves."""
    pieces = [
        SharedError(f"bridge {others}", loading[:, :others]),
        SharedError(f"truck {part.truck} {truck}", loading[:, others : others + truck]),
    ]
    if waves:
        key = path_group_key(part)
        name = f"track {key.truck} {key.direction} {key.first_knot} {key.knots}"
        pieces.append(SharedError(name, loading[:, -waves:]))
    return tuple(piece for piece in pieces if piece.loading.shape[1])
