"""Conversion of stored likelihoods for `pre_core.fusion`, and fusion of a bridge."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pre_core import parameters
from pre_core.crossing.fit import Optimum
from pre_core.crossing.posterior import log_odds
from pre_core.fusion import likelihood as of_crossing
from pre_core.fusion import long_waves
from pre_core.fusion.crossing_consistency import select_consistent
from pre_core.fusion.curvature import CurvatureTerms
from pre_core.fusion.information import BridgePriors
from pre_core.fusion.joint import FusedDraws, build_joint, sample_joint
from pre_core.fusion.path_groups import FusionInput
from pre_core.fusion.short_waves import ShortWaveResponse
from pre_core.fusion.vehicle_consistency import find_misattributed
from pre_core.physics.road import Profile
from pre_core.physics.surface import Footprint
from pre_core.search.loop import Report
from schemas import fusion
from schemas.results import Track
from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData
from services.identification.usable import Source

_DIGITS = 9
"""Significant digits of a likelihood: rounding moves an estimate by 1e-6 of its uncertainty."""
_FEW_DIGITS = 4
"""Significant digits of the curvature terms and of responses to short waves."""
_DRAWS_PER_CHAIN = 250
_SEED = 1
_COMPARED, _JOINED = 0.1, 0.4
"""Progress of a fusion at the comparison of trucks, and at the joint estimate."""


class FusedBridge(NamedTuple):
    """Fused estimate of a bridge from its consistent crossings."""

    ei_nm2: Floats  # (draws, n)
    nominal_nm2: Floats  # (n,)
    element_lengths_m: Floats  # (n,)
    between: Floats  # (draws,)
    between_may_be_zero: bool
    tracks: tuple[Track, ...]
    used: tuple[str, ...]
    excluded: tuple[str, ...]
    other_model: tuple[str, ...]
    is_contradictory: bool


def stored(
    data: CrossingData, found: Optimum, points: Floats | None = None
) -> fusion.FusionLikelihood:
    """Return the likelihood of a crossing as a part of its result.

    `points` are those of `pre_core.fusion.likelihood.likelihood`.
    """
    likelihood = of_crossing.likelihood(found, points=points)
    priors = found.problem.priors
    absence = dict(
        zip(parameters.names(data.bridge.elements), priors.absence.tolist(), strict=True)
    )
    m = likelihood.target.size
    front, rear = (
        fusion.AxleFootprint(**axle._asdict()) for axle in found.problem.mismatch.shapes.footprints
    )
    return fusion.FusionLikelihood(
        bridge=_coordinates(likelihood.bridge, absence),
        truck=_coordinates(likelihood.truck, {}),
        root=_rounded(likelihood.root[np.triu_indices(m)]),
        target=_rounded(likelihood.target),
        element_lengths_m=tuple(data.bridge.lengths_m),
        mass_spread=data.vehicle.spread("total_mass_kg"),
        footprints=(front, rear),
        first_knot_m=float(likelihood.knots_m[0]) if likelihood.knots_m.size else None,
        knot_spacing_m=long_waves.knot_spacing_m(found.problem.mismatch),
        level_m3=_rounded(likelihood.level_m3),
        off_bridge_m=_stretches(likelihood.off_bridge),
        bends=_stored_bends(likelihood.bends),
        short_waves=_stored_short_waves(likelihood.short_waves),
    )


def _stored_bends(terms: CurvatureTerms | None) -> fusion.Bends | None:
    if terms is None:
        return None
    shapes = _rounded(terms.shapes.ravel(), _FEW_DIGITS)
    directions = _rounded(terms.directions.ravel())
    return fusion.Bends(
        about=_rounded(terms.about),
        directions=directions,
        shapes=shapes,
        logarithms=terms.logarithms,
    )


def _stored_short_waves(response: ShortWaveResponse | None) -> fusion.ShortWaves | None:
    if response is None:
        return None
    return fusion.ShortWaves(
        step_cycles_per_m=response.step_cycles_per_m,
        cosine=_rounded(response.cosine.ravel(), _FEW_DIGITS),
        sine=_rounded(response.sine.ravel(), _FEW_DIGITS),
    )


def _rounded(values: Floats, digits: int = _DIGITS) -> tuple[float, ...]:
    return tuple(float(f"{value:.{digits}e}") for value in values)


def _coordinates(
    coordinates: of_crossing.Coordinates, absence: dict[str, float]
) -> tuple[fusion.Coordinate, ...]:
    return tuple(
        fusion.Coordinate(
            name=name,
            location=float(location),
            scale=float(scale),
            is_log=bool(is_log),
            absence=absence.get(name, 0.0),
        )
        for name, location, scale, is_log in zip(*coordinates, strict=True)
    )


def _stretches(off: long_waves.OffBridgeMismatch | None) -> tuple[fusion.Stretch, ...]:
    """Return the values present, as segments without gaps."""
    if off is None:
        return ()
    step = long_waves.OFF_BRIDGE_STEP_M
    there = np.flatnonzero(np.isfinite(off.value_m))
    pieces = np.split(there, np.flatnonzero(np.diff(there) > 1) + 1) if there.size else []
    return tuple(
        fusion.Stretch(
            begin_m=off.begin_m + step * float(piece[0]),
            step_m=step,
            values=tuple(float(f"{value:.4e}") for value in off.value_m[piece]),
        )
        for piece in pieces
    )


# The likelihoods of crossings overflow far from their optima, where they are infinitely unlikely.
@np.errstate(all="ignore")
def fused(
    sources: Sequence[Source],
    report: Report = lambda stage, fraction: None,
    threads: int = 1,
) -> FusedBridge:
    """Fuse crossings to one estimate; the last one defines the bridge's parameters.

    Raise ValueError without crossings.
    """
    if not sources:
        raise ValueError("no crossings to fuse")
    last = sources[-1].likelihood
    others = [one for one in sources if not _is_like(one.likelihood, last)]
    alike = [one for one in sources if _is_like(one.likelihood, last)]
    priors = _priors(last)
    parts = [_part(one, priors.coordinates) for one in alike]
    vehicles = {part.truck: one.vehicle for part, one in zip(parts, alike, strict=True)}
    report("comparing trucks", 0.0)
    compared = find_misattributed(parts, priors)
    parts = [part for part in parts if part.name not in compared.misattributed]
    report("putting crossings together", _COMPARED)
    information = build_joint(parts, priors)
    judged = select_consistent(parts, information, priors)
    if judged.excluded:
        parts = [part for part in parts if part.name in judged.consistent]
        information = build_joint(parts, priors)

    def drawing(stage: str, fraction: float) -> None:
        report(stage, _JOINED + (1.0 - _JOINED) * fraction)

    found = sample_joint(parts, information, priors, _DRAWS_PER_CHAIN, _SEED, drawing, threads)
    nominal = priors.coordinates.location[-priors.elements :]
    spread = priors.coordinates.scale[-priors.elements :]
    y = found.draws.reshape(-1, found.draws.shape[2])[:, -priors.elements :]
    return FusedBridge(
        nominal * np.exp(spread * y),
        nominal,
        np.array(last.element_lengths_m),
        found.between.ravel(),
        found.between_may_be_zero,
        _tracks(found, vehicles),
        judged.consistent,
        tuple(sorted([*compared.misattributed, *judged.excluded])),
        tuple(one.crossing_id for one in others),
        compared.is_contradictory or judged.is_contradictory,
    )


def fusion_input(source: Source) -> tuple[FusionInput, BridgePriors]:
    """Return a crossing as input of the fusion, in its own coordinates."""
    priors = _priors(source.likelihood)
    return _part(source, priors.coordinates), priors


def _tracks(found: FusedDraws, vehicles: Mapping[str, str]) -> tuple[Track, ...]:
    """Return the wheel-path groups; `vehicles` are the trucks' names by their keys."""
    return tuple(
        Track(
            vehicle=vehicles[one.truck],
            direction="start_to_end" if one.direction > 0 else "end_to_start",
            common_share=one.common_share,
            wander_m=one.wander_m,
        )
        for one in found.tracks
        if one.wander_m is not None
    )


