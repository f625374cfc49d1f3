"""Trucks and bridges with width: closed forms, the order of the steps, and our own half-car.

The simulator shares nothing with `pre_core`, so that each can be held against the other.
"""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import k1

from pre_core.physics import simulate as plane
from pre_core.physics.bridge import refine, uniform_beam
from pre_core.physics.simulate import Discretisation
from pre_core.physics.surface import Footprint, spectra, surface_density
from pre_core.physics.vehicle import HalfCar, dahl_friction_n
from services.common.arrays import Floats
from services.simulation.two_sided import (
    LONGEST_STEP_S,
    Body,
    Kingpin,
    WideAxle,
    WideBogie,
    WideRoad,
    WideTruck,
    axle_row,
    body_row,
    cross,
    even_motion,
    static_axle_loads_n,
    tyres_of,
)
from services.simulation.two_sided_deck import Deck, Torsion, bending_frequencies_hz
from services.simulation.two_sided_march import WideResponse
from services.simulation.two_sided_surface import (
    Strip,
    density_constant_m2,
    draw_waves,
    heights_m,
)

GRAVITY = 9.80665
LORRY = WideTruck(
    (Body(14_500.0, 2.4, 60e3, 10e3),),
    (
        WideAxle(0.0, 650.0, 3.2e5, 2.2e4, 1.9e6),
        WideAxle(4.0, 1150.0, 9.0e5, 4.0e4, 3.8e6),
    ),
)
DECK = Deck(14.0, (3e9, 3e9, 1.2e9, 3e9, 3e9, 3e9, 3e9), 4000.0, 0.7, 0.002)


def level(truck: WideTruck, start_m: float = -40.0, stop_m: float = 60.0) -> WideRoad:
    return WideRoad(
        start_m, 0.5, np.zeros((tyres_of(truck).axle.size, round(2 * (stop_m - start_m))))
    )


def wavy_heights(x: Floats) -> Floats:
    """A road that begins level at -6 m: no step at the start."""
    rise = np.clip((x + 6.0) / 4.0, 0.0, 1.0)
    waves = [
        a * np.sin(2.0 * np.pi * n * x + k)
        for k, (n, a) in enumerate(((0.11, 4e-3), (0.37, 1.5e-3), (0.9, 6e-4), (1.7, 2e-4)))
    ]
    return np.asarray(rise**4 * (35.0 - 84.0 * rise + 70.0 * rise**2 - 20.0 * rise**3)) * np.sum(
        waves, axis=0
    )


def wavy(truck: WideTruck) -> WideRoad:
    x = np.arange(-20.0, 40.0, 0.005)
    return WideRoad(-20.0, 0.005, np.tile(wavy_heights(x), (tyres_of(truck).axle.size, 1)))


def unit_load_deflection(deck: Deck, at_m: float, load_m: float) -> float:
    """Deflection by a unit load, from the bending moments over EI: no element, no mode."""
    span, count = deck.span_m, 140_000
    x = (np.arange(count) + 0.5) * span / count
    rigidity = np.array(deck.flexural_rigidity_nm2)[
        (x * len(deck.flexural_rigidity_nm2) / span).astype(int)
    ]

    def moment(place: float) -> Floats:
        return np.asarray(np.where(x < place, x * (span - place), place * (span - x)) / span)

    return float(np.sum(moment(at_m) * moment(load_m) / rigidity) * span / count)


def crawled(deck: Deck, lane_offset_m: float = 0.0) -> tuple[WideResponse, int]:
    """A truck that is slow enough for statics, and the step at which its front is at 8 m."""
    slow = even_motion(-0.5, 0.25, 40.0, 1e-3)
    run = cross(LORRY, deck, level(LORRY), slow, lane_offset_m=lane_offset_m)
    return run, int(np.abs(run.position_m - 8.0).argmin())


