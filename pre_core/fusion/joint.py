"""One bridge from the likelihoods of several crossings: each prior counts once.

The unknowns are the bridge's; each truck's, with its total mass; and, of each track (a truck in one
direction), the long waves of the part of the mismatch that its runs share, which no number of them
averages out. A crossing has of its own the rest of those waves, and a change of every element's
compliance: between crossings EI changes with temperature and with what the model lacks, by a
relative standard deviation tau of which a share rho is common to all elements. All that is normal
is integrated out; tau and rho are looked at on a grid.

Longer than other modules: all of it goes by one layout of all unknowns.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pre_core.crossing.compliances import Compliances, draws, marginal, of_normal
from pre_core.crossing.mismatch import LONG_CYCLES_PER_M, Mismatch, common_shapes, shapes_of
from pre_core.fusion.likelihood import (
    KNOT_M,
    OFF_BRIDGE_STEP_M,
    Coordinates,
    Likelihood,
    OffBridge,
    covariance_of_coefficients,
    loosened,
    straightened,
)
from pre_core.physics.surface import Footprint
from pre_core.search.crank_nicolson import CHAINS

FloatArray = NDArray[np.float64]

_APART_STEPS = 2
"""Of the second difference by which the common share is read: waves of half a metre to two."""
_WANDERS_M, _HALVINGS = (0.01, 1.0), 12
BETWEEN_SCALE = 0.04
"""Of the half-normal prior of tau: temperature changes a concrete bridge's EI by some per cent."""
_TAUS = BETWEEN_SCALE * np.array(
    [0.0, 0.05, 0.1, 0.15, 0.2, 0.27, 0.36, 0.48, 0.64, 0.85, 1.1, 1.45, 1.9, 2.5, 3.2]
)
_RHOS = (0.0, 0.3, 0.7, 0.93, 0.99)
_USUAL = (0.03, 0.3)
"""tau and rho by which the bridge is found about which it changes."""
_SETTLED = 0.002
"""Of a compliance and of the other unknowns' coordinates: far within what is known of them."""
_FINER = 12
"""Parts of a cell of tau: crossings tell it more closely than one has time to look."""
_FIRST_TAU = 0.002
"""What is added to tau before its logarithm, in which the evidence is smooth."""
_ROUGH_COMPLIANCE = (0.2, 5.0)
"""Outside, a compliance that is hardly known is not taken for the size of its own changes."""
_ROUGH_SPREAD = 0.6
"""A normal prior of c that stands for the log-normal one where evidence is compared."""
_AS_LIKELY = np.exp(-0.5 * 1.96**2)
"""Of a normal's density, at the ends of its 95 % interval."""
_PASSES = 8
"""Of finding the bridge about which it changes, and crossings' likelihoods are normal."""
_NOTHING = 1e-9
"""Of the largest variance of a sum of waves: a smaller one is rounding."""


class Part(NamedTuple):
    """A crossing to fuse."""

    name: str
    likelihood: Likelihood
    truck: str
    direction: int
    footprints: tuple[Footprint, Footprint]
    mass_spread: float
    """Relative, of the truck's total mass: the same error in all its crossings."""


class BridgePriors(NamedTuple):
    """In the order of the likelihoods' coordinates of the bridge, which have `elements` last."""

    coordinates: Coordinates
    mass_powers: FloatArray  # (b,)
    log_odds: FloatArray  # (b,) of being exactly zero; `posterior.log_odds_of_absence`
    elements: int


class Shared(NamedTuple):
    """What runs of a truck in one track have in common of the road's mismatch."""

    truck: str
    direction: int
    common_share: float
    """Of the mismatch's power at waves of 20 m."""
    wander_m: float | None
    """How far the runs' tracks lie beside each other; None where one run tells nothing of it."""
    level_m3: FloatArray


