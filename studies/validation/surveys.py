"""Calibration of fused intervals on simulated surveys.

Trucks, bridge, sensor errors and road are constant over the crossings of a survey; noise, receiver,
speed (up to 15 % to either side), lateral position and the changes of the bridge are not. The truth
is drawn as in `services.simulation.drawn`. Each crossing is identified by itself, as from a
recording, then all of a survey are fused, as in a worker.

Records are stored as in `studies.validation.misspecification`: existing ones are not simulated
again.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.physics.bridge import Beam
from schemas.results import BridgeResult, CrossingResult
from schemas.settings import IdentificationSettings
from schemas.site import Bridge, Site, Vehicle
from schemas.validation_records import LIKELIHOOD_EDITION
from services.common.arrays import Floats
from services.common.progress import Steps, no_step_progress
from services.drives.runs import Run
from services.finding.placed import middle_site
from services.identification.bridge_state import RecentCrossings, add_crossings, state_of, usable
from services.simulation.drawn import CrossingTruth, draw_truth, drive, identify_simulated
from services.simulation.drawn_tandem import TandemEffects, drawn_tandem
from services.simulation.drive import declared_site, ratios_of
from services.simulation.pavement import Pavement
from services.simulation.survey_kinds import KINDS, SurveyKind
from services.simulation.usual_trucks import usual_tandem
from services.simulation.wheel_paths import SurfaceOptions, wheel_paths_of
from studies.simulation.out_of_model import draw_out_of_model
from studies.validation.calibration import Record, StudyTarget
from studies.validation.misspecification import completed, identity_of, read_records

SPEED_M_PER_S, _FASTER = 10.0, 0.15
_RATE_HZ = 500.0
_BODY_NOISE_UG = 10.0
"""Noise density of the sensors on the body, where everything should be observable."""
_FEWEST = 15
"""Fewest surveys of a kind whose coverage is a target in full."""
_LEVEL_SPREAD = 0.15
"""Spread of ln EI common to all elements of a scenario: a nominal value is a guess."""


def one_crossing(
    site: Site, kind: str, survey: int, number: int, settings: IdentificationSettings
) -> Record:
    """Simulate and identify one crossing of a survey."""
    of = KINDS[kind]
    truck = number % len(of.masses_kg)
    site = site_of_truck(site, of, truck)
    run, declared = _driven(site, of, survey, number, truck)
    found = identify_simulated([run], declared, settings)
    crossing = None
    if len(found) == 1:
        # All are simulated at the same time; results of one survey have names of their own.
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
        "identity": survey_identity(site, settings),
        "effect": kind,
        "seed": survey,
        "number": number,
        "verdict": None if crossing is None else crossing.verdict,
        "truth": _survey_truth(site, of, survey).tolist(),
        "result": None if crossing is None else crossing.model_dump(mode="json"),
    }


def survey_identity(site: Site, settings: IdentificationSettings) -> str:
    """Return what the crossings of a survey depend on, with their likelihoods for fusion."""
    return f"{identity_of(site, settings)} {LIKELIHOOD_EDITION}"


def _driven(site: Site, of: SurveyKind, survey: int, number: int, truck: int) -> tuple[Run, Site]:
    """Return the recorded run of a crossing, and the site that declares its sensors."""
    truth, seed = crossing_truth(site, of, survey, number, truck)
    if site.vehicles[0].tandem is not None:
        effects = TandemEffects(of.friction_share, of.offset_m, wander_m=of.wander_m)
        return drawn_tandem(site, truth, seed, 1000 * survey + truck, effects).recorded
    one = drive(site, truth, seed)
    return one.run, one.site


def site_of_truck(site: Site, kind: SurveyKind, truck: int) -> Site:
    """Return the owner's site file for a truck of a survey."""
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    mass = kind.masses_kg[truck]
    if mass is None and kind.has_tandem:
        vehicle = usual_tandem(kind.noise_ug_per_rthz)
    if mass is not None:
        vehicle = _of_mass(vehicle, mass).model_copy(update={"id": f"truck-{truck}"})
    if kind.elements is not None:
        bridge = bridge.model_copy(update={"elements": kind.elements})
    return site.model_copy(update={"vehicles": (vehicle,), "bridges": (bridge,)})


def sites_of(site: Site, kind: SurveyKind) -> list[Site]:
    """Return the declared sites of each truck of a survey, with its sensors."""
    axles = kind.noise_ug_per_rthz
    body = _BODY_NOISE_UG if kind.everything else axles
    of_trucks = [site_of_truck(site, kind, truck) for truck in range(len(kind.masses_kg))]
    return [
        declared_site(one, (body, body, axles, axles), _RATE_HZ)
        if one.vehicles[0].tandem is None
        else middle_site(one)
        for one in of_trucks
    ]


def _of_mass(vehicle: Vehicle, mass: float) -> Vehicle:
    """Return a truck of this mass, with springs for it; its rear axle carries three fifths."""
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