def test_standing_truck_deflects_the_bridge_by_its_loads() -> None:
    run, n = crawled(DECK)
    front, rear = static_axle_loads_n(LORRY)
    expected = [
        front * unit_load_deflection(DECK, x, 8.0) + rear * unit_load_deflection(DECK, x, 4.0)
        for x in (8.0, 4.0)
    ]
    np.testing.assert_allclose(-run.deflection_m[n], expected, rtol=2e-4)
    np.testing.assert_allclose(-run.contact_force_n[n, :2].sum(), front, rtol=1e-3)


def test_standing_truck_beside_the_axis_twists_the_deck() -> None:
    gyration, f_t = 2.3, 12.0
    deck = DECK._replace(torsion=Torsion(f_t, gyration))
    run, n = crawled(deck, lane_offset_m=1.5)
    span = deck.span_m
    inertia = deck.mass_per_length_kg_per_m * gyration**2
    rigidity = inertia * (2.0 * f_t * span) ** 2
    front, rear = static_axle_loads_n(LORRY)

    def twist(at_m: float, load_m: float) -> float:
        low, high = min(at_m, load_m), max(at_m, load_m)
        return low * (span - high) / (span * rigidity)

    expected = [1.5 * (front * twist(x, 8.0) + rear * twist(x, 4.0)) for x in (8.0, 4.0)]
    np.testing.assert_allclose(-run.twist_rad[n], expected, rtol=0.01)
    # Both axles sink with the lane: w + e theta.
    sunk = [run.coordinates[n] @ axle_row(LORRY, axle, 0.0) for axle in (0, 1)]
    np.testing.assert_allclose(sunk, run.deflection_m[n] + 1.5 * run.twist_rad[n], rtol=5e-3)
    # Bending is what it is without torsion.
    np.testing.assert_allclose(run.deflection_m[n], crawled(DECK)[0].deflection_m[n], rtol=1e-4)


def test_frequencies_of_a_uniform_beam() -> None:
    deck = Deck(30.0, (1.56e10,) * 7, 4400.0, 0.7, 0.005)
    n = np.arange(1, 9)
    exact = 0.5 * np.pi * (n / 30.0) ** 2 * np.sqrt(1.56e10 / 4400.0)
    np.testing.assert_allclose(bending_frequencies_hz(deck, 8), exact, rtol=2e-5)


def accelerations(truck: WideTruck, deck: Deck, step_s: float) -> Floats:
    """Accelerations every 4 ms; axles, bridge ends and cells are met at whole steps."""
    motion = even_motion(-8.0, 10.0, 2.4, step_s)
    run = cross(truck, deck, wavy(truck), motion, lane_offset_m=1.2)
    return run.acceleration[:: round(4e-3 / step_s)]


def test_steps_are_of_fourth_order() -> None:
    exact = accelerations(LORRY, DECK, 2.5e-4)
    steps = np.array([4e-3, 2e-3, 1e-3])
    errors = [float(np.abs(accelerations(LORRY, DECK, step) - exact).max()) for step in steps]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 3.6 < order < 4.6, errors


def test_longest_steps_are_exact_where_kinks_cost_the_order() -> None:
    """Damped tyres feel a jump at the ends, torsion has a kink under the wheel.

    A sensor of 10 µg/√Hz at 500 Hz has noise of 1.6e-3 m/s².
    """
    twisting = DECK._replace(torsion=Torsion(9.0, 2.0))
    damped = LORRY._replace(
        axles=tuple(axle._replace(tyre_damping_ns_per_m=800.0) for axle in LORRY.axles)
    )
    exact = accelerations(damped, twisting, 1.25e-4)
    used = accelerations(damped, twisting, LONGEST_STEP_S)
    np.testing.assert_allclose(used, exact, atol=4e-5)