class Fused(NamedTuple):
    """Draws of the bridge's unknowns in the coordinates of `crossing.posterior`."""

    draws: FloatArray  # (n, chains, b): the bridge's, elements last
    between: FloatArray
    """(n, chains) the standard deviation tau of ln EI between crossings."""
    between_may_be_zero: bool
    """Whether no tau is much likelier than none at all."""
    tracks: tuple[Shared, ...]


class Between(NamedTuple):
    """tau and rho with their posterior weights, (k,) each: the middles of cells."""

    tau: FloatArray
    rho: FloatArray
    weight: FloatArray
    fine: FloatArray
    """(cells, f) places within the cells of tau."""
    within: FloatArray
    """(k, f) weights there."""


class _Key(NamedTuple):
    """Of a track: runs along which other stretches of road were seen share no waves."""

    truck: str
    direction: int
    first_knot: int
    knots: int


class _Layout(NamedTuple):
    """Where among all unknowns stand those of the bridge, of each truck, of each track."""

    bridge: int
    elements: NDArray[np.int64]
    trucks: dict[str, NDArray[np.int64]]
    """The truck's coordinates, the error of its mass last."""
    tracks: dict[_Key, NDArray[np.int64]]
    size: int


class Ready(NamedTuple):
    """A crossing's likelihood with what is its own of the long waves integrated out."""

    precision: FloatArray
    linear: FloatArray
    places: NDArray[np.int64]
    """Where its coordinates are among all."""


class _Track(NamedTuple):
    """What the runs of a truck in one direction share, and the covariances of their long waves."""

    shared: Shared
    own_root: FloatArray
    whole: FloatArray
    """Precision (q, q) of all of them, own and shared."""
    common: FloatArray | None
    """(q, q) mm²; None where there is one run: what it would share with others is its own."""


class Joint(NamedTuple):
    """Crossings that are ready to be added."""

    names: tuple[str, ...]
    layout: _Layout
    ready: tuple[Ready, ...]
    prior: FloatArray
    """Precision (n, n) of trucks and tracks before any crossing."""
    centre: FloatArray
    """(b,) about which the bridge's unknowns are: changes of compliances are relative to it."""
    shared: tuple[Shared, ...]

    def of(self, names: Collection[str] | None) -> tuple[Ready, ...]:
        """The crossings of these names; None: all."""
        if names is None:
            return self.ready
        ready = zip(self.names, self.ready, strict=True)
        return tuple(one for name, one in ready if name in names)


def fuse(parts: Sequence[Part], priors: BridgePriors, count: int, seed: int) -> Fused:
    """Draws of a bridge, `count` of each chain, from crossings with the coordinates of `priors`.

    The order of the parts does not matter. ValueError without parts.
    """
    if not parts:
        raise ValueError("no crossings to fuse")
    return fuse_joined(join(parts, priors), priors, count, seed)


def fuse_joined(joint: Joint, priors: BridgePriors, count: int, seed: int) -> Fused:
    """As `fuse`, of crossings that are ready."""
    between = between_of(joint, priors)
    return Fused(*_drawn(joint, priors, between, count, seed), _may_be_zero(between), joint.shared)


def join(
    parts: Sequence[Part], priors: BridgePriors, trusted: Collection[str] | None = None
) -> Joint:
    """Crossings with what is their own integrated out, but for the change of the bridge.

    Changes are relative to what all give together, or the `trusted` of them by name.
    """
    parts = sorted(parts, key=lambda part: part.name)
    tracks = _tracks(parts)
    layout = _layout_of(parts, tracks, priors)
    prior = _prior(layout, tracks)
    shared = tuple(track.shared for track in tracks.values())
    names = tuple(part.name for part in parts)
    centre = _nominal(layout)
    bridge: FloatArray | None = None
    for _ in range(_PASSES):
        ready = tuple(
            _ready(_about(part, tracks, bridge), layout, tracks, priors, centre) for part in parts
        )
        joint = Joint(names, layout, ready, prior, centre, shared)
        # Without a change crossings surer than the bridge is steady lead each other astray.
        of = _of_change(joint._replace(ready=joint.of(trusted)))
        told = _with_priors(joint, priors, *_changed(joint, of, *_USUAL)[:2])
        before, centre = centre, np.asarray(np.linalg.solve(*told)[: layout.bridge])
        centre[layout.elements] = np.clip(centre[layout.elements], *_ROUGH_COMPLIANCE)
        # What must not be negative.
        least = np.where(priors.coordinates.is_log, -np.inf, 0.0)
        bridge = np.maximum(centre, least)
        if np.all(np.abs(centre - before) < _SETTLED):
            break
    return joint._replace(centre=centre)


