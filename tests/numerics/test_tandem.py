"""Trucks with a tandem: contact forces, residuals and noise against an independent simulation.

The truth is `services.simulation.two_sided`, which shares no physics, mesh or integrator with the
formulas tested here: a body that rolls, axles of two to four tyres, an equaliser, dry friction.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest

from pre_core.constants import MICRO_G_M_PER_S2, STANDARD_GRAVITY_M_PER_S2
from pre_core.crossing import front_axles, posterior
from pre_core.crossing.fit import Optimum
from pre_core.crossing.mismatch import (
    TRACK_SHAPES,
    BridgePavement,
    mismatch_spectra,
    tapered_periodogram,
)
from pre_core.crossing.noise import no_suspension_noise
from pre_core.crossing.off_bridge import _levels_off_bridge, mismatch_excess, off_bridge_residuals
from pre_core.crossing.pavement import estimate_pavement
from pre_core.crossing.posterior import ChainageFixes, PosteriorProblem, Priors
from pre_core.crossing.preparation import (
    CrossingInputs,
    build_problem,
    update_noise,
)
from pre_core.crossing.rows import RESIDUALS
from pre_core.crossing.tandem_friction import tandem_friction
from pre_core.fusion.likelihood import likelihood
from pre_core.parameters import (
    C_S1,
    C_U1,
    D_1,
    EI_1,
    K_S1,
    K_U1,
    KAPPA,
    M_U1,
    RHO_A,
    SHARE,
    names,
    table,
)
from pre_core.physics.surface import Footprint
from pre_core.physics.tandem import (
    NO_TANDEM,
    FrontAxles,
    TandemTruck,
    friction_transfer,
    shared_load,
)
from pre_core.physics.vehicle import masses_above_axles
from pre_core.search import levenberg_marquardt
from pre_core.search.loop import Termination
from services.simulation.two_sided import (
    WideBogie,
    WideTruck,
    axle_row,
    body_row,
    static_axle_loads_n,
    tyres_of,
)
from services.simulation.wide_crossings import (
    SatelliteErrors,
    WideCase,
    WideDrivenRun,
    drive_case,
)
from studies.simulation.tandem_cases import TandemOptions, draw_tandem

EXACT = SatelliteErrors(0.0, 0.0, 0.0)
DENSITY = 25.0 * MICRO_G_M_PER_S2


class Driven(NamedTuple):
    """A noise-free crossing of a drawn truck over one profile, and its case."""

    case: WideCase
    run: WideDrivenRun


@cache
def driven(friction: float = 0.08, equalised: bool = True, layout: str = "1+2") -> Driven:
    """Return a crossing over one profile; `layout`: axles ahead of the tandem, and in its bogie."""
    options = TandemOptions(friction_share=friction, equalised=equalised)
    return noise_free(options, is_one_road=True, layout=layout)


@cache
def driven_on_a_surface(layout: str = "1+2") -> Driven:
    """Return a noise-free crossing with both axles of the tandem in one strip, beside the front's.

    Front axles have single tyres and a wider track.
    """
    options = TandemOptions(friction_share=0.0, offset_m=0.0)
    return noise_free(options, is_one_road=False, layout=layout)


def noise_free(options: TandemOptions, *, is_one_road: bool, layout: str = "1+2") -> Driven:
    case = LAYOUTS[layout](draw_tandem(3, options))
    sensors = tuple(
        one._replace(gain_error=0.0, delay_s=0.0, bias_m_per_s2=0.0, noise_ug_per_rthz=0.0)
        for one in case.sensors
    )
    run = case.runs[0]._replace(lateral_m=0.0, change_m_per_s=0.3, forward=True)
    case = case._replace(sensors=sensors, runs=(run,), receiver=EXACT, is_one_road=is_one_road)
    return Driven(case, drive_case(case, 0))


def with_two_front_axles(case: WideCase) -> WideCase:
    """Return the case with another steered axle, half as stiff again, and a heavier body."""
    truck = case.truck
    front, *behind = truck.axles
    second = front._replace(
        position_m=1.9,
        mass_kg=1.1 * front.mass_kg,
        tyre_stiffness_n_per_m=0.9 * front.tyre_stiffness_n_per_m,
    )
    (bogie,) = truck.bogies
    shared = (WideBogie((2, 3), bogie.shares),)
    body = truck.bodies[0]._replace(
        mass_kg=1.25 * truck.bodies[0].mass_kg,
        cg_position_m=0.9 * truck.bodies[0].cg_position_m,
        pitch_inertia_kg_m2=1.3 * truck.bodies[0].pitch_inertia_kg_m2,
    )
    truck = truck._replace(axles=(front, second, *behind), bogies=shared, bodies=(body,))
    places = {"sprung_front": {"position_m": front_force_m(truck)}}
    return _with_sensors(case._replace(truck=truck), places, 1)


def _with_sensors(case: WideCase, places: dict[str, dict[str, Any]], later: int) -> WideCase:
    """Return the case with sensors at other places of the body, and on axles `later` by number."""
    return case._replace(
        sensors=tuple(
            one._replace(axle=one.axle + later if one.axle else 0, **places.get(one.channel, {}))
            for one in case.sensors
        )
    )


LAYOUTS = {
    "1+2": lambda case: case,
    "2+2": with_two_front_axles,
}
FRONT_AXLE = FrontAxles(*(np.array([value]) for value in (4.6, 700.0, 2e6, 0.0, 3e5, 2e4, 1.0)))


def front_shares(truck: WideTruck) -> np.ndarray:
    """Return the static shares of the front axles, all but the last two, in their spring force."""
    own = STANDARD_GRAVITY_M_PER_S2 * np.array([axle.mass_kg for axle in truck.axles])
    carried = (static_axle_loads_n(truck) - own)[:-2]
    return np.asarray(carried / carried.sum())


def front_force_m(truck: WideTruck) -> float:
    return float(front_shares(truck) @ [axle.position_m for axle in truck.axles[:-2]])


def tandem_truck_of(truck: WideTruck) -> TandemTruck:
    """Return the truck as the method knows it; the tandem is equalised if it has a bogie."""
    *ahead, first, second = truck.axles
    front_m = front_force_m(truck)
    return TandemTruck(
        first.position_m - front_m,
        round(0.5 * (first.position_m + second.position_m), 3) - front_m,
        FrontAxles(
            np.array([first.position_m - axle.position_m for axle in ahead]),
            np.array([axle.mass_kg for axle in ahead]),
            np.array([axle.tyre_stiffness_n_per_m for axle in ahead]),
            np.array([axle.tyre_damping_ns_per_m for axle in ahead]),
            np.array([axle.suspension_stiffness_n_per_m for axle in ahead]),
            np.array([axle.suspension_damping_ns_per_m for axle in ahead]),
            front_shares(truck),
        ),
        bool(truck.bogies),
    )


def static_share(truck: WideTruck) -> float:
    """Return the share of the first compared axle in the static spring forces of both."""
    own = STANDARD_GRAVITY_M_PER_S2 * np.array([axle.mass_kg for axle in truck.axles])
    first, second = (static_axle_loads_n(truck) - own)[-2:]
    return float(first / (first + second))


def gap_of(truck: WideTruck) -> float:
    return truck.axles[-1].position_m - truck.axles[-2].position_m


def theta_of(case: WideCase) -> np.ndarray:
    """Return the truth as a vector of parameters."""
    truck, deck = case.truck, case.deck
    body, known = truck.bodies[0], tandem_truck_of(truck)
    *ahead, first, second = truck.axles
    theta = np.zeros(len(names(len(deck.flexural_rigidity_nm2))))
    front_m = first.position_m - known.ahead_m
    theta[D_1] = d_1 = body.cg_position_m - front_m
    theta[SHARE] = static_share(truck)
    reach = d_1 * (known.readings_apart_m - d_1)
    theta[KAPPA] = body.pitch_inertia_kg_m2 / (body.mass_kg * reach)
    theta[K_S1] = sum(axle.suspension_stiffness_n_per_m for axle in ahead)
    theta[C_S1] = sum(axle.suspension_damping_ns_per_m for axle in ahead)
    behind = (first, second)
    theta[K_S1 + 1] = sum(axle.suspension_stiffness_n_per_m for axle in behind)
    theta[C_S1 + 1] = sum(axle.suspension_damping_ns_per_m for axle in behind)
    for w, axle in enumerate(behind):
        if not truck.bogies:
            theta[K_S1 + w] = axle.suspension_stiffness_n_per_m
            theta[C_S1 + w] = axle.suspension_damping_ns_per_m
        theta[M_U1 + w] = axle.mass_kg
        theta[K_U1 + w] = axle.tyre_stiffness_n_per_m
        theta[C_U1 + w] = axle.tyre_damping_ns_per_m
    theta[RHO_A : RHO_A + 3] = (
        deck.mass_per_length_kg_per_m,
        deck.rayleigh_alpha_per_s,
        deck.rayleigh_beta_s,
    )
    theta[EI_1:] = deck.flexural_rigidity_nm2
    return theta


def inputs_of(of: Driven, acceleration: np.ndarray | None = None) -> CrossingInputs:
    """Return the crossing with the truth as its nominal values and an exact receiver."""
    case, run = of.case, of.run.run
    truck, deck = case.truck, case.deck
    theta = theta_of(case)
    rows = table(len(deck.flexural_rigidity_nm2), len(truck.axles) - 1)
    at_zero = (theta == 0.0) & np.array([row.may_be_zero for row in rows])
    spread = np.where(at_zero, 1e-9, 0.1)
    estimated = theta > 0.0
    if truck.bogies:
        estimated &= ~np.isin(np.arange(theta.size), range(C_S1, K_S1 + 2))
    known, gap = tandem_truck_of(truck), gap_of(truck)
    response = of.run.response
    shift = of.run.entry_s - np.interp(0.0, response.position_m, response.time_s)
    time_s = run.accel_time_s
    fix_s = time_s[::10]
    first_m = truck.axles[-2].position_m
    position = np.interp(fix_s - shift, response.time_s, response.position_m) - first_m
    speed = np.interp(
        fix_s - shift, response.time_s, np.gradient(response.position_m, response.time_s)
    )
    step_s = 1.0 / run.rate_hz
    signals = np.stack(list(run.channels.values())) if acceleration is None else acceleration
    return CrossingInputs(
        signals,
        0.0,
        step_s,
        1,
        deck.span_m,
        np.full(len(deck.flexural_rigidity_nm2), deck.span_m / len(deck.flexural_rigidity_nm2)),
        (),
        truck.total_mass_kg,
        truck.bodies[0].cg_height_m,
        np.full(4, DENSITY),
        run.rate_hz,
        ChainageFixes(fix_s - time_s[0], position, speed, 1e-3, 1e-3, 1e-3),
        Priors(
            theta,
            spread,
            at_zero,
            estimated,
            np.zeros(theta.size),
            gap,
            1e-3,
            0.01,
            0.01,
            0.0005,
        ),
        3,
        1,
        (Footprint(), Footprint()),
        tandem=known,
        front_footprints=(Footprint(),) * known.front.share.size,
    )


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("friction", [0.0, 0.08])
def test_contact_forces_follow_from_inertia_alone(friction: float, layout: str) -> None:
    of = driven(friction, layout=layout)
    truck, response = of.case.truck, of.run.response
    theta, known, gap = theta_of(of.case), tandem_truck_of(truck), gap_of(truck)
    front_m = truck.axles[-2].position_m - known.ahead_m
    a_1, a_2 = (
        response.acceleration @ body_row(truck, front_m + place, 0.0)
        for place in (0.0, known.readings_apart_m)
    )
    on = shared_load(known, theta, truck.total_mass_kg, gap)
    speed = np.gradient(response.position_m, response.time_s)
    pull = np.gradient(speed, response.time_s)
    transfer = truck.total_mass_kg * truck.bodies[0].cg_height_m / on.lever_m * pull
    bogie = on.bogie_1 * a_1 + on.bogie_2 * a_2 + transfer
    front = on.front_1 * a_1 + on.front_2 * a_2 - transfer
    ahead, share = len(truck.axles) - 2, theta[SHARE]
    carried = (*(known.front.share * on.front_kg), share * on.bogie_kg, (1.0 - share) * on.bogie_kg)
    of_axle = tyres_of(truck).axle
    true, springs = [], []
    for i, axle in enumerate(truck.axles):
        own = axle.mass_kg * (response.acceleration @ axle_row(truck, i, 0.0))
        weight = STANDARD_GRAVITY_M_PER_S2 * (carried[i] + axle.mass_kg)
        true.append(response.contact_force_n[:, of_axle == i].sum(axis=1))
        springs.append(-true[i] - weight - own)
    # Several front axles have springs of their own; their sum alone follows from inertia.
    apart = np.array(springs[:ahead]) - np.outer(known.front.share, sum(springs[:ahead]))
    behind_m = known.ahead_m - known.front.ahead_m
    turned = behind_m @ apart / on.lever_m
    bogie = bogie - turned
    found = (front + turned, share * bogie, (1.0 - share) * bogie)
    within = slice(100, -100)
    for computed, spring in zip(found, (sum(springs[:ahead]), *springs[ahead:]), strict=True):
        moved = spring[within].std()
        assert moved > 1000.0
        np.testing.assert_allclose(computed[within], spring[within], atol=2e-3 * moved)


def test_bogie_at_the_second_reading_has_the_masses_of_a_half_car() -> None:
    theta = theta_of(driven().case)
    theta[SHARE] = 0.5
    known = TandemTruck(4.6, 5.275, FRONT_AXLE)
    on = shared_load(known, theta, 24800.0, 1.35)
    body_kg = 24800.0 - 700.0 - theta[M_U1] - theta[M_U1 + 1]
    m_11, m_22, m_12 = masses_above_axles(body_kg, theta[D_1], 5.275, theta[KAPPA])
    assert (on.front_1, on.front_2) == pytest.approx((m_11, m_12))
    assert (on.bogie_1, on.bogie_2) == pytest.approx((m_12, m_22))
    assert on.front_kg + on.bogie_kg == pytest.approx(body_kg)


# Friction of two front axles is no force that the model has.
@pytest.mark.parametrize(
    ("layout", "friction", "largest"), [("1+2", 0.08, 0.4), ("2+2", 0.0, 0.75)]
)
def test_profiles_of_the_tandem_agree_at_the_truth(
    layout: str, friction: float, largest: float
) -> None:
    problem, y = build_problem(inputs_of(driven(friction, layout=layout)))
    for _ in range(2):
        problem = update_noise(problem, y, None)
    white = posterior.data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)
    before, behind = off_bridge_residuals(problem, y)
    on = slice(before.stop, behind.start)
    assert np.sqrt(np.mean(white[before, 0] ** 2)) < 0.35
    # On the bridge the front axle's motion is estimated, from profile and deflection; without the
    # deflection it is 1.0, without any motion of that axle 1.7.
    assert np.sqrt(np.mean(white[on, 0] ** 2)) < largest
    assert np.sqrt(np.mean(white[behind, 0] ** 2)) < 0.35
    assert not white[:, 1:].any()
    stiff = y.copy()
    where = posterior.layout(problem)
    stiff[where.elements] += 1.0  # 10 %
    worse = posterior.data_rows(problem, stiff[None, :])[0].reshape(-1, RESIDUALS)[on, 0]
    assert np.sum((worse - white[on, 0]) ** 2) > 50.0


def test_profiles_agree_on_springs_of_their_own_without_friction() -> None:
    problem, y = build_problem(inputs_of(driven(0.0, False)))
    for _ in range(3):
        problem = update_noise(problem, y, no_suspension_noise())
    white = posterior.data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)
    before, behind = off_bridge_residuals(problem, y)
    on = slice(before.stop, behind.start)
    assert np.sqrt(np.mean(white[before, 0] ** 2)) < 0.35
    assert np.sqrt(np.mean(white[on, 0] ** 2)) < 0.6
    assert np.sqrt(np.mean(white[:, 2] ** 2)) < 0.6  # the moment about the front axle
    assert not white[:, 1].any()
    soft = problem._replace(
        priors=problem.priors._replace(
            theta=np.where(
                np.arange(problem.priors.theta.size) == K_S1,
                0.9 * problem.priors.theta,
                problem.priors.theta,
            )
        )
    )
    worse = posterior.data_rows(soft, y[None, :])[0].reshape(-1, RESIDUALS)
    assert np.sqrt(np.mean(worse[:, 2] ** 2)) > 3.0


def test_friction_of_own_springs_is_found_in_the_moment() -> None:
    problem, y = build_problem(inputs_of(driven(0.04, False)))
    assert tandem_friction(problem, y) == 0.0
    rough = update_noise(problem, y)
    # Springs that hardly slide: the friction changes by a part of its limit only.
    assert 0.005 < tandem_friction(rough, y) < 0.04
    assert posterior.suspension_equation_weight(rough, y) < 0.05
    smooth, y = build_problem(inputs_of(driven(0.0, False)))
    assert tandem_friction(update_noise(smooth, y), y) < 0.001
    equalised, y = build_problem(inputs_of(driven()))
    assert tandem_friction(update_noise(equalised, y), y) == 0.0


def test_friction_passes_to_the_profiles_as_a_projection() -> None:
    known = TandemTruck(4.6, 5.275, FRONT_AXLE, False)
    theta = theta_of(driven(0.0, False).case)
    omega, lag_s = np.array([0.5, 6.0, 40.0]), 0.13
    levers = np.array([4.6, 5.95])
    share = theta[SHARE]
    # Friction of unit power in both springs, less the part that the moment determines.
    left = np.eye(2) - np.outer(levers, levers) / (levers @ levers)
    in_moment = (levers @ levers) / (share * levers[0] + (1.0 - share) * levers[1]) ** 2
    for w, found in zip(omega, friction_transfer(known, theta, 1.35, lag_s, omega), strict=True):
        tyres = theta[K_U1 : K_U1 + 2] + 1j * w * theta[C_U1 : C_U1 + 2]
        to_profiles = np.array([np.exp(-1j * w * lag_s), -1.0]) / tyres
        expected = to_profiles @ left @ left.T @ to_profiles.conj()
        assert found * in_moment == pytest.approx(expected.real)


@pytest.mark.parametrize("equalised", [True, False])
def test_sensor_noise_has_unit_variance_once_whitened(equalised: bool) -> None:
    of = driven(0.0, equalised)
    count = of.run.run.accel_time_s.size
    rng = np.random.default_rng(5)
    noise = DENSITY * np.sqrt(0.5 * of.run.run.rate_hz) * rng.standard_normal((4, count))
    problem, y = build_problem(inputs_of(of, noise))
    white = posterior.data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)
    before, behind = off_bridge_residuals(problem, y)
    for kind in (0,) if equalised else (0, 2):
        off = np.concatenate([white[before, kind], white[behind, kind]])
        assert np.mean(off**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / off.size))


def on_a_surface(noise: float = 1.0, layout: str = "1+2") -> tuple[PosteriorProblem, np.ndarray]:
    """Return the problem of `driven_on_a_surface` at the truth, for sensors of `noise` DENSITY."""
    of = driven_on_a_surface(layout)
    *ahead, first, _ = (
        Footprint(axle.tyre_width_m, axle.twin_distance_m, track_m=axle.track_m)
        for axle in of.case.truck.axles
    )
    inputs = inputs_of(of)._replace(footprints=(first, first), front_footprints=tuple(ahead))
    inputs = inputs._replace(density_m_per_s2_per_rthz=np.full(4, noise * DENSITY))
    problem, y = build_problem(inputs)
    none = np.zeros_like(problem.mismatch.level_m3)
    for _ in range(2):
        problem = update_noise(problem, y, mismatch=none)
    return problem, y


def with_known_front_axle(problem: PosteriorProblem) -> PosteriorProblem:
    return problem._replace(noise=problem.noise._replace(low_rank=np.zeros((0, 0))))


def test_front_axle_in_another_strip_is_noise_of_its_own() -> None:
    problem, y = on_a_surface()
    before, behind = off_bridge_residuals(problem, y)
    on = slice(before.stop, behind.start)

    def powers(one: PosteriorProblem) -> tuple[float, float]:
        square = posterior.data_rows(one, y[None, :])[0, ::RESIDUALS] ** 2
        return float(square[before].mean()), float(square[on].mean())

    off_bridge, on_bridge = powers(with_known_front_axle(problem))
    assert on_bridge > 2.0 * off_bridge
    off_bridge, on_bridge = powers(problem)
    assert on_bridge < off_bridge


@pytest.mark.parametrize("layout", LAYOUTS)
def test_noise_of_the_front_axle_is_white_once_whitened(layout: str) -> None:
    problem, y = on_a_surface(0.1, layout)
    crossing = problem.crossing
    still = with_known_front_axle(problem)
    response = front_axles.front_axles_response(still, y)
    assert response is not None
    root = np.linalg.cholesky(response.covariance + 1e-9 * np.diag(np.diag(response.covariance)))
    knots = front_axles._unit_motions(still, y)[0]
    counts = np.cumsum([one.motions.shape[1] for one in knots])[:-1]
    masses = crossing.tandem.front.unsprung_mass_kg
    rng = np.random.default_rng(4)
    base = posterior.data_rows(still, y[None, :])[0]
    columns = problem.noise.low_rank
    powers = []
    for _ in range(200):
        errors = np.split(root @ rng.standard_normal(len(root)), counts)
        own = [
            mass * (one.motions @ error)
            for mass, one, error in zip(masses, knots, errors, strict=True)
        ]
        forces = crossing.front_force_n + np.array(own)
        moved = still._replace(crossing=crossing._replace(front_force_n=forces))
        noise = posterior.data_rows(moved, y[None, :])[0] - base
        noise += rng.standard_normal(noise.size)
        left = noise - columns @ (columns.T @ noise)
        # In the directions of the noise, of which the last ones are weak.
        powers.append((np.linalg.qr(columns)[0].T @ left) ** 2)
    power = np.mean(powers, axis=0)
    assert power == pytest.approx(np.ones(power.size), abs=5.0 * np.sqrt(2.0 / len(powers)))


def without_roll(problem: PosteriorProblem) -> PosteriorProblem:
    """Return the problem with the spectra of the axles' tracks alone."""
    road = problem.mismatch
    shapes = mismatch_spectra(*road.shapes.footprints)
    return problem._replace(
        mismatch=road._replace(shapes=shapes, level_m3=road.level_m3[:TRACK_SHAPES])
    )


