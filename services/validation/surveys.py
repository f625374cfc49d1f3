"""Are the intervals of a bridge true that was crossed many times?

Whole surveys are drawn and driven: the truck or trucks, the bridge, the sensors' errors and the
road are the same in all crossings of a survey; noise, receiver, speed (up to 15 % to either side),
the truck's place across the lane and what changes the bridge are not. Truth is drawn as in
`services.simulation.drawn`. Each crossing is identified by itself, as from a recording, then all
of a survey are fused, as a worker does.

Records are kept as in `services.validation.worlds`: what is in the file is not driven again.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.physics.bridge import Beam
from schemas.results import BridgeResult, Crossing
from schemas.settings import IdentificationSettings
from schemas.site import Site, Vehicle
from services.common.progress import Steps, unwatched_steps
from services.identification.bridge_state import Counted, count_in, state_of, usable
from services.simulation.drawn import Truth, draw_truth, drive, see
from services.simulation.drive import declared, ratios_of
from services.simulation.wheel_paths import OnSurface, wheel_paths_of
from services.simulation.worlds import draw_world
from services.validation.calibration import Check, Record
from services.validation.worlds import completed, identity_of, read_records

Floats = NDArray[np.float64]

SPEED_M_PER_S, _FASTER = 10.0, 0.15
_RATE_HZ = 500.0
_BODY_NOISE_UG = 10.0
"""Of the sensors on the body, where everything is to happen."""
_FEWEST = 15
"""Surveys of a kind whose coverage is an aim in full."""
_LORRY_KG, _EMPTY_KG, _LOADED_KG = 16_300.0, 7_300.0, 24_000.0
_LEVEL_SPREAD = 0.15
"""Of ln EI common to all elements of a scenario: a nominal value is a guess."""


class Kind(NamedTuple):
    """What a survey is like."""

    crossings: int
    changes: float = 0.0
    """Relative standard deviation of EI from crossing to crossing; common to all elements in every
    other survey, each element's own in the others."""
    tyres: str | None = None
    """Behind, on a road that is a surface; None: both axles feel one groove."""
    offset_m: float = 0.005
    wander_m: float = 0.12
    masses_kg: tuple[float | None, ...] = (None,)
    """Of the trucks that take turns; None: the site's."""
    both_ways: bool = False
    elements: int | None = None
    everything: bool = False
    """Springs that rub, bearings that give, damped tyres, a lorry that has just left."""
    scenario: int | None = None
    """EI is that of this scenario of the paper, all elements at one level that is drawn; None: each
    element's is drawn."""
    noise_ug_per_rthz: float = 25.0


KINDS = {
    "steady": Kind(16),
    "changing-2": Kind(16, 0.02),
    "changing-5": Kind(16, 0.05),
    "twin": Kind(12, tyres="twin", masses_kg=(_LORRY_KG,)),
    "single-5": Kind(12, tyres="single", masses_kg=(_LORRY_KG,)),
    "single-10": Kind(8, tyres="single", offset_m=0.01, masses_kg=(_LORRY_KG,)),
    "loaded-and-empty": Kind(16, tyres="twin", masses_kg=(_LOADED_KG, _EMPTY_KG)),
    "two-trucks": Kind(12, tyres="twin", masses_kg=(_LORRY_KG, 12_000.0)),
    "both-ways": Kind(12, tyres="twin", masses_kg=(_LORRY_KG,), both_ways=True),
    "five-elements": Kind(12, tyres="twin", masses_kg=(_LORRY_KG,), elements=5),
    "three-elements": Kind(12, tyres="twin", masses_kg=(_LORRY_KG,), elements=3),
    "everything": Kind(16, tyres="twin", masses_kg=(_LORRY_KG,), everything=True),
    "scenario-1": Kind(16, scenario=1, noise_ug_per_rthz=100.0),
    "scenario-4": Kind(16, scenario=4, noise_ug_per_rthz=100.0),
    "scenario-10": Kind(16, scenario=10, noise_ug_per_rthz=100.0),
    "scenario-5": Kind(16, scenario=5, noise_ug_per_rthz=100.0),
    "scenario-11": Kind(16, scenario=11, noise_ug_per_rthz=100.0),
}