def _is_like(one: fusion.FusionLikelihood, other: fusion.FusionLikelihood) -> bool:
    """Return whether two likelihoods have the same parameters of a bridge."""

    def bridge_parameters(likelihood: fusion.FusionLikelihood) -> object:
        names = tuple((c.name, c.is_log) for c in likelihood.bridge)
        return names, likelihood.element_lengths_m

    return bridge_parameters(one) == bridge_parameters(other)


def _priors(likelihood: fusion.FusionLikelihood) -> BridgePriors:
    elements = len(likelihood.element_lengths_m)
    names = parameters.names(elements)
    power = dict(zip(names, parameters.mass_powers(elements).tolist(), strict=True))
    return BridgePriors(
        _from_stored(likelihood.bridge),
        np.array([power[c.name] for c in likelihood.bridge]),
        log_odds(np.array([c.absence for c in likelihood.bridge])),
        elements,
    )


def _from_stored(coordinates: Sequence[fusion.Coordinate]) -> of_crossing.Coordinates:
    return of_crossing.Coordinates(
        tuple(c.name for c in coordinates),
        np.array([c.location for c in coordinates]),
        np.array([c.scale for c in coordinates]),
        np.array([c.is_log for c in coordinates], dtype=np.bool_),
    )


def _part(source: Source, coordinates: of_crossing.Coordinates) -> FusionInput:
    stored_likelihood = source.likelihood
    m = len(stored_likelihood.target)
    root = np.zeros((m, m))
    root[np.triu_indices(m)] = stored_likelihood.root
    likelihood = of_crossing.CrossingLikelihood(
        root,
        np.array(stored_likelihood.target),
        _from_stored(stored_likelihood.bridge),
        _from_stored(stored_likelihood.truck),
        _knots(stored_likelihood, m),
        np.array(stored_likelihood.level_m3),
        _off_bridge(stored_likelihood),
        _bends(stored_likelihood),
        _short_waves(stored_likelihood),
    )
    likelihood = of_crossing.in_coordinates(
        likelihood, coordinates, len(stored_likelihood.element_lengths_m)
    )
    # A truck whose site file has changed may be another one.
    key = [[c.name, c.location, c.scale] for c in stored_likelihood.truck]
    truck = f"{source.vehicle} {key} {stored_likelihood.footprints} {stored_likelihood.mass_spread}"
    front, rear = (Footprint(**axle.model_dump()) for axle in stored_likelihood.footprints)
    road = source.road
    return FusionInput(
        source.crossing_id,
        likelihood,
        truck,
        source.direction,
        (front, rear),
        stored_likelihood.mass_spread,
        None if road is None else Profile(np.array(road.x_m), np.array(road.mean_m)),
    )


