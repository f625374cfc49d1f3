"""Likelihoods of crossings between results and `pre_core.fusion`, and a bridge fused from them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import unknowns
from pre_core.crossing.optimum import Optimum
from pre_core.crossing.posterior import log_odds
from pre_core.fusion import likelihood as of_crossing
from pre_core.fusion.bends import Bends
from pre_core.fusion.disagreement import judge
from pre_core.fusion.joint import Fused, fuse_joined, join
from pre_core.fusion.sums import BridgePriors
from pre_core.fusion.tracks import Part
from pre_core.fusion.trucks import compare_trucks
from pre_core.physics.surface import Footprint
from pre_core.search.loop import Report
from schemas import fusion
from schemas.results import Crossing, Track
from services.identification.crossing_data import CrossingData

Floats = NDArray[np.float64]

_DIGITS = 9
"""Of a likelihood's numbers: what is left out moves an estimate by 1e-6 of its uncertainty."""
_DIGITS_OF_BENDS = 4
_DRAWS_PER_CHAIN = 250
_SEED = 1
_COMPARED, _JOINED = 0.1, 0.4
"""How much is done of a bridge of many crossings when trucks are compared, crossings together."""


class Source(NamedTuple):
    """What fusion needs of a crossing."""

    crossing_id: str
    vehicle: str
    direction: int
    likelihood: fusion.FusionLikelihood


class FusedBridge(NamedTuple):
    """A bridge by all crossings that agree."""

    ei_nm2: Floats  # (draws, n)
    nominal_nm2: Floats  # (n,)
    element_lengths_m: Floats  # (n,)
    between: Floats  # (draws,)
    between_may_be_zero: bool
    tracks: tuple[Track, ...]
    used: tuple[str, ...]
    left_out: tuple[str, ...]
    other_model: tuple[str, ...]
    disagree: bool


def source_of(result: Crossing) -> Source | None:
    """What a result left for fusion; None if nothing."""
    if result.fusion_likelihood is None:
        return None
    direction = 1 if result.direction == "start_to_end" else -1
    return Source(result.crossing_id, result.vehicle, direction, result.fusion_likelihood)


def stored(data: CrossingData, found: Optimum) -> fusion.FusionLikelihood:
    """The likelihood of a crossing as a part of its result."""
    told = of_crossing.likelihood(found)
    priors = found.problem.priors
    absence = dict(zip(unknowns.names(data.bridge.elements), priors.absence.tolist(), strict=True))
    m = told.target.size
    front, rear = (
        fusion.Axle(**axle._asdict()) for axle in found.problem.mismatch.shapes.footprints
    )
    return fusion.FusionLikelihood(
        bridge=_coordinates(told.bridge, absence),
        truck=_coordinates(told.truck, {}),
        root=_rounded(told.root[np.triu_indices(m)]),
        target=_rounded(told.target),
        element_lengths_m=tuple(data.bridge.lengths_m),
        mass_spread=data.vehicle.spread("total_mass_kg"),
        footprints=(front, rear),
        first_knot_m=float(told.knots_m[0]) if told.knots_m.size else None,
        knot_spacing_m=of_crossing.knot_spacing_m(found.problem.mismatch),
        level_m3=_rounded(told.level_m3),
        off_bridge_m=_stretches(told.off_bridge),
        bends=_stored_bends(told.bends),
    )


def _stored_bends(of: Bends | None) -> fusion.Bends | None:
    if of is None:
        return None
    shapes = tuple(float(f"{value:.{_DIGITS_OF_BENDS}e}") for value in of.shapes.ravel())
    return fusion.Bends(about=_rounded(of.about), size=_rounded(of.size), shapes=shapes)


def _rounded(values: Floats) -> tuple[float, ...]:
    return tuple(float(f"{value:.{_DIGITS}e}") for value in values)


def _coordinates(
    of: of_crossing.Coordinates, absence: dict[str, float]
) -> tuple[fusion.Coordinate, ...]:
    return tuple(
        fusion.Coordinate(
            name=name,
            location=float(location),
            scale=float(scale),
            is_log=bool(is_log),
            absence=absence.get(name, 0.0),
        )
        for name, location, scale, is_log in zip(*of, strict=True)
    )


