"""Three-dimensional trucks and bridges: left and right wheels, roll, bogies, a deck that twists.

This is the truth of validations beyond the plane half-car. It shares no physics, mesh or integrator
with `pre_core`: a program tested by its own simulator would not notice its own errors.

Truck: rigid bodies (heave, pitch, roll), of which the second may be a semitrailer on a kingpin; any
number of axles (heave, roll); springs, dampers and friction on either side; anti-roll bars; tyres
one by one. A body's point at the distance o behind the first axle and e to the left of the centre
line moves by z + (cg - o) theta + (e - cg_left) phi, an axle's by z + e phi; pitch is positive nose
up, roll with the left side up. Everything is relative to the equilibrium on a flat road. An
equalised bogie has one spring on each side whose lower end follows the mean of its axles, weighted
with their shares, and which loads them in the same shares. Friction follows Dahl's law, dF/du =
(F_c/l) (1 - sign(du) F/F_c).
"""

from typing import Final, NamedTuple

import numpy as np

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from services.common.arrays import Floats, Ints
from services.simulation.two_sided_deck import Deck, exact_modes
from services.simulation.two_sided_march import (
    TruckSystem,
    WheelCourse,
    WideResponse,
    march_exactly,
)

LONGEST_STEP_S: Final = 5e-4
_KINGPIN_N_PER_M: Final = 2e7
_KINGPIN_NS_PER_M: Final = 1e5


class WideAxle(NamedTuple):
    """An axle; stiffness, damping and friction are those of both sides together."""

    position_m: float
    """Distance behind the first axle."""
    mass_kg: float
    suspension_stiffness_n_per_m: float
    suspension_damping_ns_per_m: float
    tyre_stiffness_n_per_m: float
    tyre_damping_ns_per_m: float = 0.0
    track_m: float = 1.9
    tyre_width_m: float = 0.25
    twin_distance_m: float = 0.0
    """Distance between the middles of twin tyres; 0 for single ones."""
    outer_share: float = 0.5
    """Share of the outer twin tyre in a side's stiffness and load."""
    contact_length_m: float = 0.2
    spring_track_m: float = 1.0
    anti_roll_nm_per_rad: float = 1.0e5
    offset_m: float = 0.0
    """Distance of the axle's middle to the left of the truck's."""
    friction_n: float = 0.0
    friction_length_m: float = 0.002
    body: int = 0
    preload_n: float = 0.0
    """Force of its springs where those without one are relaxed, as their shape or a shim sets."""

    @property
    def roll_inertia_kg_m2(self) -> float:
        """Inertia about the direction of travel: part of the mass is at the wheels."""
        return self.mass_kg * self.track_m**2 / 8.0


class Body(NamedTuple):
    """A rigid body."""

    mass_kg: float
    cg_position_m: float
    """Distance of the centre of gravity behind the first axle."""
    pitch_inertia_kg_m2: float
    roll_inertia_kg_m2: float
    cg_left_m: float = 0.0
    cg_height_m: float = 1.3
    roll_arm_m: float = 0.5
    """Height of the centre of gravity above the roll axis."""


class WideBogie(NamedTuple):
    """Axles (indices from 0) that share one spring force on each side."""

    axles: tuple[int, ...]
    shares: tuple[float, ...]


class Kingpin(NamedTuple):
    """Coupling of the second body to the first one."""

    position_m: float
    roll_stiffness_nm_per_rad: float = 5.0e5
    roll_damping_nms_per_rad: float = 1.0e4


class WideTruck(NamedTuple):
    """A truck, or a tractor with a semitrailer."""

    bodies: tuple[Body, ...]
    axles: tuple[WideAxle, ...]
    bogies: tuple[WideBogie, ...] = ()
    kingpin: Kingpin | None = None

    @property
    def total_mass_kg(self) -> float:
        """Mass of bodies and axles."""
        return sum(body.mass_kg for body in self.bodies) + sum(axle.mass_kg for axle in self.axles)


class WideMotion(NamedTuple):
    """Motion of the first axle at the times 0, h/2, h, …: (2 steps + 1,) each."""

    step_s: float
    position_m: Floats
    """Chainage; it decreases when driving from end to start."""
    speed_m_per_s: Floats
    """Rate of change of the chainage."""
    acceleration_m_per_s2: Floats
    """Rate of change of the magnitude of the speed."""


class WideRoad(NamedTuple):
    """Heights under each tyre at equally spaced chainages, in the order of `tyres_of`."""

    start_m: float
    spacing_m: float
    height_m: Floats  # (tyres, n)