def alone(part: Part, priors: BridgePriors) -> Joint:
    """One crossing by itself, about what it says of the bridge; its waves are its own."""
    tracks = _tracks([part])
    layout = _layout_of([part], tracks, priors)
    centre = _nominal(layout)
    ready = _ready(_about(part, tracks, None), layout, tracks, priors, centre)
    shared = tuple(track.shared for track in tracks.values())
    return Joint((part.name,), layout, (ready,), _prior(layout, tracks), centre, shared)


def _nominal(layout: _Layout) -> FloatArray:
    """(b,) of a bridge as the site file has it."""
    centre = np.zeros(layout.bridge)
    centre[layout.elements] = 1.0
    return centre


def _prior(layout: _Layout, tracks: dict[_Key, _Track]) -> FloatArray:
    """Precision (n, n) of trucks and tracks before any crossing."""
    prior = np.zeros((layout.size, layout.size))
    for places in layout.trucks.values():
        prior[places, places] = 1.0
    for key, places in layout.tracks.items():
        common = tracks[key].common
        assert common is not None  # noqa: S101 - it has a place among the unknowns
        prior[np.ix_(places, places)] = np.linalg.inv(common)
    return prior


def _about(part: Part, tracks: dict[_Key, _Track], bridge: FloatArray | None) -> Part:
    """The crossing with a likelihood that is normal about a `bridge` (b,); None: the crossing's."""
    told = part.likelihood
    if told.bends is None:
        return part
    at = told.bends.about if bridge is None else bridge
    return part._replace(likelihood=straightened(told, at, tracks[_key(part)].whole))


def _layout_of(parts: Sequence[Part], tracks: dict[_Key, _Track], priors: BridgePriors) -> _Layout:
    b = len(priors.coordinates.names)
    size, trucks, places = b, {}, {}
    for part in parts:
        if part.truck not in trucks:
            own = len(part.likelihood.truck.names) + 1
            trucks[part.truck] = size + np.arange(own)
            size += own
        key = _key(part)
        if key not in places and key in tracks and tracks[key].common is not None:
            q = part.likelihood.knots_m.size
            places[key] = size + np.arange(q)
            size += q
    return _Layout(b, np.arange(b - priors.elements, b), trucks, places, size)


def _tracks(parts: Sequence[Part]) -> dict[_Key, _Track]:
    """Of every truck in each direction in which its axles feel different roads."""
    runs: dict[_Key, list[Part]] = {}
    for part in parts:
        if part.likelihood.knots_m.size:
            runs.setdefault(_key(part), []).append(part)
    return {key: _track(key, some) for key, some in runs.items()}


def _track(key: _Key, runs: list[Part]) -> _Track:
    shapes = shapes_of(*runs[0].footprints)
    level = np.mean([run.likelihood.level_m3 for run in runs], axis=0)
    whole = level @ shapes.density
    knots = runs[0].likelihood.knots_m
    everything = covariance_of_coefficients(knots, shapes.cycles_per_m, whole)
    if len(runs) == 1:
        shared = Shared(key.truck, key.direction, 0.0, None, level)
        return _Track(shared, root_of(everything), _inverse(everything), None)
    share = common_share([run.likelihood.off_bridge for run in runs])
    wander_m = wander(Mismatch(shapes, level, 1.0), share)
    density = level @ common_shapes(*shapes.footprints, wander_m)
    common = covariance_of_coefficients(knots, shapes.cycles_per_m, density)
    at_long = np.searchsorted(shapes.cycles_per_m, LONG_CYCLES_PER_M)
    shared = Shared(
        key.truck, key.direction, float(density[at_long] / whole[at_long]), wander_m, level
    )
    own = root_of(everything - common)
    return _Track(shared, own, _inverse(everything), common)