def one_crossing(
    site: Site, kind: str, survey: int, number: int, settings: IdentificationSettings
) -> Record:
    """Draw, drive and identify one crossing of a survey."""
    of = KINDS[kind]
    truck = number % len(of.masses_kg)
    site = _site_of(site, of, truck)
    truth, seed = _truth(site, of, survey, number, truck)
    drawn = drive(site, truth, seed)
    found = see([drawn.run], drawn.site, settings)
    crossing = None
    if len(found) == 1:
        # All are driven at the same moment; results of one survey have names of their own.
        crossing = found[0].result.model_copy(
            update={
                "crossing_id": f"{kind}-{survey}-{number:02d}",
                "entry_time": found[0].result.entry_time + 600.0 * number,
                "exit_time": found[0].result.exit_time + 600.0 * number,
                "road": None,
                "covariance": None,
            }
        )
    return {
        "identity": identity_of(site, settings),
        "effect": kind,
        "seed": survey,
        "number": number,
        "verdict": None if crossing is None else crossing.verdict,
        "truth": _survey_truth(site, of, survey).tolist(),
        "result": None if crossing is None else crossing.model_dump(mode="json"),
    }


def _site_of(site: Site, kind: Kind, truck: int) -> Site:
    """The owner's site file for a truck of a survey."""
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    mass = kind.masses_kg[truck]
    if mass is not None:
        vehicle = _of_mass(vehicle, mass).model_copy(update={"id": f"truck-{truck}"})
    if kind.elements is not None:
        bridge = bridge.model_copy(update={"elements": kind.elements})
    return site.model_copy(update={"vehicles": (vehicle,), "bridges": (bridge,)})


def sites_of(site: Site, kind: Kind) -> list[Site]:
    """What the owner declares of each truck of a survey, and of its sensors."""
    axles = kind.noise_ug_per_rthz
    body = _BODY_NOISE_UG if kind.everything else axles
    return [
        declared(_site_of(site, kind, truck), (body, body, axles, axles), _RATE_HZ)
        for truck in range(len(kind.masses_kg))
    ]


def _of_mass(vehicle: Vehicle, mass: float) -> Vehicle:
    """A lorry of this mass, sprung for it; its rear axle carries three fifths."""
    ratio = mass / vehicle.total_mass_kg

    def scaled(pair: tuple[float, float], power: float) -> tuple[float, float]:
        return pair[0] * ratio**power, pair[1] * ratio**power

    return vehicle.model_copy(
        update={
            "total_mass_kg": mass,
            "front_axle_to_cg_m": 0.6 * vehicle.wheelbase_m,
            "suspension_stiffness_n_per_m": scaled(vehicle.suspension_stiffness_n_per_m, 0.8),
            "suspension_damping_ns_per_m": scaled(vehicle.suspension_damping_ns_per_m, 0.8),
            "tyre_stiffness_n_per_m": scaled(vehicle.tyre_stiffness_n_per_m, 0.5),
            "unsprung_mass_kg": scaled(vehicle.unsprung_mass_kg, 0.5),
        }
    )