class WideTyres(NamedTuple):
    """All tyres of a truck: (tyres,) each, axle by axle, the left side first."""

    axle: Ints
    lateral_m: Floats
    """Distance to the left of the truck's centre line."""
    share: Floats
    """Share of the axle's tyre stiffness."""


def tyres_of(truck: WideTruck) -> WideTyres:
    """Return the tyres of a truck; an axle has two, or four where they are twins."""
    rows = []
    for i, axle in enumerate(truck.axles):
        for side in (1.0, -1.0):
            middle = axle.offset_m + 0.5 * side * axle.track_m
            if axle.twin_distance_m > 0.0:
                apart = 0.5 * side * axle.twin_distance_m
                rows.append((i, middle + apart, 0.5 * axle.outer_share))
                rows.append((i, middle - apart, 0.5 * (1.0 - axle.outer_share)))
            else:
                rows.append((i, middle, 0.5))
    number, lateral, share = zip(*rows, strict=True)
    return WideTyres(np.array(number, dtype=np.int64), np.array(lateral), np.array(share))


def static_axle_loads_n(truck: WideTruck) -> Floats:
    """Return the load of each axle (n,) on a flat road, wheels included.

    Redundant springs share what their preloads leave as if their relaxed lengths were equal.
    """
    gravity = STANDARD_GRAVITY_M_PER_S2
    loads = np.array([gravity * axle.mass_kg for axle in truck.axles])
    kingpin_n = 0.0
    for b in reversed(range(len(truck.bodies))):
        body = truck.bodies[b]
        groups = [group for group in groups_of(truck) if truck.axles[group.axles[0]].body == b]
        places = [_place(truck, group) for group in groups]
        stiffness = [_series_stiffness(truck, group) for group in groups]
        weight = gravity * body.mass_kg
        moment = weight * body.cg_position_m
        if b == 0 and truck.kingpin is not None:
            weight += kingpin_n
            moment += kingpin_n * truck.kingpin.position_m
        if b == 1 and truck.kingpin is not None:
            places.append(truck.kingpin.position_m)
            stiffness.append(_KINGPIN_N_PER_M)
        rows = np.stack([np.ones(len(places)), np.array(places)])
        spread = np.array(stiffness) * rows
        preload = np.zeros(len(places))
        preload[: len(groups)] = [
            sum(truck.axles[i].preload_n for i in group.axles) for group in groups
        ]
        left = np.array([weight, moment]) - rows @ preload
        forces = preload + spread.T @ np.linalg.solve(rows @ spread.T, left)
        if b == 1:
            kingpin_n = float(forces[-1])
        for group, force in zip(groups, forces, strict=False):
            for i, share in zip(group.axles, group.shares, strict=True):
                loads[i] += share * force
    return loads


def groups_of(truck: WideTruck) -> list[WideBogie]:
    """Return the bogies, and every other axle as one of its own, from front to rear."""
    alone = set(range(len(truck.axles))) - {i for bogie in truck.bogies for i in bogie.axles}
    groups = [*truck.bogies, *(WideBogie((i,), (1.0,)) for i in alone)]
    return sorted(groups, key=lambda group: group.axles)


def even_motion(
    start_m: float,
    speed_m_per_s: float,
    duration_s: float,
    step_s: float,
    *,
    forward: bool = True,
    change_m_per_s: float = 0.0,
    period_s: float = 10.0,
) -> WideMotion:
    """Return the motion from `start_m` with the speed v + change sin(2 pi t/period)."""
    half = 0.5 * step_s
    t = half * np.arange(2 * round(duration_s / step_s) + 1)
    omega = 2.0 * np.pi / period_s
    travel = speed_m_per_s * t + change_m_per_s / omega * (1.0 - np.cos(omega * t))
    speed = speed_m_per_s + change_m_per_s * np.sin(omega * t)
    acceleration = change_m_per_s * omega * np.cos(omega * t)
    sign = 1.0 if forward else -1.0
    return WideMotion(step_s, start_m + sign * travel, sign * speed, acceleration)