def _inverse(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(covariance))


def _key(part: Part) -> _Key:
    knots_m = part.likelihood.knots_m
    first = round(float(knots_m[0]) / KNOT_M) if knots_m.size else 0
    return _Key(part.truck, part.direction, first, knots_m.size)


def root_of(covariance: FloatArray) -> FloatArray:
    """(q, r) of which root root' is the covariance (q, q), what is rounding left out."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _NOTHING * values[-1]
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def _ready(
    part: Part,
    layout: _Layout,
    tracks: dict[_Key, _Track],
    priors: BridgePriors,
    centre: FloatArray,
) -> Ready:
    of, b = part.likelihood, layout.bridge
    truck = layout.trucks[part.truck]
    # The mass scales truck and bridge alike: what is found of the bridge lies aside of what it is.
    heavier = part.mass_spread * _with_mass(priors, centre)
    root = np.hstack(
        [
            of.root[:, : b + truck.size - 1],
            of.root[:, :b] @ heavier[:, None],
            of.root[:, b + truck.size - 1 :],
        ]
    )
    precision, linear = root.T @ root, root.T @ of.target
    places = np.concatenate([np.arange(b), truck])
    key = _key(part)
    if key in tracks:
        q = of.knots_m.size
        along = np.zeros((linear.size, q))
        along[-q:] = np.eye(q)
        precision, linear = loosened(precision, linear, along, tracks[key].own_root)
        if key in layout.tracks:
            places = np.concatenate([places, layout.tracks[key]])
        else:  # nothing else moves these waves
            precision, linear = precision[:-q, :-q], linear[:-q]
    return Ready(precision, linear, places)


def _with_mass(priors: BridgePriors, centre: FloatArray) -> FloatArray:
    """How the bridge's coordinates (b,) at `centre` change with the logarithm of the total mass."""
    of, power = priors.coordinates, priors.mass_powers
    change = np.where(of.is_log, power / of.scale, power * centre)
    elements = np.arange(centre.size - priors.elements, centre.size)
    change[elements] = -power[elements] * centre[elements]
    return np.asarray(change)


def sum_of(
    joint: Joint, priors: BridgePriors, ready: Sequence[Ready]
) -> tuple[FloatArray, FloatArray]:
    """Precision and linear part of all unknowns, with normal priors of the bridge's."""
    return _with_priors(joint, priors, *_told(joint, ready))