def _knots(likelihood: fusion.FusionLikelihood, m: int) -> Floats:
    if likelihood.first_knot_m is None:
        return np.zeros(0)
    bends = _bends(likelihood)
    count = m - len(likelihood.bridge) - len(likelihood.truck)
    if bends is not None:
        count -= 1 + bends.shapes.shape[0]
    return likelihood.first_knot_m + likelihood.knot_spacing_m * np.arange(count, dtype=np.float64)


def _bends(likelihood: fusion.FusionLikelihood) -> CurvatureTerms | None:
    if likelihood.bends is None:
        return None
    moves = len(likelihood.bridge) + 1
    shapes = np.array(likelihood.bends.shapes).reshape(-1, moves * (moves + 1) // 2)
    directions = np.array(likelihood.bends.directions).reshape(-1, moves)
    if likelihood.bends.size:
        directions = np.diag(likelihood.bends.size)
    return CurvatureTerms(
        np.array(likelihood.bends.about), directions, shapes, likelihood.bends.logarithms
    )


def _short_waves(likelihood: fusion.FusionLikelihood) -> ShortWaveResponse | None:
    if likelihood.short_waves is None:
        return None
    cosine, sine = (
        np.array(values).reshape(len(likelihood.bridge), -1)
        for values in (likelihood.short_waves.cosine, likelihood.short_waves.sine)
    )
    return ShortWaveResponse(likelihood.short_waves.step_cycles_per_m, cosine, sine)


def _off_bridge(likelihood: fusion.FusionLikelihood) -> long_waves.OffBridgeMismatch | None:
    if not likelihood.off_bridge_m:
        return None
    step = long_waves.OFF_BRIDGE_STEP_M
    begin = min(one.begin_m for one in likelihood.off_bridge_m)
    end = max(one.begin_m + step * len(one.values) for one in likelihood.off_bridge_m)
    values = np.full(round((end - begin) / step), np.nan)
    for one in likelihood.off_bridge_m:
        first = round((one.begin_m - begin) / step)
        values[first : first + len(one.values)] = one.values
    return long_waves.OffBridgeMismatch(begin, values)