def crossing_truth(
    site: Site, kind: SurveyKind, survey: int, number: int, truck: int
) -> tuple[CrossingTruth, int]:
    """Return the truth of a crossing, and the seed of its noise."""
    same = draw_truth(site, 1000 * survey + truck)
    rng = np.random.default_rng(np.random.SeedSequence([survey, number, 0x5E7]))
    bridge = _bridge(site, kind, survey)
    car, departed = same.car, None
    if kind.everything:
        case = draw_out_of_model(site, "everything", 1000 * survey)
        car, departed = case.truth.car, case.truth.departed
        bridge = case.truth.beam._replace(
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
    if kind.tyres is not None and site.vehicles[0].tandem is None:
        pavement = Pavement(kind.deck_roughness, kind.largest_joint_m, kind.anisotropy)
        asked = SurfaceOptions(kind.tyres, kind.offset_m, kind.wander_m, pavement)
        paths = wheel_paths_of(site.vehicles[0], asked)
    beam = bridge._replace(flexural_rigidity_nm2=bridge.flexural_rigidity_nm2 * np.exp(change))
    truth = same._replace(car=car, beam=beam, conditions=conditions, departed=departed, paths=paths)
    return truth, 100_000 * survey + number


def _survey_truth(site: Site, kind: SurveyKind, survey: int) -> Floats:
    """Return the mean EI (n,) of the changing bridge."""
    return np.asarray(_bridge(site, kind, survey).flexural_rigidity_nm2)


def _bridge(site: Site, kind: SurveyKind, survey: int) -> Beam:
    """Return the mean of the changing bridge."""
    drawn = draw_truth(site, 1000 * survey).beam
    ratios = weak_ratios(site.bridges[0], kind)
    if ratios is None:
        return drawn
    rng = np.random.default_rng(np.random.SeedSequence([survey, 0x1E7E1]))
    level = np.exp(_LEVEL_SPREAD * rng.standard_normal())
    nominal = np.array(site.bridges[0].nominal_flexural_rigidity_nm2)
    return drawn._replace(flexural_rigidity_nm2=level * nominal * ratios)


def weak_ratios(bridge: Bridge, kind: SurveyKind) -> Floats | None:
    """Return EI (n,) over its level in a kind of survey with weak elements; None: EI is drawn."""
    if kind.scenario is None and kind.ei_ratios is None:
        return None
    return ratios_of(bridge, kind.scenario, kind.ei_ratios)


def run_surveys(
    site: Site,
    kinds: Sequence[str],
    surveys: int,
    path: Path,
    processes: int,
    progress: Steps = no_step_progress,
) -> list[Record]:
    """Return crossings of some surveys of each kind; simulate those that `path` lacks."""
    settings = IdentificationSettings(method="pre", threads=1)
    wanted = [
        (kind, survey, number)
        for survey in range(surveys)
        for kind in kinds
        for number in range(KINDS[kind].crossings)
    ]
    identities = {
        (kind, truck): survey_identity(site_of_truck(site, KINDS[kind], truck), settings)
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
    """Return records by kind and number of the survey, in the order of simulation."""
    surveys: dict[tuple[str, int], list[Record]] = {}
    for line in records:
        surveys.setdefault((line["effect"], line["seed"]), []).append(line)
    return {key: sorted(lines, key=lambda line: line["number"]) for key, lines in surveys.items()}


class FusedSurvey(NamedTuple):
    """A survey's estimate with the truth."""

    kind: str
    survey: int
    truth: Floats
    """True EI (n,) in N·m²."""
    z: Floats
    """Errors of ln EI (n,) over their standard deviations, from the intervals."""
    inside: NDArray[np.bool_]
    std: Floats
    """Standard deviations of ln EI (n,)."""
    level_std: float
    spread_inside: bool
    used: int
    out: int
    verdict: str


def fused_surveys(
    records: Iterable[Record], crossings: int | None = None, progress: Steps = no_step_progress
) -> list[FusedSurvey]:
    """Return each complete survey, fused; with `crossings` only the first ones of each."""
    found = []
    surveys = by_survey(records)
    for number, ((kind, survey), lines) in enumerate(surveys.items()):
        progress(number, len(surveys))
        results = [
            CrossingResult.model_validate(line["result"])
            for line in lines[:crossings]
            if line["result"] is not None
        ]
        counted = add_crossings(
            RecentCrossings(), [one for one in map(usable, results) if one is not None]
        )
        state = state_of(counted, "bridge")
        if state is None or not state.elements:
            continue
        found.append(_beside(kind, survey, np.array(lines[0]["truth"]), state))
    return found


def _beside(kind: str, survey: int, truth: Floats, state: BridgeResult) -> FusedSurvey:
    table = np.array([(e.mean, e.std, e.q025, e.q975) for e in state.elements.values()])
    mean, std, low, high = table.T
    # Parameters of a log-normal with this mean and standard deviation.
    spread = np.sqrt(np.log1p((std / mean) ** 2))
    z = (np.log(mean) - 0.5 * spread**2 - np.log(truth)) / spread
    assert state.level is not None  # noqa: S101 - it was fused
    level = state.level
    low_tau, high_tau = state.between_crossing_std_q025, state.between_crossing_std_q975
    changes = KINDS[kind].changes
    inside = low_tau is not None and high_tau is not None and low_tau <= changes <= high_tau
    return FusedSurvey(
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
    """Forecast of a kind of survey: medians of standard deviations."""

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


def rows(found: Sequence[FusedSurvey], forecasts: Mapping[str, Forecast]) -> list[list[str]]:
    """Return a row of the table for each kind under HEADINGS."""
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


def survey_checks(found: Sequence[FusedSurvey]) -> list[StudyTarget]:
    """Return the targets: calibrated intervals, and no element with a large error."""
    checks = []
    for kind in dict.fromkeys(one.kind for one in found):
        some = [one for one in found if one.kind == kind]
        z = np.concatenate([one.z for one in some])
        covered = float(np.mean(np.concatenate([one.inside for one in some])))
        few = len(some) < _FEWEST
        checks.append(StudyTarget(f"{kind}: coverage", covered, 0.85 if few else 0.92, 1.0))
        checks.append(StudyTarget(f"{kind}: largest |z|", float(np.abs(z).max()), 0.0, 4.0))
    return checks