def half_car(truck: WideTruck, kappa: float) -> HalfCar:
    front, rear = truck.axles
    body = truck.bodies[0]

    def pair(key: str) -> tuple[float, float]:
        return getattr(front, key), getattr(rear, key)

    return HalfCar(
        body.mass_kg,
        body.cg_position_m,
        rear.position_m,
        pair("suspension_damping_ns_per_m"),
        pair("suspension_stiffness_n_per_m"),
        pair("mass_kg"),
        pair("tyre_stiffness_n_per_m"),
        pitch_inertia_ratio=kappa,
        tyre_damping_ns_per_m=pair("tyre_damping_ns_per_m"),
        cg_height_m=body.cg_height_m,
    )


@pytest.mark.parametrize(("forward", "change"), [(True, 0.0), (False, 0.5)])
def test_in_the_middle_it_is_the_half_car(forward: bool, change: float) -> None:
    """Newmark's steps on Hermite elements and these: they share no line.

    Their differences are those of Newmark's scheme at 0.1 ms: a thousandth of the motion.
    """
    truck = LORRY._replace(
        axles=tuple(axle._replace(tyre_damping_ns_per_m=600.0) for axle in LORRY.axles)
    )
    body = truck.bodies[0]
    kappa = body.pitch_inertia_kg_m2 / (
        body.mass_kg * body.cg_position_m * (4.0 - body.cg_position_m)
    )
    step_s = 1e-4
    start = -8.0 if forward else 22.0
    motion = even_motion(
        start, 10.0, 2.6, 2.0 * step_s, forward=forward, change_m_per_s=change, period_s=5.0
    )
    x = np.arange(-20.0, 40.0, 0.005)
    way = 1.0 if forward else -1.0
    seen_x = x if forward else 14.0 - x
    road = WideRoad(-20.0, 0.005, np.tile(wavy_heights(seen_x), (4, 1)))
    ours = cross(truck, DECK, road, motion)

    places = motion.position_m[:, None] - way * np.array([0.0, 4.0])
    along = places if forward else 14.0 - places
    height = wavy_heights(along)
    ahead = 1e-6
    slope = (wavy_heights(along + ahead) - wavy_heights(along - ahead)) / (2.0 * ahead)
    rate = slope * np.abs(motion.speed_m_per_s)[:, None]
    beam = uniform_beam(14.0, np.array(DECK.flexural_rigidity_nm2), 4000.0, 0.7, 0.002)
    theirs = plane.simulate(
        half_car(truck, kappa),
        refine(beam, 10),
        plane.Motion(motion.position_m, motion.speed_m_per_s, motion.acceleration_m_per_s2),
        plane.WheelRoad(height, rate),
        Discretisation(step_s, 36),
        gravity_m_per_s2=GRAVITY,
    )
    assert theirs.converged
    rows = [body_row(truck, 0.0, 0.0), body_row(truck, 4.0, 0.0)]
    rows += [axle_row(truck, 0, 0.0), axle_row(truck, 1, 0.0)]
    here = ours.acceleration @ np.stack(rows).T
    there = theirs.acceleration_m_per_s2[::2]
    rms = np.sqrt(np.mean(there**2, axis=0))
    assert np.all(np.sqrt(np.mean((here - there) ** 2, axis=0)) < 1e-3 * rms)
    deepest = np.abs(theirs.wheel_deflection_m).max()
    np.testing.assert_allclose(
        ours.deflection_m, theirs.wheel_deflection_m[::2], atol=5e-4 * deepest
    )


def test_there_and_back_are_mirror_images() -> None:
    """The deck's left is the right of a truck that comes back."""
    deck = Deck(14.0, (3e9,) * 7, 4000.0, 0.7, 0.002, Torsion(9.0, 2.0))
    beside = LORRY._replace(
        axles=(LORRY.axles[0], LORRY.axles[1]._replace(offset_m=0.2)),
    )
    there = cross(beside, deck, level(beside), even_motion(-8.0, 10.0, 2.6, 5e-4), lane_offset_m=1)
    back = cross(
        beside,
        deck,
        level(beside),
        even_motion(22.0, 10.0, 2.6, 5e-4, forward=False),
        lane_offset_m=-1,
    )
    np.testing.assert_allclose(back.acceleration, there.acceleration, atol=1e-9)
    np.testing.assert_allclose(back.twist_rad, -there.twist_rad, atol=1e-12)
    assert np.abs(there.twist_rad).max() > 1e-5


