"""A fleet whose crossings are drawn from the method's own statistics, not driven.

    python -m tests.fleet RESULTS.json …

writes the likelihoods of identified crossings to tests/data/fleet_likelihoods.json. A crossing of
the fleet is one of them with another truth: -|R x - z|²/2 is its likelihood, so with x the truth
and unit noise z = R x + noise. x has the bridge's EI on that day, what its truck is (the same in
all its crossings), and the error of the truck's mass. Nothing is integrated and nothing searched:
that takes seconds a crossing, and tests/numerics and docs/fusion.md say how true the likelihoods
are.
"""

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pre_core.fusion.mass import mass_sensitivity
from schemas.fusion import FusionLikelihood
from schemas.results import CrossingResult, Parameter, ResultHeader, Results, load_results, results
from services.common.arrays import Floats
from services.identification.fusing import fusion_input
from services.identification.observed import observation_of
from services.identification.usable import Source

STORED = Path(__file__).parent / "data" / "fleet_likelihoods.json"
DAY_S = 86_400.0
WEEK_S = 7.0 * DAY_S
HEADER = ResultHeader("0.1.0", 0.0, "0" * 64, {}, 1)


class Template(NamedTuple):
    """Information of an identified crossing, whatever bridge it is of."""

    likelihood: FusionLikelihood
    direction: str
    root: Floats  # (m, m)


class Truck(NamedTuple):
    """What a truck is beside what its site file says, in standard deviations of the priors."""

    name: str
    unknowns: Floats
    mass: float


class Bridge(NamedTuple):
    """A bridge's truth."""

    name: str
    realm: str
    ei_nm2: Floats  # (n,) at 10 °C
    slope_per_k: float
    others: Floats
    """Its other unknowns, in standard deviations."""


def templates() -> list[Template]:
    """Those that are stored."""
    found = []
    for outcome in json.loads(STORED.read_text()):
        likelihood = FusionLikelihood.model_validate(outcome["likelihood"])
        m = len(likelihood.target)
        root = np.zeros((m, m))
        root[np.triu_indices(m)] = likelihood.root
        found.append(Template(likelihood, outcome["direction"], root))
    return found


def trucks_of(rng: np.random.Generator, number: int) -> list[Truck]:
    """Trucks as the priors have them."""
    unknowns = len(templates()[0].likelihood.truck)
    return [
        Truck(f"truck-{n + 1}", rng.standard_normal(unknowns), float(rng.standard_normal()))
        for n in range(number)
    ]


def bridge_of(rng: np.random.Generator, name: str, realm: str = "sim-fleet") -> Bridge:
    """A sound bridge: each element by some per cent another than nominal."""
    of = templates()[0].likelihood
    elements = len(of.element_lengths_m)
    nominal = np.array([c.location for c in of.bridge[-elements:]])
    level = 0.1 * rng.standard_normal()
    ei = nominal * np.exp(level + 0.05 * rng.standard_normal(elements))
    others = rng.standard_normal(len(of.bridge) - elements)
    is_log = np.array([c.is_log for c in of.bridge[:-elements]])
    # Free bearings: what is half-normal and may be absent is absent.
    slope = -0.003 + 0.0005 * rng.standard_normal()
    return Bridge(name, realm, ei, float(slope), np.where(is_log, others, 0.0))


def crossing_of(
    rng: np.random.Generator,
    template: Template,
    truck: Truck,
    bridge: Bridge,
    entry_s: float,
    ei_nm2: Floats,
) -> CrossingResult:
    """A crossing of a bridge that has a rigidity at that time."""
    of = template.likelihood
    name = f"{truck.name}.{bridge.name}.{entry_s:.3f}"
    part, priors = fusion_input(Source(name, truck.name, 1, of))
    n, b = priors.elements, len(of.bridge)
    x = np.concatenate([bridge.others, priors.coordinates.location[b - n :] / ei_nm2])
    # The mass scales truck and bridge alike: what is found of the bridge lies aside of what it is.
    x = x + truck.mass * part.mass_spread * mass_sensitivity(priors, x)
    target = template.root @ np.concatenate([x, truck.unknowns])
    target = target + rng.standard_normal(target.size)
    likelihood = of.model_copy(update={"target": tuple(float(f"{v:.9e}") for v in target)})
    crossing = CrossingResult(
        crossing_id=name,
        realm=bridge.realm,
        vehicle=truck.name,
        bridge=bridge.name,
        direction=template.direction,  # type: ignore[arg-type]
        entry_time=entry_s,
        exit_time=entry_s + 4.0,
        speed_m_per_s=10.0,
        method="pre",
        verdict="good",
        chi2_per_dof=1.0,
        parameters=_parameters(dict(zip(_names(n), ei_nm2, strict=True)), 0.05),
        fusion_likelihood=likelihood,
    )
    found = observation_of(crossing)
    if found is None:  # twice as stiff or half, by its noise: then it has no information
        return crossing
    own = found.own + sum((s.loading @ s.loading.T for s in found.shared), np.zeros((n, n)))
    values = dict(zip(_names(n), np.exp(found.value), strict=True))
    return crossing.model_copy(update={"parameters": _parameters(values, np.sqrt(np.diag(own)))})


def results_of(crossings: list[CrossingResult], created_s: float) -> Results:
    """Crossings as a results file has them."""
    return results(HEADER._replace(created=created_s), crossings, {})


def losses_of(names: Mapping[str, int | None], begin_s: float, weeks: int) -> Results:
    """Two crossings a week of bridges by two trucks; a fifth of element 4 is lost in a week, or
    nothing (None)."""
    rng = np.random.default_rng(2)
    trucks, kinds, some = trucks_of(rng, 2), templates(), []
    for name, loses_at in names.items():
        bridge = bridge_of(rng, name)
        for week in range(weeks):
            ei = bridge.ei_nm2.copy()
            ei[3] *= 0.8 if loses_at is not None and week >= loses_at else 1.0
            for day in (1, 4):
                entry_s = begin_s + week * WEEK_S + day * DAY_S
                truck, kind = trucks[int(rng.integers(2))], kinds[int(rng.integers(3))]
                some.append(crossing_of(rng, kind, truck, bridge, entry_s, ei))
    return results_of(some, begin_s + weeks * WEEK_S)


def season_deg_c(time_s: float) -> float:
    """Coldest at the end of January, warmest half a year later."""
    return 11.0 - 11.0 * float(np.cos(2.0 * np.pi * (time_s / DAY_S - 25.0) / 365.25))


def _names(elements: int) -> list[str]:
    return [f"EI_{n + 1}" for n in range(elements)]


def _parameters(values: Mapping[str, float], spread: float | Floats) -> dict[str, Parameter]:
    spreads = np.broadcast_to(spread, (len(values),))
    return {
        name: Parameter(
            unit="N·m²",
            mean=float(value),
            std=float(value * s),
            q025=float(value * np.exp(-1.96 * s)),
            q50=float(value),
            q975=float(value * np.exp(1.96 * s)),
        )
        for (name, value), s in zip(values.items(), spreads, strict=True)
    }


def _stored(paths: list[Path]) -> Iterator[dict[str, object]]:
    for path in paths:
        for crossing in load_results(path).crossings:
            if crossing.fusion_likelihood is not None and crossing.verdict == "good":
                likelihood = crossing.fusion_likelihood.model_dump(mode="json")
                yield {"direction": crossing.direction, "likelihood": likelihood}


if __name__ == "__main__":
    STORED.write_text(json.dumps(list(_stored([Path(name) for name in sys.argv[1:]]))) + "\n")