def cross(
    truck: WideTruck,
    deck: Deck,
    road: WideRoad,
    motion: WideMotion,
    *,
    lane_offset_m: float = 0.0,
    settle_s: float = 0.0,
) -> WideResponse:
    """Drive the truck along `motion`; the bridge is at rest until the first wheel enters.

    The truck's centre line runs `lane_offset_m` to the left of the bridge's axis, seen from start
    to end. It starts at rest in equilibrium; the road rises from zero to its heights during the
    first `settle_s`, so that no step excites the truck. Raise ValueError if the road is too short.
    """
    system = _system(truck)
    tyres = tyres_of(truck)
    sign = 1.0 if motion.speed_m_per_s[0] >= 0.0 else -1.0
    behind = np.array([axle.position_m for axle in truck.axles])
    places = motion.position_m[:, None] - sign * behind
    heights, rates = _under_tyres(road, tyres, places, motion, settle_s)
    transfer = np.zeros(system.mass.size)
    for b, body in enumerate(truck.bodies):
        carried = sum(axle.mass_kg for axle in truck.axles if axle.body == b)
        transfer[3 * b + 1] = (body.mass_kg + carried) * body.cg_height_m
    modes = exact_modes(deck, motion.step_s)
    on = (places > 0.0) & (places < deck.span_m)
    steps = motion.position_m.size // 2
    touched = np.flatnonzero(on.any(axis=1)) // 2
    first, last = (int(touched[0]), int(touched[-1])) if touched.size else (steps + 1, -1)
    out = WideResponse(
        motion.step_s * np.arange(steps + 1, dtype=np.float64),
        motion.position_m[::2].copy(),
        np.zeros((steps + 1, system.mass.size)),
        np.zeros((steps + 1, system.mass.size)),
        np.zeros((steps + 1, tyres.axle.size)),
        np.zeros((steps + 1, behind.size)),
        np.zeros((steps + 1, behind.size)),
    )
    course = WheelCourse(
        motion.step_s,
        deck.span_m,
        first,
        last,
        modes.bending.shape[1],
        places,
        motion.speed_m_per_s,
        motion.acceleration_m_per_s2,
        transfer,
        tyres.axle,
        lane_offset_m + sign * tyres.lateral_m,
        heights,
        rates,
    )
    march_exactly(system, modes, course, out)
    return out


def body_row(truck: WideTruck, position_m: float, lateral_m: float, body: int = 0) -> Floats:
    """Return the row from coordinates to the motion of a point of a body."""
    row = np.zeros(3 * len(truck.bodies) + 2 * len(truck.axles))
    of = truck.bodies[body]
    row[3 * body : 3 * body + 3] = 1.0, of.cg_position_m - position_m, lateral_m - of.cg_left_m
    return row


def axle_row(truck: WideTruck, axle: int, lateral_m: float) -> Floats:
    """Return the row from coordinates to the motion of a point of an axle (from 0)."""
    row = np.zeros(3 * len(truck.bodies) + 2 * len(truck.axles))
    first = 3 * len(truck.bodies) + 2 * axle
    row[first : first + 2] = 1.0, lateral_m
    return row


def _system(truck: WideTruck) -> TruckSystem:
    size = 3 * len(truck.bodies) + 2 * len(truck.axles)
    mass = np.array(
        [
            value
            for body in truck.bodies
            for value in (body.mass_kg, body.pitch_inertia_kg_m2, body.roll_inertia_kg_m2)
        ]
        + [value for axle in truck.axles for value in (axle.mass_kg, axle.roll_inertia_kg_m2)]
    )
    stiffness, damping = np.zeros((size, size)), np.zeros((size, size))
    rubbing, levels, lengths = [], [], []
    for group in groups_of(truck):
        axles = [truck.axles[i] for i in group.axles]
        of = axles[0].body
        place = _place(truck, group)
        for side in (0.5, -0.5):
            row = np.zeros(size)
            lateral = 0.0
            for i, share in zip(group.axles, group.shares, strict=True):
                at = side * truck.axles[i].spring_track_m
                row += share * axle_row(truck, i, at)
                lateral += share * at
            row -= body_row(truck, place, lateral, of)
            square = np.outer(row, row)
            stiffness += 0.5 * sum(axle.suspension_stiffness_n_per_m for axle in axles) * square
            damping += 0.5 * sum(axle.suspension_damping_ns_per_m for axle in axles) * square
            level = 0.5 * sum(axle.friction_n for axle in axles)
            if level > 0.0:
                rubbing.append(row)
                levels.append(level)
                lengths.append(axles[0].friction_length_m)
    _couple_bodies(truck, stiffness, damping)
    tyres = tyres_of(truck)
    of_axle = [truck.axles[i] for i in tyres.axle]
    return TruckSystem(
        mass,
        damping,
        stiffness,
        np.stack(
            [
                axle_row(truck, int(i), float(e))
                for i, e in zip(tyres.axle, tyres.lateral_m, strict=True)
            ]
        ),
        tyres.share * np.array([axle.tyre_stiffness_n_per_m for axle in of_axle]),
        tyres.share * np.array([axle.tyre_damping_ns_per_m for axle in of_axle]),
        _static_tyre_loads(truck, tyres),
        np.stack(rubbing) if rubbing else np.zeros((0, size)),
        np.array(levels),
        np.array(lengths),
    )