def _with_priors(
    joint: Joint, priors: BridgePriors, precision: FloatArray, linear: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A sum of crossings with normal priors of the bridge's unknowns."""
    layout = joint.layout
    precision, linear = precision.copy(), linear.copy()
    single = np.arange(layout.bridge - priors.elements)
    precision[single, single] += 1.0
    rough = _ROUGH_SPREAD**-2
    precision[layout.elements, layout.elements] += rough
    linear[layout.elements] += rough
    return precision, linear


def _told(joint: Joint, ready: Sequence[Ready]) -> tuple[FloatArray, FloatArray]:
    """Precision and linear part of all unknowns, without priors of the bridge's."""
    precision, linear = joint.prior.copy(), np.zeros(joint.layout.size)
    for one in ready:
        precision[np.ix_(one.places, one.places)] += one.precision
        linear[one.places] += one.linear
    return precision, linear


class _Alike(NamedTuple):
    """Crossings (k) with the same places among all unknowns."""

    places: NDArray[np.int64]
    across: FloatArray  # (k, e, p) rows of their precisions at the elements
    linear: FloatArray  # (k, e)


class _Changing(NamedTuple):
    """The sum of all crossings, and what is needed to give each a bridge of its own."""

    precision: FloatArray
    linear: FloatArray
    alike: tuple[_Alike, ...]


def _of_change(joint: Joint) -> _Changing:
    elements = joint.layout.elements
    alike: dict[bytes, list[Ready]] = {}
    for one in joint.ready:
        alike.setdefault(one.places.tobytes(), []).append(one)
    return _Changing(
        *_told(joint, joint.ready),
        tuple(
            _Alike(
                some[0].places,
                np.stack([one.precision[elements] for one in some]),
                np.stack([one.linear[elements] for one in some]),
            )
            for some in alike.values()
        ),
    )


def _changed(
    joint: Joint, of: _Changing, tau: float, rho: float
) -> tuple[FloatArray, FloatArray, float]:
    """Precision and linear part of all unknowns where each crossing has a bridge of its own.

    And what that adds to the logarithm of the evidence.
    """
    if tau == 0.0:
        return of.precision, of.linear, 0.0
    elements = joint.layout.elements
    e = elements.size
    root = np.linalg.cholesky((1.0 - rho) * np.eye(e) + rho) * tau
    root = joint.centre[elements][:, None] * root
    precision, linear, evidence = of.precision.copy(), of.linear.copy(), 0.0
    for some in of.alike:
        across = root.T @ some.across
        pull = some.linear @ root
        factor = np.linalg.cholesky(np.eye(e) + across[:, :, elements] @ root)
        moved = np.linalg.solve(factor, np.concatenate([across, pull[:, :, None]], axis=2))
        rows = moved.reshape(-1, moved.shape[2])
        evidence += 0.5 * float(rows[:, -1] @ rows[:, -1])
        evidence -= float(np.log(np.diagonal(factor, axis1=1, axis2=2)).sum())
        precision[np.ix_(some.places, some.places)] -= rows[:, :-1].T @ rows[:, :-1]
        linear[some.places] -= rows[:, :-1].T @ rows[:, -1]
    return precision, linear, evidence


def between_of(joint: Joint, priors: BridgePriors) -> Between:
    """Posterior of tau and rho; of one crossing it is the prior."""
    tau, rho = (grid.ravel() for grid in np.meshgrid(_TAUS, _RHOS, indexing="ij"))
    log = np.empty(tau.size)
    of = _of_change(joint)
    for k in range(tau.size):
        precision, linear, log[k] = _changed(joint, of, float(tau[k]), float(rho[k]))
        precision, linear = _with_priors(joint, priors, precision, linear)
        factor = np.linalg.cholesky(precision)
        at = np.linalg.solve(factor, linear)
        log[k] += 0.5 * float(at @ at) - float(np.log(np.diag(factor)).sum())
    fine, within = _fine_taus(log.reshape(_TAUS.size, -1))
    return Between(tau, rho, within.sum(axis=2).ravel(), fine, within.reshape(tau.size, -1))


def _fine_taus(log: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places in each cell of tau (t, f), and the weights (t, r, f) there for each rho, sum one.

    From the logarithm of the evidence (t, r), which is smooth between the cells.
    """
    edges = _edges()
    part = (np.arange(_FINER) + 0.5) / _FINER
    fine = edges[:-1, None] + np.diff(edges)[:, None] * part
    smooth = CubicSpline(np.log(_TAUS + _FIRST_TAU), log, axis=0)
    density = smooth(np.log(fine.ravel() + _FIRST_TAU)).reshape(*fine.shape, -1)
    density -= 0.5 * (fine[:, :, None] / BETWEEN_SCALE) ** 2
    weight = np.exp(density - density.max()) * np.diff(edges)[:, None, None]
    return fine, np.moveaxis(weight / weight.sum(), 2, 1)


def _may_be_zero(between: Between) -> bool:
    density = between.within.reshape(_TAUS.size, len(_RHOS), _FINER).sum(axis=1)
    density /= np.diff(_edges())[:, None]
    return bool(density[0, 0] > _AS_LIKELY * density.max())


def _edges() -> FloatArray:
    """Between the cells of tau of which the grid's are inside."""
    return np.concatenate([[0.0], 0.5 * (_TAUS[1:] + _TAUS[:-1]), [_TAUS[-1]]])


def _drawn(
    joint: Joint, priors: BridgePriors, between: Between, count: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Draws (count, chains, b) of the bridge's coordinates, and of tau (count, chains)."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 22,)))
    # As many of each as its weight says, but for chance: systematic sampling.
    at = (np.arange(count) + rng.random()) / count
    chosen = np.minimum(np.searchsorted(np.cumsum(between.weight), at), between.weight.size - 1)
    of = _of_change(joint)
    out, taus = [], []
    for k in np.unique(chosen):
        some = int((chosen == k).sum())
        tau, rho = float(between.tau[k]), float(between.rho[k])
        density = _posterior(joint, priors, *_changed(joint, of, tau, rho)[:2])
        out.append(
            np.stack(
                [
                    draws(density, some, seed, (int(k) + 1) * CHAINS + chain)
                    for chain in range(CHAINS)
                ],
                axis=1,
            )
        )
        share = between.within[k] / between.within[k].sum()
        taus.append(rng.choice(between.fine[k // len(_RHOS)], (some, CHAINS), p=share))
    order = rng.permutation(count)
    return np.concatenate(out)[order], np.concatenate(taus)[order]


def _posterior(
    joint: Joint, priors: BridgePriors, precision: FloatArray, linear: FloatArray
) -> Compliances:
    """A sum of crossings times the priors, with what is not the bridge's integrated out."""
    layout, of = joint.layout, priors.coordinates
    precision, linear = marginal(precision, linear, np.arange(layout.bridge))
    single = np.arange(layout.bridge - priors.elements)
    precision[single, single] += 1.0
    return of_normal(
        precision,
        linear,
        layout.elements,
        np.flatnonzero(~of.is_log),
        of.scale[layout.elements],
        priors.log_odds,
        1.0,
        joint.centre[layout.elements],
        np.zeros(layout.bridge),
    )


def common_share(runs: Sequence[OffBridge | None]) -> float:
    """Which part of the mismatch's short waves the runs have in common, by rows off the bridge."""
    known = [run for run in runs if run is not None]
    first = min(round(run.begin_m / OFF_BRIDGE_STEP_M) for run in known)
    last = max(round(run.begin_m / OFF_BRIDGE_STEP_M) + run.value_m.size for run in known)
    step, bent = _APART_STEPS, []
    for run in known:
        d = np.full(last - first, np.nan)
        begin = round(run.begin_m / OFF_BRIDGE_STEP_M) - first
        d[begin : begin + run.value_m.size] = run.value_m
        bent.append(d[2 * step :] - 2.0 * d[step:-step] + d[: -2 * step])
    together = power = 0.0
    for i in range(len(bent)):
        for j in range(i):
            both = np.isfinite(bent[i]) & np.isfinite(bent[j])
            together += float(bent[i][both] @ bent[j][both])
            power += 0.5 * float(bent[i][both] @ bent[i][both] + bent[j][both] @ bent[j][both])
    return float(np.clip(together / power, 0.0, 1.0)) if power > 0.0 else 0.0


def wander(mismatch: Mismatch, share: float) -> float:
    """How far, in m, runs lie beside each other that have this `share` of short waves in common."""
    shapes = mismatch.shapes
    n = shapes.cycles_per_m
    # As the second differences of `common_share` see the waves.
    seen = np.sin(np.pi * n * _APART_STEPS * OFF_BRIDGE_STEP_M) ** 4
    whole = float(mismatch.level_m3 @ shapes.density @ seen)

    def of(wander_m: float) -> float:
        common = common_shapes(*shapes.footprints, wander_m)
        return float(mismatch.level_m3 @ common @ seen) / whole

    low, high = _WANDERS_M
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if of(middle) > share else (low, middle)
    return 0.5 * (low + high)