def _truth(site: Site, kind: Kind, survey: int, number: int, truck: int) -> tuple[Truth, int]:
    """What is behind a crossing, and the seed of its noise."""
    same = draw_truth(site, 1000 * survey + truck)
    rng = np.random.default_rng(np.random.SeedSequence([survey, number, 0x5E7]))
    bridge = _bridge(site, kind, survey)
    car, left = same.car, None
    if kind.everything:
        world = draw_world(site, "everything", 1000 * survey)
        car, left = world.truth.car, world.truth.left
        bridge = world.truth.beam._replace(
            flexural_rigidity_nm2=bridge.flexural_rigidity_nm2,
            element_lengths_m=bridge.element_lengths_m,
            mass_per_length_kg_per_m=bridge.mass_per_length_kg_per_m,
            interior_supports=bridge.interior_supports,
            support_rotational_stiffness_nm_per_rad=(0.0, 0.0),
        )
    change = kind.changes * (
        rng.standard_normal() * np.ones_like(bridge.flexural_rigidity_nm2)
        if survey % 2
        else rng.standard_normal(bridge.flexural_rigidity_nm2.size)
    )
    speed = SPEED_M_PER_S * (1.0 + _FASTER * (2.0 * rng.uniform() - 1.0))
    conditions = same.conditions._replace(
        road_class="A",
        road_seed=survey,
        speed_m_per_s=float(speed),
        change_m_per_s=0.05,
        forward=number % 2 == 0 or not kind.both_ways,
        rate_hz=_RATE_HZ,
        fix_rate_hz=10.0,
        noise_ug_per_rthz=kind.noise_ug_per_rthz,
        body_noise_ug_per_rthz=_BODY_NOISE_UG if kind.everything else None,
    )
    paths = None
    if kind.tyres is not None:
        asked = OnSurface(kind.tyres, kind.offset_m, kind.wander_m)
        paths = wheel_paths_of(site.vehicles[0], asked)
    beam = bridge._replace(flexural_rigidity_nm2=bridge.flexural_rigidity_nm2 * np.exp(change))
    truth = same._replace(car=car, beam=beam, conditions=conditions, left=left, paths=paths)
    return truth, 100_000 * survey + number


def _survey_truth(site: Site, kind: Kind, survey: int) -> Floats:
    """EI (n,) of the bridge about which it changes."""
    return np.asarray(_bridge(site, kind, survey).flexural_rigidity_nm2)


def _bridge(site: Site, kind: Kind, survey: int) -> Beam:
    """The bridge about which it changes."""
    drawn = draw_truth(site, 1000 * survey).beam
    if kind.scenario is None:
        return drawn
    rng = np.random.default_rng(np.random.SeedSequence([survey, 0x1E7E1]))
    level = np.exp(_LEVEL_SPREAD * rng.standard_normal())
    nominal = np.array(site.bridges[0].nominal_flexural_rigidity_nm2)
    ratios = ratios_of(site.bridges[0], kind.scenario, None)
    return drawn._replace(flexural_rigidity_nm2=level * nominal * ratios)


def run_surveys(
    site: Site,
    kinds: Sequence[str],
    surveys: int,
    path: Path,
    processes: int,
    progress: Callable[[int, int], None] = lambda done, jobs: None,
) -> list[Record]:
    """The crossings of so many surveys of each kind; those that `path` lacks are driven."""
    settings = IdentificationSettings(method="pre", threads=1)
    wanted = [
        (kind, survey, number)
        for survey in range(surveys)
        for kind in kinds
        for number in range(KINDS[kind].crossings)
    ]
    identities = {
        (kind, truck): identity_of(_site_of(site, KINDS[kind], truck), settings)
        for kind in kinds
        for truck in range(len(KINDS[kind].masses_kg))
    }

    def is_ours(line: Record) -> bool:
        if line["effect"] not in kinds or "number" not in line:
            return False
        truck = line["number"] % len(KINDS[line["effect"]].masses_kg)
        return bool(line.get("identity") == identities[line["effect"], truck])

    known = {
        (line["effect"], line["seed"], line["number"]): line
        for line in read_records(path)
        if is_ours(line)
    }
    return completed(
        path,
        wanted,
        known,
        lambda line: (line["effect"], line["seed"], line["number"]),
        lambda key: partial(one_crossing, site, *key, settings),
        processes,
        progress,
    )


def by_survey(records: Iterable[Record]) -> dict[tuple[str, int], list[Record]]:
    """Records by kind and number of the survey, in the order in which they were driven."""
    surveys: dict[tuple[str, int], list[Record]] = {}
    for line in records:
        surveys.setdefault((line["effect"], line["seed"]), []).append(line)
    return {key: sorted(lines, key=lambda line: line["number"]) for key, lines in surveys.items()}