TANDEM = WideTruck(
    (Body(22_000.0, 3.55, 148e3, 16e3),),
    (
        WideAxle(0.0, 700.0, 3.4e5, 2.4e4, 2.0e6, friction_n=5000.0),
        WideAxle(4.6, 1050.0, 8.5e5, 3.0e4, 3.7e6, twin_distance_m=0.33, friction_n=5000.0),
        WideAxle(5.95, 1000.0, 8.0e5, 2.0e4, 3.5e6, twin_distance_m=0.33, friction_n=4000.0),
    ),
    (WideBogie((1, 2), (0.55, 0.45)),),
)


def test_equalised_bogie_shares_its_spring_force() -> None:
    """Standing and driving: what the tyres and the axle's inertia leave is the spring's force."""
    loads = static_axle_loads_n(TANDEM)
    assert loads.sum() == pytest.approx(TANDEM.total_mass_kg * GRAVITY)
    carried = loads - GRAVITY * np.array([axle.mass_kg for axle in TANDEM.axles])
    assert carried[1] / carried[1:].sum() == pytest.approx(0.55)
    assert carried @ [0.0, 4.6, 5.95] == pytest.approx(22_000.0 * GRAVITY * 3.55)
    road = wavy(TANDEM)
    rough = WideRoad(
        road.start_m, road.spacing_m, road.height_m * np.linspace(0.8, 1.2, 10)[:, None]
    )
    run = cross(TANDEM, DECK, rough, even_motion(-9.0, 10.0, 2.0, 5e-4))
    tyres = tyres_of(TANDEM)
    springs = []
    for i in (1, 2):
        dynamic = -run.contact_force_n[:, tyres.axle == i].sum(axis=1) - loads[i]
        inertia = TANDEM.axles[i].mass_kg * (run.acceleration @ axle_row(TANDEM, i, 0.0))
        springs.append(inertia - dynamic)
    assert np.abs(springs[0]).max() > 3000.0
    np.testing.assert_allclose(springs[0] / 0.55, springs[1] / 0.45, atol=1e-6)
    independent = cross(TANDEM._replace(bogies=()), DECK, rough, even_motion(-9.0, 10.0, 2.0, 5e-4))
    assert np.abs(independent.acceleration - run.acceleration).max() > 0.1


def test_friction_of_the_springs_follows_dahls_law() -> None:
    """What the springs hold beyond stiffness and damping is Dahl's friction of their stroke."""
    rubbing = LORRY._replace(
        axles=tuple(
            axle._replace(friction_n=4000.0, friction_length_m=0.002) for axle in LORRY.axles
        )
    )
    run = cross(rubbing, DECK, wavy(rubbing), even_motion(-8.0, 10.0, 2.4, 2.5e-4))
    tyres = tyres_of(rubbing)
    for i, axle in enumerate(rubbing.axles):
        dynamic = -run.contact_force_n[:, tyres.axle == i].sum(axis=1)
        dynamic -= static_axle_loads_n(rubbing)[i]
        held = axle.mass_kg * (run.acceleration @ axle_row(rubbing, i, 0.0)) - dynamic
        # Positive where the spring is extended and pulls the axle up.
        stroke = run.coordinates @ (
            body_row(rubbing, axle.position_m, 0.0) - axle_row(rubbing, i, 0.0)
        )
        rate = np.gradient(stroke, run.time_s)
        friction = held - axle.suspension_stiffness_n_per_m * stroke
        friction -= axle.suspension_damping_ns_per_m * rate
        exact = np.zeros_like(stroke)
        for n in range(1, stroke.size):
            exact[n] = dahl_friction_n(exact[n - 1], stroke[n] - stroke[n - 1], 4000.0, 0.002)
        assert np.ptp(exact) > 6000.0
        np.testing.assert_allclose(friction, exact, atol=60.0)


