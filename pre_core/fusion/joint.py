"""One bridge from the likelihoods of several crossings, with each prior once.

The coordinates are those of the bridge; of each truck, with its total mass; and, for each
wheel-path group (a truck in one direction), the long waves of the shared mismatch, which do not
average out. Each crossing has its own part of those waves, too, and its own change of every
element's compliance: between crossings EI varies with temperature and with effects that the model
lacks, by a relative standard deviation tau of which a share rho is common to all elements. Normal
variables are integrated out; tau and rho are evaluated on a grid.
"""

from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.compliances import CompliancePosterior, draws, from_normal, marginal
from pre_core.fusion.curved_posterior import CurvedSum, curved_draws, curved_sum
from pre_core.fusion.information import (
    BridgePriors,
    CrossingInformation,
    JointInformation,
    JointLayout,
)
from pre_core.fusion.likelihood import CrossingLikelihood, add_covariance, linearised_likelihood
from pre_core.fusion.mass import mass_sensitivity
from pre_core.fusion.path_groups import (
    FusionInput,
    PathGroup,
    PathGroupKey,
    SharedMismatch,
    path_group_key,
    path_groups,
    wave_precision,
)
from pre_core.fusion.variability import (
    VariabilityPosterior,
    draws_of_tau,
    draws_of_tau_within,
    is_consistent_with_zero,
    marginalise_variability,
    mean_variability,
    variability_posterior,
    varying_bridge,
)
from pre_core.search.convergence import CHAINS
from pre_core.search.levenberg_marquardt import minimise
from pre_core.search.loop import Report

_USUAL = (0.03, 0.3)
"""Values of tau and rho for the bridge about which likelihoods are linearised."""
_SETTLED = 0.01
"""Tolerance of a compliance and of other coordinates, far below their uncertainty."""
_MAX_STEPS, _ENOUGH = 60, 1e-6
_PASSES = 12
"""Largest number of linearisations about the current estimate."""


class FusedDraws(NamedTuple):
    """Draws of the bridge's parameters in the coordinates of `crossing.posterior`."""

    draws: FloatArray  # (n, chains, b): the bridge's, elements last
    between: FloatArray
    """Standard deviation tau of ln EI between crossings, (n, chains)."""
    between_may_be_zero: bool
    """Whether tau is consistent with zero."""
    tracks: tuple[SharedMismatch, ...]


def sample_joint(
    parts: Sequence[FusionInput],
    information: JointInformation,
    priors: BridgePriors,
    count: int,
    seed: int,
    report: Report = lambda stage, fraction: None,
    threads: int = 1,
) -> FusedDraws:
    """Return draws of a bridge, `count` of each chain; they do not depend on `threads`.

    `parts` are the crossings in `information`. If they have response surfaces, tau is fixed at its
    root mean square for the draws of the bridge.
    """
    between = variability_posterior(information, priors)
    if any(one.likelihood.bends and one.likelihood.bends.logarithms for one in parts):
        parts = sorted(parts, key=lambda part: part.name)
        usual = mean_variability(between)
        curved = curved_sum(parts, path_groups(parts), information, priors, usual)
        drawn = _draw_curved(curved, priors, between, count, seed, report, threads)
    else:
        drawn = _draw_bridge(information, priors, between, count, seed, report, threads)
    return FusedDraws(*drawn, is_consistent_with_zero(between), information.shared)


def build_joint(
    parts: Sequence[FusionInput], priors: BridgePriors, consistent: Collection[str] | None = None
) -> JointInformation:
    """Return crossings with all own variables but the bridge's change integrated out.

    Changes are relative to the estimate from all crossings, or from those named in `consistent`.
    """
    parts = sorted(parts, key=lambda part: part.name)
    tracks = path_groups(parts)
    layout = _layout_of(parts, tracks, priors)
    prior = _prior(layout, tracks)
    shared = tuple(track.shared for track in tracks.values())
    names = tuple(part.name for part in parts)
    centre = _nominal(layout)
    for number in range(_PASSES):
        bridge = centre if number else None
        crossings = tuple(
            _crossing_information(
                _linearised_about(part, tracks, bridge), layout, tracks, priors, centre
            )
            for part in parts
        )
        information = JointInformation(names, layout, crossings, prior, centre, shared)
        # Without variability, crossings with intervals narrower than it would bias the centre.
        varying = varying_bridge(information._replace(crossings=information.select(consistent)))
        before, centre = (
            centre,
            _most_likely(
                layout, priors, *marginalise_variability(information, varying, *_USUAL)[:2]
            ),
        )
        if np.all(np.abs(centre - before) < _SETTLED):
            break
    return information._replace(centre=centre)