class Fused(NamedTuple):
    """A survey's estimate beside the truth."""

    kind: str
    survey: int
    truth: Floats
    """(n,) EI in N·m²."""
    z: Floats
    """(n,) errors of ln EI over their standard deviations, read off the intervals."""
    inside: NDArray[np.bool_]
    std: Floats
    """(n,) of ln EI."""
    level_std: float
    spread_inside: bool
    used: int
    out: int
    verdict: str


def fused_surveys(
    records: Iterable[Record], crossings: int | None = None, progress: Steps = unwatched_steps
) -> list[Fused]:
    """Each survey of which all crossings are there, fused; the first `crossings` of them alone."""
    found = []
    surveys = by_survey(records)
    for number, ((kind, survey), lines) in enumerate(surveys.items()):
        progress(number, len(surveys))
        results = [
            Crossing.model_validate(line["result"])
            for line in lines[:crossings]
            if line["result"] is not None
        ]
        counted = count_in(Counted(), [one for one in map(usable, results) if one is not None])
        state = state_of(counted, "bridge")
        if state is None or not state.elements:
            continue
        found.append(_beside(kind, survey, np.array(lines[0]["truth"]), state))
    return found


def _beside(kind: str, survey: int, truth: Floats, state: BridgeResult) -> Fused:
    table = np.array([(e.mean, e.std, e.q025, e.q975) for e in state.elements.values()])
    mean, std, low, high = table.T
    # Of a log-normal with this mean and standard deviation.
    spread = np.sqrt(np.log1p((std / mean) ** 2))
    z = (np.log(mean) - 0.5 * spread**2 - np.log(truth)) / spread
    assert state.level is not None  # noqa: S101 - it was fused
    level = state.level
    low_tau, high_tau = state.between_crossing_std_q025, state.between_crossing_std_q975
    changes = KINDS[kind].changes
    inside = low_tau is not None and high_tau is not None and low_tau <= changes <= high_tau
    return Fused(
        kind,
        survey,
        truth,
        z,
        (low <= truth) & (truth <= high),
        spread,
        level.std / level.mean,
        bool(inside),
        len(state.crossings_used),
        state.crossings_left_out_count,
        state.verdict or "",
    )


class Forecast(NamedTuple):
    """What was to be expected of a kind before it was driven: medians of standard deviations."""

    element: float
    level: float


HEADINGS = (
    "survey",
    "n",
    "used",
    "covered",
    "rms z",
    "max z",
    "element",
    "plan",
    "level",
    "plan",
    "spread",
)


def rows(found: Sequence[Fused], forecasts: Mapping[str, Forecast]) -> list[list[str]]:
    """A row of the table for each kind under HEADINGS."""
    out = []
    for kind in dict.fromkeys(one.kind for one in found):
        some = [one for one in found if one.kind == kind]
        forecast = forecasts.get(kind)
        element, level = ("–", "–") if forecast is None else map(_percent, forecast)
        z = np.concatenate([one.z for one in some])
        out.append(
            [
                kind,
                str(len(some)),
                f"{np.mean([one.used for one in some]):.1f}",
                f"{100.0 * np.mean(np.concatenate([one.inside for one in some])):.1f} %",
                f"{np.sqrt(np.mean(z**2)):.2f}",
                f"{np.abs(z).max():.1f}",
                _percent(float(np.median(np.concatenate([one.std for one in some])))),
                element,
                _percent(float(np.median([one.level_std for one in some]))),
                level,
                f"{100.0 * np.mean([one.spread_inside for one in some]):.0f} %",
            ]
        )
    return out


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def survey_checks(found: Sequence[Fused]) -> list[Check]:
    """The aims: true intervals, and no element far off."""
    checks = []
    for kind in dict.fromkeys(one.kind for one in found):
        some = [one for one in found if one.kind == kind]
        z = np.concatenate([one.z for one in some])
        covered = float(np.mean(np.concatenate([one.inside for one in some])))
        few = len(some) < _FEWEST
        checks.append(Check(f"{kind}: coverage", covered, 0.85 if few else 0.92, 1.0))
        checks.append(Check(f"{kind}: largest |z|", float(np.abs(z).max()), 0.0, 4.0))
    return checks