def _stretches(off: of_crossing.OffBridge | None) -> tuple[fusion.Stretch, ...]:
    """Values that are there, as stretches without holes."""
    if off is None:
        return ()
    step = of_crossing.OFF_BRIDGE_STEP_M
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
    """A bridge by crossings, of which the last says what the bridge's unknowns are.

    ValueError without crossings.
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
    compared = compare_trucks(parts, priors)
    parts = [part for part in parts if part.name not in compared.strangers]
    report("putting crossings together", _COMPARED)
    joint = join(parts, priors)
    judged = judge(parts, joint, priors)
    if judged.left_out:
        parts = [part for part in parts if part.name in judged.agree]
        joint = join(parts, priors)

    def drawing(stage: str, fraction: float) -> None:
        report(stage, _JOINED + (1.0 - _JOINED) * fraction)

    found = fuse_joined(joint, priors, _DRAWS_PER_CHAIN, _SEED, drawing, threads)
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
        judged.agree,
        tuple(sorted([*compared.strangers, *judged.left_out])),
        tuple(one.crossing_id for one in others),
        compared.disagree or judged.disagree,
    )


def part_of(source: Source) -> tuple[Part, BridgePriors]:
    """A crossing as fusion takes it, in its own coordinates."""
    priors = _priors(source.likelihood)
    return _part(source, priors.coordinates), priors


def _tracks(found: Fused, vehicles: Mapping[str, str]) -> tuple[Track, ...]:
    """What runs share; `vehicles` are the trucks' names by their keys in the fusion."""
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
    """Whether they are about the same unknowns of a bridge."""

    def what(of: fusion.FusionLikelihood) -> object:
        names = tuple((c.name, c.is_log) for c in of.bridge)
        return names, of.element_lengths_m

    return what(one) == what(other)


def _priors(of: fusion.FusionLikelihood) -> BridgePriors:
    elements = len(of.element_lengths_m)
    names = unknowns.names(elements)
    power = dict(zip(names, unknowns.mass_powers(elements).tolist(), strict=True))
    return BridgePriors(
        _from_stored(of.bridge),
        np.array([power[c.name] for c in of.bridge]),
        log_odds(np.array([c.absence for c in of.bridge])),
        elements,
    )


def _from_stored(coordinates: Sequence[fusion.Coordinate]) -> of_crossing.Coordinates:
    return of_crossing.Coordinates(
        tuple(c.name for c in coordinates),
        np.array([c.location for c in coordinates]),
        np.array([c.scale for c in coordinates]),
        np.array([c.is_log for c in coordinates], dtype=np.bool_),
    )


def _part(source: Source, coordinates: of_crossing.Coordinates) -> Part:
    of = source.likelihood
    m = len(of.target)
    root = np.zeros((m, m))
    root[np.triu_indices(m)] = of.root
    told = of_crossing.Likelihood(
        root,
        np.array(of.target),
        _from_stored(of.bridge),
        _from_stored(of.truck),
        _knots(of, m),
        np.array(of.level_m3),
        _off_bridge(of),
        _bends(of),
    )
    told = of_crossing.in_coordinates(told, coordinates, len(of.element_lengths_m))
    # Of a truck whose site file has changed nobody knows whether it is the same.
    key = [[c.name, c.location, c.scale] for c in of.truck]
    truck = f"{source.vehicle} {key} {of.footprints} {of.mass_spread}"
    front, rear = (Footprint(**axle.model_dump()) for axle in of.footprints)
    return Part(source.crossing_id, told, truck, source.direction, (front, rear), of.mass_spread)


def _knots(of: fusion.FusionLikelihood, m: int) -> Floats:
    if of.first_knot_m is None:
        return np.zeros(0)
    bends = _bends(of)
    count = m - len(of.bridge) - len(of.truck)
    if bends is not None:
        count -= 1 + bends.shapes.shape[0]
    return of.first_knot_m + of.knot_spacing_m * np.arange(count, dtype=np.float64)


def _bends(of: fusion.FusionLikelihood) -> Bends | None:
    if of.bends is None:
        return None
    moves = len(of.bends.size)
    shapes = np.array(of.bends.shapes).reshape(-1, moves * (moves + 1) // 2)
    return Bends(np.array(of.bends.about), np.array(of.bends.size), shapes)


def _off_bridge(of: fusion.FusionLikelihood) -> of_crossing.OffBridge | None:
    if not of.off_bridge_m:
        return None
    step = of_crossing.OFF_BRIDGE_STEP_M
    begin = min(one.begin_m for one in of.off_bridge_m)
    end = max(one.begin_m + step * len(one.values) for one in of.off_bridge_m)
    values = np.full(round((end - begin) / step), np.nan)
    for one in of.off_bridge_m:
        first = round((one.begin_m - begin) / step)
        values[first : first + len(one.values)] = one.values
    return of_crossing.OffBridge(begin, values)