def test_semitrailer_stands_on_its_kingpin() -> None:
    truck = WideTruck(
        (Body(6200.0, 1.25, 18e3, 4e3), Body(28_500.0, 7.6, 340e3, 20e3)),
        (
            WideAxle(0.0, 700.0, 3.4e5, 2.4e4, 2.0e6),
            WideAxle(3.7, 1150.0, 7e5, 4e4, 3.8e6),
            *(WideAxle(9.2 + 1.3 * k, 850.0, 6e5, 2.5e4, 2.4e6, body=1) for k in range(3)),
        ),
        (WideBogie((2, 3, 4), (1 / 3, 1 / 3, 1 / 3)),),
        Kingpin(3.1),
    )
    loads = static_axle_loads_n(truck)
    unsprung = GRAVITY * np.array([axle.mass_kg for axle in truck.axles])
    kingpin = 28_500.0 * GRAVITY * (10.5 - 7.6) / (10.5 - 3.1)
    rear = (6200.0 * GRAVITY * 1.25 + kingpin * 3.1) / 3.7
    expected = [6200.0 * GRAVITY + kingpin - rear, rear]
    expected += [(28_500.0 * GRAVITY - kingpin) / 3] * 3
    np.testing.assert_allclose(loads - unsprung, expected, rtol=1e-9)
    # Both bodies move alike where they are coupled.
    run = cross(truck, DECK, wavy(truck), even_motion(-6.0, 10.0, 2.0, 5e-4))
    ends = [run.coordinates @ body_row(truck, 3.1, 0.0, body) for body in (0, 1)]
    np.testing.assert_allclose(ends[0], ends[1], atol=5e-4)
    assert np.ptp(ends[0]) > 5e-3


def test_load_beside_the_middle_leans_on_that_side() -> None:
    leaning = LORRY._replace(bodies=(LORRY.bodies[0]._replace(cg_left_m=0.06),))
    run = cross(leaning, DECK, level(leaning), even_motion(-9.0, 10.0, 0.1, 5e-4))
    tyres = tyres_of(leaning)
    forces = -run.contact_force_n[-1]
    assert forces @ tyres.lateral_m == pytest.approx(14_500.0 * GRAVITY * 0.06)
    np.testing.assert_allclose(run.acceleration, 0.0, atol=1e-12)


def test_one_side_higher_leans_the_body_by_its_springs_in_series() -> None:
    """Tyres and springs of each axle in series, less what the leaning body's weight takes away."""
    tyres = tyres_of(LORRY)
    bank = WideRoad(-60.0, 0.5, np.tile(0.01 * np.sign(tyres.lateral_m)[:, None], (1, 200)))
    run = cross(LORRY, DECK, bank, even_motion(-50.0, 2.0, 12.0, 1e-3), settle_s=2.0)
    body, total = LORRY.bodies[0], 0.0
    for axle in LORRY.axles:
        spring = axle.suspension_stiffness_n_per_m * axle.spring_track_m**2 / 4.0
        spring += axle.anti_roll_nm_per_rad
        tyre = axle.tyre_stiffness_n_per_m * axle.track_m**2 / 4.0
        total += spring * tyre / (spring + tyre)
    leaning = body.mass_kg * GRAVITY * body.roll_arm_m
    expected = 0.02 / 1.9 * total / (total - leaning)
    assert run.coordinates[-1, 2] == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(run.coordinates[-1, :2], 0.0, atol=1e-9)


def profiles(strips: list[Strip], seeds: int, spacing_m: float, count: int) -> Floats:
    """Heights (seeds, strips, count)."""
    return np.stack(
        [
            [heights_m(draw_waves("A", seed), strip, 0.0, spacing_m, count) for strip in strips]
            for seed in range(seeds)
        ]
    )