def test_axles_that_only_roll_have_no_offset() -> None:
    problem, y = on_a_surface()  # both axles are 5 mm beside their sensors
    levels = _levels_off_bridge(problem, y)[0]
    assert levels[TRACK_SHAPES:].max() > 0.0
    assert levels[1] < 1e-3 * _levels_off_bridge(without_roll(problem), y)[0][1]
    assert mismatch_excess(problem, y) < 1e-3


def test_waves_by_the_front_axle_are_no_roughness_of_the_deck() -> None:
    rolling, y = on_a_surface()
    problem = without_roll(rolling)
    level = _levels_off_bridge(problem, y)[0]
    response = front_axles.front_axles_response(problem, y)
    assert response is not None

    def in_spreads(pavement: BridgePavement) -> np.ndarray:
        return pavement.ratio_and_tilt / np.sqrt(np.diag(pavement.covariance))

    # The deck is as rough as the road: both are zero.
    assert in_spreads(estimate_pavement(problem, y, level))[0] > 3.0
    assert np.abs(in_spreads(estimate_pavement(problem, y, level, response))).max() < 2.0
    used = update_noise(problem, y, mismatch=level).mismatch.pavement
    assert used is not None
    assert np.abs(in_spreads(used)).max() < 2.0


def test_equal_tyres_of_a_tandem_differ_by_an_offset_only() -> None:
    problem, y = on_a_surface()
    levels = _levels_off_bridge(without_roll(problem), y)[0]
    assert levels[0] == 0.0 < levels[1]


