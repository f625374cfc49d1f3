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
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.compliances import Compliances, draws, marginal, of_normal
from pre_core.fusion.between import Between, between_of, changed, may_be_zero, of_change, tau_draws
from pre_core.fusion.likelihood import Likelihood, loosened, straightened
from pre_core.fusion.sums import BridgePriors, Joint, Layout, Ready
from pre_core.fusion.tracks import Key, Part, Shared, Track, key_of, tracks_of
from pre_core.search.crank_nicolson import CHAINS
from pre_core.search.levenberg_marquardt import minimised
from pre_core.search.loop import Report

FloatArray = NDArray[np.float64]

_USUAL = (0.03, 0.3)
"""tau and rho by which the bridge is found about which it changes."""
_SETTLED = 0.01
"""Of a compliance and of the other unknowns' coordinates: far within what is known of them."""
_MOST_STEPS, _ENOUGH = 60, 1e-6
_PASSES = 12
"""Of finding the bridge about which it changes, and crossings' likelihoods are normal."""


class Fused(NamedTuple):
    """Draws of the bridge's unknowns in the coordinates of `crossing.posterior`."""

    draws: FloatArray  # (n, chains, b): the bridge's, elements last
    between: FloatArray
    """(n, chains) the standard deviation tau of ln EI between crossings."""
    between_may_be_zero: bool
    """Whether no tau is much likelier than none at all."""
    tracks: tuple[Shared, ...]


def fuse(parts: Sequence[Part], priors: BridgePriors, count: int, seed: int) -> Fused:
    """Draws of a bridge, `count` of each chain, from crossings with the coordinates of `priors`.

    The order of the parts does not matter. ValueError without parts.
    """
    if not parts:
        raise ValueError("no crossings to fuse")
    return fuse_joined(join(parts, priors), priors, count, seed)


def fuse_joined(
    joint: Joint,
    priors: BridgePriors,
    count: int,
    seed: int,
    report: Report = lambda stage, fraction: None,
    threads: int = 1,
) -> Fused:
    """As `fuse`, of crossings that are ready; the draws do not depend on the number of threads."""
    between = between_of(joint, priors)
    drawn = _drawn(joint, priors, between, count, seed, report, threads)
    return Fused(*drawn, may_be_zero(between), joint.shared)


def join(
    parts: Sequence[Part], priors: BridgePriors, trusted: Collection[str] | None = None
) -> Joint:
    """Crossings with what is their own integrated out, but for the change of the bridge.

    Changes are relative to what all give together, or the `trusted` of them by name.
    """
    parts = sorted(parts, key=lambda part: part.name)
    tracks = tracks_of(parts)
    layout = _layout_of(parts, tracks, priors)
    prior = _prior(layout, tracks)
    shared = tuple(track.shared for track in tracks.values())
    names = tuple(part.name for part in parts)
    centre = _nominal(layout)
    for number in range(_PASSES):
        bridge = centre if number else None
        ready = tuple(
            _ready(_about(part, tracks, bridge), layout, tracks, priors, centre) for part in parts
        )
        joint = Joint(names, layout, ready, prior, centre, shared)
        # Without a change crossings surer than the bridge is steady would lead it astray.
        of = of_change(joint._replace(ready=joint.of(trusted)))
        before, centre = centre, _most_likely(layout, priors, *changed(joint, of, *_USUAL)[:2])
        if np.all(np.abs(centre - before) < _SETTLED):
            break
    return joint._replace(centre=centre)


def _most_likely(
    layout: Layout, priors: BridgePriors, precision: FloatArray, linear: FloatArray
) -> FloatArray:
    """The likeliest bridge (b,) by a sum of crossings and its own priors, log-normal in EI.

    Where crossings hardly tell elements apart normal priors of c would let neighbours take turns at
    being stiff; likelihoods that are made normal there say little of the bridge.
    """
    told, pull = marginal(precision, linear, np.arange(layout.bridge))
    root = np.linalg.cholesky(told).T
    target = np.linalg.solve(root.T, pull)
    sigma = priors.coordinates.scale[layout.elements]

    def bridge(y: FloatArray) -> FloatArray:
        x = y.copy()
        x[:, layout.elements] = np.exp(-sigma * y[:, layout.elements])
        return x

    def rows(y: FloatArray) -> FloatArray:
        return np.concatenate([bridge(y) @ root.T - target, y], axis=1)

    lower = np.where(priors.coordinates.is_log, -np.inf, 0.0)
    found = minimised(rows, np.zeros(layout.bridge), _MOST_STEPS, _ENOUGH, lower)
    return bridge(found.state.y[None, :])[0]


def alone(part: Part, priors: BridgePriors) -> Joint:
    """One crossing by itself, about what it says of the bridge; its waves are its own."""
    tracks = tracks_of([part])
    layout = _layout_of([part], tracks, priors)
    centre = _nominal(layout)
    ready = _ready(_about(part, tracks, None), layout, tracks, priors, centre)
    shared = tuple(track.shared for track in tracks.values())
    return Joint((part.name,), layout, (ready,), _prior(layout, tracks), centre, shared)