def cross_spectra(heights: Floats, spacing_m: float) -> tuple[Floats, NDArray[np.complex128]]:
    """Spatial frequencies (f,) and one-sided cross spectra (f, strips, strips) in m³, windowed."""
    count = heights.shape[-1]
    window = np.hanning(count) ** 2
    waves = np.fft.rfft(heights * window, axis=-1)
    scale = 2.0 * spacing_m / np.sum(window**2)
    spectra = scale * np.einsum("sif,sjf->fij", waves, waves.conj()) / heights.shape[0]
    return np.fft.rfftfreq(count, spacing_m), spectra


def in_bands(n: Floats, values: Floats, edges: Floats) -> Floats:
    return np.array([values[(n >= low) & (n < high)].mean() for low, high in pairwise(edges)])


EDGES = np.array([0.06, 0.1, 0.16, 0.25, 0.4, 0.63, 1.0, 1.6, 2.5])


def test_surface_has_the_density_of_its_class_along_a_line() -> None:
    heights = profiles([Strip(3.0, 0.0, 0.0)], 12, 0.1, 2000)
    n, found = cross_spectra(heights, 0.1)
    density = 16e-6 * (np.maximum(n, 1e-3) / 0.1) ** -2
    ratio = in_bands(n[1:], found[1:, 0, 0].real / density[1:], EDGES)
    # 12 profiles with 5 to 60 lines to a band: 13 to 4 %.
    np.testing.assert_allclose(ratio, 1.0, atol=0.3)
    assert abs(np.log(ratio).mean()) < 0.08


def test_surface_coherence_between_lines_is_that_of_an_isotropic_one() -> None:
    """gamma = 2 pi n d K_1(2 pi n d) at the distance d."""
    distances = [0.0, 0.3, 0.9, 1.9]
    heights = profiles([Strip(d, 0.0, 0.0) for d in distances], 12, 0.1, 2000)
    n, found = cross_spectra(heights, 0.1)
    for k, d in enumerate(distances[1:], start=1):
        a = 2.0 * np.pi * np.maximum(n, 1e-3) * d
        expected = in_bands(n, a * k1(a), EDGES)
        joint = in_bands(n, found[:, 0, k].real * n**2, EDGES)
        alone = in_bands(n, 0.5 * (found[:, 0, 0] + found[:, k, k]).real * n**2, EDGES)
        np.testing.assert_allclose(joint / alone, expected, atol=0.15)


def test_difference_of_twin_and_single_tyres_is_that_of_the_formula() -> None:
    """The same surface by two programs, where all the information on the mismatch is."""
    single = [Strip(side * 0.95, 0.25, 0.2) for side in (1, -1)]
    twin = [Strip(side * 0.95 + apart, 0.22, 0.2) for side in (1, -1) for apart in (0.165, -0.165)]
    heights = profiles([*single, *twin], 12, 0.1, 1500)
    apart = heights[:, :2].mean(axis=1) - heights[:, 2:].mean(axis=1)
    n, found = cross_spectra(apart[:, None], 0.1)
    front = Footprint(track_m=1.9)
    rear = Footprint(width_m=0.22, twin_distance_m=0.33, track_m=1.9)
    use = n > 0.02
    expected = np.full(n.size, np.nan)
    expected[use] = surface_density("A") * spectra(front, rear, n[use])[3]
    ratio = in_bands(n[use], found[use, 0, 0].real / expected[use], EDGES)
    np.testing.assert_allclose(ratio, 1.0, atol=0.35)
    assert abs(np.log(ratio).mean()) < 0.1


def test_classes_are_four_times_as_rough() -> None:
    assert density_constant_m2("A") == pytest.approx(8e-8)
    assert density_constant_m2("C") == pytest.approx(16 * 8e-8)
    with pytest.raises(ValueError, match="F is no road class, it must be one of A, B, C, D, E"):
        density_constant_m2("F")


def test_short_road_is_refused() -> None:
    with pytest.raises(ValueError, match="the wheels run from -104"):
        cross(LORRY, DECK, level(LORRY), even_motion(-100.0, 10.0, 1.0, 5e-4))