def test_power_of_the_front_axle_is_that_of_its_noise_in_the_mismatch() -> None:
    problem, y = on_a_surface()
    response = front_axles.front_axles_response(problem, y)
    assert response is not None
    before, behind = off_bridge_residuals(problem, y)
    some = np.arange(before.stop, behind.start)
    rng = np.random.default_rng(7)
    covariance = response.covariance
    weights = rng.multivariate_normal(np.zeros(len(covariance)), covariance, 400)
    noise = (response.columns[0] @ weights.T)[some]
    nothing = np.zeros((1, 1))
    seen = [tapered_periodogram(one, nothing[0], nothing).observed for one in noise.T]
    expected, by_values = front_axles.front_axles_power(response, some)
    clear = expected > 1e-3 * expected.max()
    assert np.mean(seen, axis=0)[clear] == pytest.approx(expected[clear], rel=0.3)
    assert not by_values.any()


def with_others(truck: TandemTruck, **values: np.ndarray) -> TandemTruck:
    return truck._replace(front=truck.front._replace(**values))


def test_wrong_mass_and_tyre_of_the_front_axle_are_its_noise() -> None:
    of = driven()
    true = tandem_truck_of(of.case.truck)
    wrong = with_others(
        true,
        unsprung_mass_kg=1.45 * true.front.unsprung_mass_kg,
        tyre_stiffness_n_per_m=0.7 * true.front.tyre_stiffness_n_per_m,
    )
    displaced = (
        with_others(wrong, unsprung_mass_kg=1.3 * wrong.front.unsprung_mass_kg),
        with_others(wrong, tyre_stiffness_n_per_m=1.3 * wrong.front.tyre_stiffness_n_per_m),
    )

    def power(trucks: tuple[TandemTruck, ...]) -> float:
        problem, y = build_problem(inputs_of(of)._replace(tandem=wrong, displaced_trucks=trucks))
        # Both axles feel one road: no other noise of the front axle.
        none = np.zeros_like(problem.mismatch.level_m3)
        (shapes,) = problem.front_axles
        same = shapes._replace(density=1e-9 * shapes.density)
        problem = problem._replace(front_axles=(same,))
        for _ in range(2):
            problem = update_noise(problem, y, mismatch=none)
        before, behind = off_bridge_residuals(problem, y)
        # The body's centre and inertia are unknown and take up what the axle's weight changes.
        places = np.searchsorted(np.flatnonzero(problem.priors.estimated), [D_1, KAPPA])
        near = y + 1e-3 * np.vstack([np.zeros(y.size), np.eye(y.size)[places]])
        white, *aside = posterior.data_rows(problem, near)[:, ::RESIDUALS]
        slopes = (np.array(aside) - white).T
        left = white - slopes @ np.linalg.lstsq(slopes, white)[0]
        return float(np.mean(left[before.stop : behind.start] ** 2))

    assert power(displaced) < 0.2 * power(())