def _most_likely(
    layout: JointLayout, priors: BridgePriors, precision: FloatArray, linear: FloatArray
) -> FloatArray:
    """Return the most likely bridge (b,) from a sum of crossings and priors, log-normal in EI.

    Where crossings hardly separate elements, normal priors of c would let neighbours alternate
    between stiff and weak; likelihoods linearised there are uninformative.
    """
    reduced, pull = marginal(precision, linear, np.arange(layout.bridge))
    root = np.linalg.cholesky(reduced).T
    target = np.linalg.solve(root.T, pull)
    sigma = priors.coordinates.scale[layout.elements]

    def bridge(y: FloatArray) -> FloatArray:
        x = y.copy()
        x[:, layout.elements] = np.exp(-sigma * y[:, layout.elements])
        return x

    def rows(y: FloatArray) -> FloatArray:
        return np.concatenate([bridge(y) @ root.T - target, y], axis=1)

    lower = np.where(priors.coordinates.is_log, -np.inf, 0.0)
    found = minimise(rows, np.zeros(layout.bridge), _MAX_STEPS, _ENOUGH, lower)
    return bridge(found.state.y[None, :])[0]


def single_crossing_joint(part: FusionInput, priors: BridgePriors) -> JointInformation:
    """Return the joint information of a single crossing, about its estimate, with its waves."""
    tracks = path_groups([part])
    layout = _layout_of([part], tracks, priors)
    centre = _nominal(layout)
    crossing = _crossing_information(
        _linearised_about(part, tracks, None), layout, tracks, priors, centre
    )
    shared = tuple(track.shared for track in tracks.values())
    return JointInformation(
        (part.name,), layout, (crossing,), _prior(layout, tracks), centre, shared
    )


def _nominal(layout: JointLayout) -> FloatArray:
    """Return the coordinates (b,) of the nominal bridge."""
    centre = np.zeros(layout.bridge)
    centre[layout.elements] = 1.0
    return centre


def _prior(layout: JointLayout, tracks: dict[PathGroupKey, PathGroup]) -> FloatArray:
    """Return the prior precision (n, n) of trucks and wheel-path groups."""
    prior = np.zeros((layout.size, layout.size))
    for places in layout.trucks.values():
        prior[places, places] = 1.0
    for key, places in layout.tracks.items():
        common = tracks[key].common
        assert common is not None  # noqa: S101 - a group with coordinates has one
        prior[np.ix_(places, places)] = np.linalg.inv(common)
    return prior


def _linearised_about(
    part: FusionInput, tracks: dict[PathGroupKey, PathGroup], bridge: FloatArray | None
) -> FusionInput:
    """Return the crossing linearised about a `bridge` (b,); None: about its own estimate."""
    likelihood = part.likelihood
    if likelihood.bends is None:
        return part
    at = likelihood.bends.about if bridge is None else bridge
    return part._replace(
        likelihood=linearised_likelihood(likelihood, at, wave_precision(part, tracks))
    )


def _layout_of(
    parts: Sequence[FusionInput], tracks: dict[PathGroupKey, PathGroup], priors: BridgePriors
) -> JointLayout:
    b = len(priors.coordinates.names)
    size, trucks, places = b, {}, {}
    for part in parts:
        if part.truck not in trucks:
            own = len(part.likelihood.truck.names) + 1
            trucks[part.truck] = size + np.arange(own)
            size += own
        key = path_group_key(part)
        if key not in places and key in tracks and tracks[key].common is not None:
            q = part.likelihood.knots_m.size
            places[key] = size + np.arange(q)
            size += q
    return JointLayout(b, np.arange(b - priors.elements, b), trucks, places, size)


def _crossing_information(
    part: FusionInput,
    layout: JointLayout,
    tracks: dict[PathGroupKey, PathGroup],
    priors: BridgePriors,
    centre: FloatArray,
) -> CrossingInformation:
    likelihood, b = part.likelihood, layout.bridge
    truck = layout.trucks[part.truck]
    precision, linear = add_mass_parameter(likelihood, part.mass_spread, priors, centre)
    places = np.concatenate([np.arange(b), truck])
    key = path_group_key(part)
    if key in tracks:
        unit = np.eye(linear.size)
        if part.name in tracks[key].short_roots:
            root = tracks[key].short_roots[part.name]
            precision, linear = add_covariance(precision, linear, unit[:, :b], root)
        q = likelihood.knots_m.size
        precision, linear = add_covariance(precision, linear, unit[:, -q:], tracks[key].own_root)
        if key in layout.tracks:
            places = np.concatenate([places, layout.tracks[key]])
        else:  # no other variable affects these waves
            precision, linear = precision[:-q, :-q], linear[:-q]
    return CrossingInformation(precision, linear, places)