def _nominal(layout: Layout) -> FloatArray:
    """(b,) of a bridge as the site file has it."""
    centre = np.zeros(layout.bridge)
    centre[layout.elements] = 1.0
    return centre


def _prior(layout: Layout, tracks: dict[Key, Track]) -> FloatArray:
    """Precision (n, n) of trucks and tracks before any crossing."""
    prior = np.zeros((layout.size, layout.size))
    for places in layout.trucks.values():
        prior[places, places] = 1.0
    for key, places in layout.tracks.items():
        common = tracks[key].common
        assert common is not None  # noqa: S101 - it has a place among the unknowns
        prior[np.ix_(places, places)] = np.linalg.inv(common)
    return prior


def _about(part: Part, tracks: dict[Key, Track], bridge: FloatArray | None) -> Part:
    """The crossing with a likelihood that is normal about a `bridge` (b,); None: the crossing's."""
    told = part.likelihood
    if told.bends is None:
        return part
    at = told.bends.about if bridge is None else bridge
    return part._replace(likelihood=straightened(told, at, tracks[key_of(part)].whole))


def _layout_of(parts: Sequence[Part], tracks: dict[Key, Track], priors: BridgePriors) -> Layout:
    b = len(priors.coordinates.names)
    size, trucks, places = b, {}, {}
    for part in parts:
        if part.truck not in trucks:
            own = len(part.likelihood.truck.names) + 1
            trucks[part.truck] = size + np.arange(own)
            size += own
        key = key_of(part)
        if key not in places and key in tracks and tracks[key].common is not None:
            q = part.likelihood.knots_m.size
            places[key] = size + np.arange(q)
            size += q
    return Layout(b, np.arange(b - priors.elements, b), trucks, places, size)


def _ready(
    part: Part,
    layout: Layout,
    tracks: dict[Key, Track],
    priors: BridgePriors,
    centre: FloatArray,
) -> Ready:
    of, b = part.likelihood, layout.bridge
    truck = layout.trucks[part.truck]
    precision, linear = mass_freed(of, part.mass_spread, priors, centre)
    places = np.concatenate([np.arange(b), truck])
    key = key_of(part)
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


def mass_freed(
    of: Likelihood, spread: float, priors: BridgePriors, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Precision and linear part of bridge, truck, unit normal of the mass, and waves.

    The mass scales truck and bridge alike: what is found of the bridge lies aside of what it is.
    """
    b, t = len(of.bridge.names), len(of.truck.names)
    heavier = of.root[:, :b] @ (spread * with_mass(priors, centre))[:, None]
    root = np.hstack([of.root[:, : b + t], heavier, of.root[:, b + t :]])
    return root.T @ root, root.T @ of.target


def with_mass(priors: BridgePriors, centre: FloatArray) -> FloatArray:
    """How the bridge's coordinates (b,) at `centre` change with the logarithm of the total mass."""
    of, power = priors.coordinates, priors.mass_powers
    change = np.where(of.is_log, power / of.scale, power * centre)
    elements = np.arange(centre.size - priors.elements, centre.size)
    change[elements] = -power[elements] * centre[elements]
    return np.asarray(change)


def _drawn(
    joint: Joint,
    priors: BridgePriors,
    between: Between,
    count: int,
    seed: int,
    report: Report,
    threads: int,
) -> tuple[FloatArray, FloatArray]:
    """Draws (count, chains, b) of the bridge's coordinates, and of tau (count, chains)."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 22,)))
    # As many of each as its weight says, but for chance: systematic sampling.
    at = (np.arange(count) + rng.random()) / count
    chosen = np.minimum(np.searchsorted(np.cumsum(between.weight), at), between.weight.size - 1)
    of = of_change(joint)
    steps, taus = [], []
    for k in np.unique(chosen):
        some = int((chosen == k).sum())
        tau, rho = float(between.tau[k]), float(between.rho[k])
        density = _posterior(joint, priors, *changed(joint, of, tau, rho)[:2])
        steps.append(_Step(density, some, (int(k) + 1) * CHAINS))
        taus.append(tau_draws(between, int(k), (some, CHAINS), rng))
    of_chains: list[FloatArray] = []
    with ThreadPoolExecutor(threads) as pool:
        for one in pool.map(partial(_chain, steps, seed), range(CHAINS)):
            report("drawing the bridge", len(of_chains) / CHAINS)
            of_chains.append(one)
    order = rng.permutation(count)
    return np.stack(of_chains, axis=1)[order], np.concatenate(taus)[order]


class _Step(NamedTuple):
    """A change between crossings of which some draws are wanted."""

    density: Compliances
    number: int
    stream: int
    """Of the random numbers of the first chain."""


def _chain(steps: Sequence[_Step], seed: int, chain: int) -> FloatArray:
    """One chain's draws (count, b) of all steps: from one change to the next little moves."""
    out: list[FloatArray] = []
    for step in steps:
        after = out[-1][-1] if out else None
        out.append(draws(step.density, step.number, seed, step.stream + chain, after))
    return np.concatenate(out)


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