def test_displaced_mass_of_the_front_axle_is_noise_on_the_bridge_alone() -> None:
    # As a column of noise before the bridge, a lighter body would contain the noise of its sensors.
    of = driven()
    known = tandem_truck_of(of.case.truck)
    heavier = with_others(known, unsprung_mass_kg=1.15 * known.front.unsprung_mass_kg)
    problem, y = build_problem(inputs_of(of)._replace(displaced_trucks=(heavier,)))
    problem = update_noise(problem, y, mismatch=np.zeros_like(problem.mismatch.level_m3))
    before, behind = off_bridge_residuals(problem, y)
    columns = problem.noise.low_rank[::RESIDUALS]
    assert np.abs(columns[before.stop : behind.start]).max() > 0.1
    assert np.abs(columns[before]).max() < 1e-6


def test_front_axle_counts_for_each_run_in_a_fusion() -> None:
    problem, y = on_a_surface()
    one = problem.noise.low_rank
    response = front_axles.front_axles_response(problem, y)
    noise = front_axles.without_front_axles(problem, response, problem.noise, front_axles.RUNS)
    many = noise.low_rank
    assert many.shape[1] >= one.shape[1] > 10
    assert np.sum(many**2) > 1.2 * np.sum(one**2)
    problem, y = build_problem(inputs_of(driven())._replace(tandem=NO_TANDEM, front_footprints=()))
    assert not problem.front_axles


def test_front_axle_counts_for_each_run_without_mismatch_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, y = on_a_surface()
    assert not problem.mismatch.level_m3.any()
    rows = levenberg_marquardt.initial_state(lambda at: posterior.all_rows(problem, at), y)
    found = Optimum(problem, rows, Termination.CONVERGED, 1.0, 0, 1)

    def information() -> float:
        of = likelihood(found)
        return float(np.sum(of.root[:, : len(of.bridge.names)] ** 2))

    of_many = information()
    monkeypatch.setattr(front_axles, "RUNS", 1.0)
    assert of_many < 0.8 * information()