def _couple_bodies(truck: WideTruck, stiffness: Floats, damping: Floats) -> None:
    """Add anti-roll bars, the weight of tilted bodies and the kingpin to the matrices (n, n)."""
    size = stiffness.shape[0]
    for i, axle in enumerate(truck.axles):
        row = np.zeros(size)
        row[3 * len(truck.bodies) + 2 * i + 1] = 1.0
        row[3 * axle.body + 2] = -1.0
        stiffness += axle.anti_roll_nm_per_rad * np.outer(row, row)
    for b, body in enumerate(truck.bodies):
        # The weight of a tilted body adds to its roll.
        stiffness[3 * b + 2, 3 * b + 2] -= (
            body.mass_kg * STANDARD_GRAVITY_M_PER_S2 * body.roll_arm_m
        )
    if truck.kingpin is not None:
        pin = truck.kingpin
        row = body_row(truck, pin.position_m, 0.0) - body_row(truck, pin.position_m, 0.0, 1)
        stiffness += _KINGPIN_N_PER_M * np.outer(row, row)
        damping += _KINGPIN_NS_PER_M * np.outer(row, row)
        row = np.zeros(size)
        row[2], row[5] = 1.0, -1.0
        stiffness += pin.roll_stiffness_nm_per_rad * np.outer(row, row)
        damping += pin.roll_damping_nms_per_rad * np.outer(row, row)


def _place(truck: WideTruck, group: WideBogie) -> float:
    """Return the place at which a bogie supports the body."""
    return sum(
        share * truck.axles[i].position_m
        for i, share in zip(group.axles, group.shares, strict=True)
    )


def _series_stiffness(truck: WideTruck, group: WideBogie) -> float:
    axles = [truck.axles[i] for i in group.axles]
    spring = sum(axle.suspension_stiffness_n_per_m for axle in axles)
    tyre = sum(axle.tyre_stiffness_n_per_m for axle in axles)
    return spring * tyre / (spring + tyre)


def _static_tyre_loads(truck: WideTruck, tyres: WideTyres) -> Floats:
    """Return loads (tyres,): the axles share an eccentric load by their roll stiffness."""
    loads = static_axle_loads_n(truck)[tyres.axle] * tyres.share
    for b, body in enumerate(truck.bodies):
        moment = body.mass_kg * STANDARD_GRAVITY_M_PER_S2 * body.cg_left_m
        resisting = [
            axle.suspension_stiffness_n_per_m * axle.spring_track_m**2 / 4.0
            + axle.anti_roll_nm_per_rad
            if axle.body == b
            else 0.0
            for axle in truck.axles
        ]
        for i, axle in enumerate(truck.axles):
            of = tyres.axle == i
            arm = tyres.lateral_m[of] - axle.offset_m
            lever = tyres.share[of] * arm
            loads[of] += moment * resisting[i] / sum(resisting) * lever / (lever @ arm)
    return loads


def _under_tyres(
    road: WideRoad, tyres: WideTyres, places: Floats, motion: WideMotion, settle_s: float
) -> tuple[Floats, Floats]:
    """Return heights and their rates of change (half steps, tyres)."""
    from scipy.interpolate import CubicSpline  # slow to import, of deviating crossings alone

    stop = road.start_m + road.spacing_m * (road.height_m.shape[1] - 1)
    if places.min() < road.start_m or places.max() > stop:
        raise ValueError(
            f"the road is from {road.start_m:g} to {stop:g} m, the wheels run from "
            f"{places.min():g} to {places.max():g} m"
        )
    chainage = road.start_m + road.spacing_m * np.arange(road.height_m.shape[1])
    t = 0.5 * motion.step_s * np.arange(places.shape[0])
    rise, rising = np.ones_like(t), np.zeros_like(t)
    if settle_s > 0.0:
        angle = np.pi * np.minimum(t / settle_s, 1.0)
        rise = 0.5 - 0.5 * np.cos(angle)
        rising = 0.5 * np.pi / settle_s * np.sin(angle)
    heights = np.empty((places.shape[0], tyres.axle.size))
    rates = np.empty_like(heights)
    for k, axle in enumerate(tyres.axle):
        spline = CubicSpline(chainage, road.height_m[k])
        raw = spline(places[:, axle])
        heights[:, k] = rise * raw
        rates[:, k] = rise * motion.speed_m_per_s * spline(places[:, axle], 1) + rising * raw
    return heights, rates