def add_mass_parameter(
    crossing: CrossingLikelihood, spread: float, priors: BridgePriors, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return precision (n, n) and linear part (n,) with the mass error as a further coordinate.

    The n coordinates are those of bridge and truck, the mass error in units of its `spread`, and
    the waves. The mass scales truck and bridge together; `centre` (b,) is the bridge that is
    scaled.
    """
    b, t = len(crossing.bridge.names), len(crossing.truck.names)
    heavier = crossing.root[:, :b] @ (spread * mass_sensitivity(priors, centre))[:, None]
    root = np.hstack([crossing.root[:, : b + t], heavier, crossing.root[:, b + t :]])
    return root.T @ root, root.T @ crossing.target


def _draw_curved(
    curved: CurvedSum,
    priors: BridgePriors,
    between: VariabilityPosterior,
    count: int,
    seed: int,
    report: Report,
    threads: int,
) -> tuple[FloatArray, FloatArray]:
    """Return draws as `_draw_bridge` does, on the crossings' response surfaces."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 22,)))
    progress = partial(report, "drawing the bridge")
    drawn = curved_draws(curved, priors, count * CHAINS, rng, progress, threads)
    order = rng.permutation(count * CHAINS)
    taus = draws_of_tau(between, count * CHAINS, rng)
    return drawn[order].reshape(count, CHAINS, -1), taus.reshape(count, CHAINS)


def _draw_bridge(
    information: JointInformation,
    priors: BridgePriors,
    between: VariabilityPosterior,
    count: int,
    seed: int,
    report: Report,
    threads: int,
) -> tuple[FloatArray, FloatArray]:
    """Return draws (count, chains, b) of the bridge's coordinates, and of tau (count, chains)."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 22,)))
    # Systematic sampling: the number of draws of each follows its weight.
    at = (np.arange(count) + rng.random()) / count
    chosen = np.minimum(np.searchsorted(np.cumsum(between.weight), at), between.weight.size - 1)
    varying = varying_bridge(information)
    steps, taus = [], []
    for k in np.unique(chosen):
        some = int((chosen == k).sum())
        tau, rho = float(between.tau[k]), float(between.rho[k])
        density = _posterior(
            information, priors, *marginalise_variability(information, varying, tau, rho)[:2]
        )
        steps.append(_Step(density, some, (int(k) + 1) * CHAINS))
        taus.append(draws_of_tau_within(between, int(k), (some, CHAINS), rng))
    of_chains: list[FloatArray] = []
    with ThreadPoolExecutor(threads) as pool:
        for one in pool.map(partial(_chain, steps, seed), range(CHAINS)):
            report("drawing the bridge", len(of_chains) / CHAINS)
            of_chains.append(one)
    order = rng.permutation(count)
    return np.stack(of_chains, axis=1)[order], np.concatenate(taus)[order]


class _Step(NamedTuple):
    """A set of draws for one value of the variability."""

    density: CompliancePosterior
    number: int
    stream: int
    """Stream of random numbers of the first chain."""


def _chain(steps: Sequence[_Step], seed: int, chain: int) -> FloatArray:
    """Return one chain's draws (count, b) of all steps; successive steps differ little."""
    out: list[FloatArray] = []
    for step in steps:
        after = out[-1][-1] if out else None
        out.append(draws(step.density, step.number, seed, step.stream + chain, after))
    return np.concatenate(out)


def _posterior(
    information: JointInformation, priors: BridgePriors, precision: FloatArray, linear: FloatArray
) -> CompliancePosterior:
    """Return a sum of crossings times the priors, marginal in the bridge's coordinates."""
    layout, coordinates = information.layout, priors.coordinates
    precision, linear = marginal(precision, linear, np.arange(layout.bridge))
    single = np.arange(layout.bridge - priors.elements)
    precision[single, single] += 1.0
    return from_normal(
        precision,
        linear,
        layout.elements,
        np.flatnonzero(~coordinates.is_log),
        coordinates.scale[layout.elements],
        priors.log_odds,
        information.centre[layout.elements],
    )
