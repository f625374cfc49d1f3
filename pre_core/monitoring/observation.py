"""What one crossing says of ln EI as numbers with two kinds of error: its own, and those it shares.

From the crossing's likelihood, normal in the compliances x and in everything else v (the bridge's
other unknowns, the truck's with its mass and gain, the long waves of its track): with the parts L
of its precision and P the precision of v before any crossing, M = L_vv + P,

    C = (L_xx - L_xv M^-1 L_vx)^-1,    x^ = C (l_x - L_xv M^-1 l_v) = x + C L_xv M^-1 P v + own.

What v does to x^ is the same in all crossings that have that v: it is kept as a loading on unit
normals z, v = P^-1/2 z. The rest of C is the crossing's own. In logarithms
d ln EI = -dx/x.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.fusion.joint import mass_freed
from pre_core.fusion.likelihood import straightened
from pre_core.fusion.sums import BridgePriors
from pre_core.fusion.tracks import Part, key_of, tracks_of

FloatArray = NDArray[np.float64]

_WEAK = 0.05
"""Precision of a compliance relative to nominal where the crossing tells nothing of an element."""


class Shared(NamedTuple):
    """Errors that all crossings have in common that have something in common."""

    name: str
    """What they have in common: the bridge, a truck, a track."""
    loading: FloatArray
    """(n, r): what unit normals of it do to ln EI."""


class Observation(NamedTuple):
    """ln EI of n elements, EI in N·m², as one crossing or several tell it."""

    value: FloatArray  # (n,)
    own: FloatArray  # (n, n) covariance
    shared: tuple[Shared, ...]


def observation(
    part: Part, priors: BridgePriors, ei_nm2: FloatArray, common_share: float
) -> Observation:
    """What a crossing says, about the rigidities (n,) that it found.

    `common_share` of the power of its mismatch's long waves is taken to be the same in all runs in
    its track, the rest to be its own.
    """
    of, n = part.likelihood, priors.elements
    b, t = len(of.bridge.names), len(of.truck.names)
    location = priors.coordinates.location[b - n :]
    centre = np.zeros(b)
    centre[b - n :] = location / ei_nm2
    track = tracks_of([part]).get(key_of(part))
    waves = np.zeros((0, 0)) if track is None else track.whole
    if of.bends is not None:
        of = straightened(of, centre, waves)
    precision, linear = mass_freed(of, part.mass_spread, priors, centre)
    x = np.arange(b - n, b)
    v = np.setdiff1d(np.arange(linear.size), x)
    before = np.eye(v.size)
    q = waves.shape[0]
    half = np.eye(v.size)
    if q:
        before[-q:, -q:] = waves
        half[-q:, -q:] = np.linalg.cholesky(waves)
    across = precision[np.ix_(x, v)]
    told = np.linalg.solve(
        precision[np.ix_(v, v)] + before, np.column_stack([across.T, linear[v], half])
    )
    within = precision[np.ix_(x, x)] - across @ told[:, :n] + _WEAK * np.eye(n)
    covariance = np.linalg.inv(within)
    found = covariance @ (linear[x] - across @ told[:, n] + _WEAK * centre[x])
    # P = half half', so that P^1/2 stands for half: any root does.
    loading = covariance @ across @ told[:, n + 1 :]
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


def fused(some: list[Observation], elements: int) -> Observation:
    """Several observations of one bridge as one: weighted by what is their own.

    ValueError without any.
    """
    if not some:
        raise ValueError("no observations to fuse")
    if len(some) == 1:
        return some[0]
    weights = [np.linalg.inv(one.own) for one in some]
    covariance = np.linalg.inv(np.sum(weights, axis=0))
    value = np.zeros(elements)
    shared: dict[str, FloatArray] = {}
    for one, weight in zip(some, weights, strict=True):
        share = covariance @ weight
        value += share @ one.value
        for name, loading in one.shared:
            moved = share @ loading
            shared[name] = shared[name] + moved if name in shared else moved
    return Observation(
        value, 0.5 * (covariance + covariance.T), tuple(Shared(*item) for item in shared.items())
    )


def _shared(
    part: Part, loading: FloatArray, others: int, truck: int, waves: int
) -> tuple[Shared, ...]:
    """The columns of the bridge's other unknowns, of the truck's, of the track's waves."""
    pieces = [
        Shared(f"bridge {others}", loading[:, :others]),
        Shared(f"truck {part.truck} {truck}", loading[:, others : others + truck]),
    ]
    if waves:
        key = key_of(part)
        name = f"track {key.truck} {key.direction} {key.first_knot} {key.knots}"
        pieces.append(Shared(name, loading[:, -waves:]))
    return tuple(piece for piece in pieces if piece.loading.shape[1])
