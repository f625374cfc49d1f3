"""Trucks and bridges with width: left and right sides, roll, bogies and a deck that twists.

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

Bridge: Euler-Bernoulli bending of a beam whose rigidity differs between elements, in modes of its
own finite elements, and uniform St. Venant torsion between ends fixed against twist: psi_j = sin(j
pi x/L), omega_j = j omega_1, modal mass rho A r^2 L/2. Both are damped by alpha + beta omega^2. A
wheel at the distance e to the left of the axis follows w(x) + e theta(x), and its force drives
both.

Time: fourth-order Runge-Kutta steps, in their exponential form (Cox and Matthews 2002, eq. 26-29):
the free motion of each mode is exact, so that modes of several kHz or with many times their
critical damping need no shorter steps. For the truck, which has no exponential part, they are the
classical steps. The bridge moves only while a wheel is on it.

Longer than other modules: an equation and its coefficients are read together.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh, expm

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.kernels.lanes import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

LONGEST_STEP_S: Final = 5e-4
_CELLS: Final = 70
"""Fewest finite elements of the bridge."""
_BENDING_MODES: Final = 36
_TORSION_MODES: Final = 60
"""Number of torsional modes: twist under a wheel converges as its inverse, and 60 leave 0.7 %."""
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


class Torsion(NamedTuple):
    """Torsional properties of the deck."""

    frequency_hz: float
    """Frequency of the first mode."""
    gyration_m: float
    """Radius of gyration of the cross-section."""


class Deck(NamedTuple):
    """A simply supported bridge of equal elements."""

    span_m: float
    flexural_rigidity_nm2: tuple[float, ...]
    mass_per_length_kg_per_m: float
    rayleigh_alpha_per_s: float
    rayleigh_beta_s: float
    torsion: Torsion | None = None
    support_rotational_stiffness_nm_per_rad: tuple[float, float] = (0.0, 0.0)


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

    axle: Integers
    lateral_m: Floats
    """Distance to the left of the truck's centre line."""
    share: Floats
    """Share of the axle's tyre stiffness."""


class WideResponse(NamedTuple):
    """Motion of truck and bridge at every step."""

    time_s: Floats
    position_m: Floats
    """Chainage of the first axle."""
    coordinates: Floats  # (steps, 3 bodies + 2 axles): bodies (z, theta, phi), axles (z, phi)
    acceleration: Floats  # likewise, their second derivatives
    contact_force_n: Floats  # (steps, tyres), up positive on the bridge: negative while loaded
    deflection_m: Floats  # (steps, axles): bending at the axle
    twist_rad: Floats  # (steps, axles)


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

    Redundant springs share the load as if their relaxed lengths were equal.
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
        forces = spread.T @ np.linalg.solve(rows @ spread.T, np.array([weight, moment]))
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


def bending_frequencies_hz(deck: Deck, count: int) -> Floats:
    """Return the lowest undamped bending frequencies."""
    return np.asarray(np.sqrt(_bending(deck, count)[0]) / (2.0 * np.pi))


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
    modes = _modes(deck, motion.step_s)
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
    _march(
        motion.step_s,
        system,
        tyres.axle,
        lane_offset_m + sign * tyres.lateral_m,
        modes,
        deck.span_m,
        places,
        motion.speed_m_per_s,
        motion.acceleration_m_per_s2,
        transfer,
        heights,
        rates,
        first,
        last,
        out.coordinates,
        out.acceleration,
        out.contact_force_n,
        out.deflection_m,
        out.twist_rad,
    )
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


class _System(NamedTuple):
    """The truck's equations: M q'' + C q' + K q + friction = forces of the tyres."""

    mass: Floats  # (n,): the coordinates are those of the centres of gravity
    damping: Floats  # (n, n)
    stiffness: Floats  # (n, n)
    tyre_rows: Floats  # (tyres, n)
    tyre_stiffness: Floats  # (tyres,)
    tyre_damping: Floats
    static_load: Floats
    friction_rows: Floats  # (springs, n)
    friction_n: Floats  # (springs,)
    friction_length: Floats


def _system(truck: WideTruck) -> _System:
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
    tyres = tyres_of(truck)
    of_axle = [truck.axles[i] for i in tyres.axle]
    return _System(
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


class _Modes(NamedTuple):
    """Mass-normalised modes of the bridge, bending before torsion, and their exact steps."""

    cell_m: float
    bending: Floats  # (nodes, bending modes): displacement at the nodes
    slope: Floats  # (nodes, bending modes)
    torsion: Floats  # (torsion modes,): factor of sin(j pi x/L)
    half: Floats  # (modes, 2, 2): free motion of (q, q') in half a step
    full: Floats
    half_drive: Floats  # (modes, 2): h/2 phi_1 of half a step, by the modal force
    weights: Floats  # (modes, 3, 2): of the modal forces at begin, middle (each), end


def _modes(deck: Deck, step_s: float) -> _Modes:
    eigenvalues, shapes = _bending(deck, _BENDING_MODES)
    torsion = np.zeros(0)
    if deck.torsion is not None:
        j = np.arange(1, _TORSION_MODES + 1)
        eigenvalues = np.concatenate(
            [eigenvalues, (2.0 * np.pi * deck.torsion.frequency_hz * j) ** 2]
        )
        inertia = deck.mass_per_length_kg_per_m * deck.torsion.gyration_m**2 * deck.span_m / 2.0
        torsion = np.full(j.size, 1.0 / np.sqrt(inertia))
    half, full, half_drive, weights = [], [], [], []
    for value in eigenvalues:
        damping = deck.rayleigh_alpha_per_s + deck.rayleigh_beta_s * value
        generator = np.array([[0.0, 1.0], [-value, -damping]])
        exact, phi = _phi_functions(0.5 * step_s * generator)
        half.append(exact)
        half_drive.append(0.5 * step_s * phi[0])
        exact, phi = _phi_functions(step_s * generator)
        full.append(exact)
        weights.append(
            step_s
            * np.stack(
                [
                    phi[0] - 3.0 * phi[1] + 4.0 * phi[2],
                    2.0 * phi[1] - 4.0 * phi[2],
                    4.0 * phi[2] - phi[1],
                ]
            )
        )
    return _Modes(
        deck.span_m / (shapes.shape[0] // 2 - 1),
        np.ascontiguousarray(shapes[::2]),
        np.ascontiguousarray(shapes[1::2]),
        torsion,
        np.stack(half),
        np.stack(full),
        np.stack(half_drive),
        np.stack(weights),
    )


def _phi_functions(scaled: Floats) -> tuple[Floats, Floats]:
    """Return exp(A) and the second columns (3, 2) of phi_1, phi_2, phi_3 of A.

    They are in the exponential of A augmented with a chain of integrators.
    """
    joined = np.zeros((5, 5))
    joined[:2, :2] = scaled
    joined[1, 2] = 1.0
    joined[2, 3] = joined[3, 4] = 1.0
    whole = expm(joined)
    return whole[:2, :2], np.ascontiguousarray(whole[:2, 2:].T)


def _bending(deck: Deck, count: int) -> tuple[Floats, Floats]:
    """Return eigenvalues (count,) in 1/s² and mass-normalised shapes (2 nodes, count): w, w'."""
    parts = -(-_CELLS // len(deck.flexural_rigidity_nm2))
    rigidity = np.repeat(np.array(deck.flexural_rigidity_nm2), parts)
    cells = rigidity.size
    a = deck.span_m / cells
    bend = np.array(
        [
            [12.0, 6.0 * a, -12.0, 6.0 * a],
            [6.0 * a, 4.0 * a * a, -6.0 * a, 2.0 * a * a],
            [-12.0, -6.0 * a, 12.0, -6.0 * a],
            [6.0 * a, 2.0 * a * a, -6.0 * a, 4.0 * a * a],
        ]
    ) / (a**3)
    weigh = np.array(
        [
            [156.0, 22.0 * a, 54.0, -13.0 * a],
            [22.0 * a, 4.0 * a * a, 13.0 * a, -3.0 * a * a],
            [54.0, 13.0 * a, 156.0, -22.0 * a],
            [-13.0 * a, -3.0 * a * a, -22.0 * a, 4.0 * a * a],
        ]
    ) * (deck.mass_per_length_kg_per_m * a / 420.0)
    size = 2 * (cells + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for e in range(cells):
        stiffness[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += rigidity[e] * bend
        mass[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += weigh
    start, end = deck.support_rotational_stiffness_nm_per_rad
    stiffness[1, 1] += start
    stiffness[-1, -1] += end
    free = np.delete(np.arange(size), [0, size - 2])
    values, vectors = eigh(
        stiffness[np.ix_(free, free)], mass[np.ix_(free, free)], subset_by_index=(0, count - 1)
    )
    shapes = np.zeros((size, count))
    shapes[free] = vectors
    return np.asarray(values), shapes


@compiled(error_model="numpy")
def _shape(x, span, modes, out):  # type: ignore[no-untyped-def]
    """Write the mass-normalised modes at the chainage x to `out` (modes,), 0 off the bridge."""
    bending = modes.bending.shape[1]
    if not 0.0 < x < span:
        out[:] = 0.0
        return
    cell = min(int(x / modes.cell_m), modes.bending.shape[0] - 2)
    a = modes.cell_m
    s = x / a - cell
    n_1 = 1.0 - s * s * (3.0 - 2.0 * s)
    n_2 = a * s * (1.0 - s) * (1.0 - s)
    n_3 = s * s * (3.0 - 2.0 * s)
    n_4 = a * s * s * (s - 1.0)
    for k in range(bending):
        out[k] = (
            n_1 * modes.bending[cell, k]
            + n_2 * modes.slope[cell, k]
            + n_3 * modes.bending[cell + 1, k]
            + n_4 * modes.slope[cell + 1, k]
        )
    # sin((j + 1) a) = 2 cos(a) sin(j a) - sin((j - 1) a)
    angle = np.pi * x / span
    before, sine, twice = 0.0, np.sin(angle), 2.0 * np.cos(angle)
    for j in range(modes.torsion.size):
        out[bending + j] = modes.torsion[j] * sine
        before, sine = sine, twice * sine - before


@compiled(error_model="numpy")
def _derivative(  # type: ignore[no-untyped-def]
    system,
    tyre_axle,
    lateral,
    bending,
    shapes,
    slopes,
    speed,
    transfer,
    pull,
    height,
    rate,
    q,
    qd,
    friction,
    w,
    wd,
    is_on,
    contact,
    deflection,
    twist,
    qdd,
    friction_rate,
    modal_force,
):
    """Evaluate the right-hand sides at one moment; the last seven arrays are written."""
    size = q.size
    axles = shapes.shape[0]
    modes = modal_force.size
    deflection_rate = np.zeros(axles)
    twist_rate = np.zeros(axles)
    for i in range(axles):
        deflection[i] = 0.0
        twist[i] = 0.0
        if is_on:
            for k in range(modes):
                y = shapes[i, k] * w[k]
                yd = shapes[i, k] * wd[k] + speed * slopes[i, k] * w[k]
                if k < bending:
                    deflection[i] += y
                    deflection_rate[i] += yd
                else:
                    twist[i] += y
                    twist_rate[i] += yd
    for n in range(size):
        qdd[n] = transfer[n] * pull
        for m in range(size):
            qdd[n] -= system.damping[n, m] * qd[m] + system.stiffness[n, m] * q[m]
    for s in range(friction.size):
        sliding = 0.0
        for n in range(size):
            sliding += system.friction_rows[s, n] * qd[n]
            qdd[n] -= system.friction_rows[s, n] * friction[s]
        friction_rate[s] = (
            system.friction_n[s] * sliding - friction[s] * abs(sliding)
        ) / system.friction_length[s]
    for k in range(modes):
        modal_force[k] = 0.0
    for t in range(tyre_axle.size):
        i = tyre_axle[t]
        z, zd = 0.0, 0.0
        for n in range(size):
            z += system.tyre_rows[t, n] * q[n]
            zd += system.tyre_rows[t, n] * qd[n]
        ground = height[t] + deflection[i] + lateral[t] * twist[i]
        ground_rate = rate[t] + deflection_rate[i] + lateral[t] * twist_rate[i]
        force = system.tyre_stiffness[t] * (ground - z) + system.tyre_damping[t] * (
            ground_rate - zd
        )
        for n in range(size):
            qdd[n] += system.tyre_rows[t, n] * force
        contact[t] = -(system.static_load[t] + force)
        if is_on:
            for k in range(modes):
                arm = 1.0 if k < bending else lateral[t]
                modal_force[k] += shapes[i, k] * arm * contact[t]
    for n in range(size):
        qdd[n] /= system.mass[n]


@compiled(error_model="numpy")
def _march(  # type: ignore[no-untyped-def]
    step,
    system,
    tyre_axle,
    lateral,
    modes,
    span,
    places,
    speed,
    acceleration,
    transfer,
    height,
    rate,
    first_on,
    last_on,
    out_q,
    out_qdd,
    out_contact,
    out_deflection,
    out_twist,
):
    """March from rest and write the motion at every step to the last five arrays."""
    steps = out_q.shape[0] - 1
    size = out_q.shape[1]
    axles = places.shape[1]
    springs = system.friction_n.size
    bending = modes.bending.shape[1]
    count = modes.half.shape[0]
    needs_slopes = system.tyre_damping.max() > 0.0
    near = 1e-4
    ahead = np.zeros(count)
    shapes = np.zeros((3, axles, count))
    slopes = np.zeros((3, axles, count))
    q, qd, friction = np.zeros(size), np.zeros(size), np.zeros(springs)
    w, wd = np.zeros(count), np.zeros(count)
    # The stages of a step: the state of each evaluation, and its result.
    q_s, qd_s, friction_s = np.zeros(size), np.zeros(size), np.zeros(springs)
    w_s, wd_s = np.zeros(count), np.zeros(count)
    w_a, wd_a = np.zeros(count), np.zeros(count)
    v_k, a_k = np.zeros((4, size)), np.zeros((4, size))
    f_k, p_k = np.zeros((4, springs)), np.zeros((4, count))
    contact, deflection = np.zeros(tyre_axle.size), np.zeros(axles)
    twist = np.zeros(axles)
    for n in range(steps + 1):
        is_on = first_on <= n <= last_on
        if is_on:
            # Begin, middle and end of the step; the begin is the end of the one before.
            for moment in range(3):
                index = min(2 * n + moment, places.shape[0] - 1)
                for i in range(axles):
                    if moment == 0 and n > first_on:
                        shapes[0, i] = shapes[2, i]
                        slopes[0, i] = slopes[2, i]
                        continue
                    x = places[index, i]
                    _shape(x, span, modes, shapes[moment, i])
                    if needs_slopes:
                        slopes[moment, i] = 0.0
                        if near < x < span - near:
                            _shape(x + near, span, modes, ahead)
                            slopes[moment, i] = (ahead - shapes[moment, i]) / near
        for stage in range(4):
            moment = 0 if stage == 0 else (2 if stage == 3 else 1)
            index = min(2 * n + moment, places.shape[0] - 1)
            if stage == 0:
                q_s[:] = q
                qd_s[:] = qd
                friction_s[:] = friction
                w_s[:] = w
                wd_s[:] = wd
            else:
                of = stage - 1
                ahead_s = step if stage == 3 else 0.5 * step
                for k in range(size):
                    q_s[k] = q[k] + ahead_s * v_k[of, k]
                    qd_s[k] = qd[k] + ahead_s * a_k[of, k]
                for k in range(springs):
                    friction_s[k] = friction[k] + ahead_s * f_k[of, k]
                if is_on:
                    for k in range(count):
                        from_w, from_wd, force = w[k], wd[k], p_k[of, k]
                        if stage == 3:
                            from_w, from_wd = w_a[k], wd_a[k]
                            force = 2.0 * p_k[2, k] - p_k[0, k]
                        w_s[k] = (
                            modes.half[k, 0, 0] * from_w
                            + modes.half[k, 0, 1] * from_wd
                            + modes.half_drive[k, 0] * force
                        )
                        wd_s[k] = (
                            modes.half[k, 1, 0] * from_w
                            + modes.half[k, 1, 1] * from_wd
                            + modes.half_drive[k, 1] * force
                        )
                    if stage == 1:
                        w_a[:] = w_s
                        wd_a[:] = wd_s
            v_k[stage] = qd_s
            _derivative(
                system,
                tyre_axle,
                lateral,
                bending,
                shapes[moment],
                slopes[moment],
                speed[index],
                transfer,
                acceleration[index],
                height[index],
                rate[index],
                q_s,
                qd_s,
                friction_s,
                w_s,
                wd_s,
                is_on,
                contact,
                deflection,
                twist,
                a_k[stage],
                f_k[stage],
                p_k[stage],
            )
            if stage == 0:
                out_q[n] = q
                out_qdd[n] = a_k[0]
                out_contact[n] = contact
                out_deflection[n] = deflection
                out_twist[n] = twist
                if n == steps:
                    return
        sixth = step / 6.0
        for k in range(size):
            q[k] += sixth * (v_k[0, k] + 2.0 * v_k[1, k] + 2.0 * v_k[2, k] + v_k[3, k])
            qd[k] += sixth * (a_k[0, k] + 2.0 * a_k[1, k] + 2.0 * a_k[2, k] + a_k[3, k])
        for k in range(springs):
            friction[k] += sixth * (f_k[0, k] + 2.0 * f_k[1, k] + 2.0 * f_k[2, k] + f_k[3, k])
        if is_on:
            for k in range(count):
                new_w = modes.full[k, 0, 0] * w[k] + modes.full[k, 0, 1] * wd[k]
                new_wd = modes.full[k, 1, 0] * w[k] + modes.full[k, 1, 1] * wd[k]
                middle = p_k[1, k] + p_k[2, k]
                g = modes.weights[k]
                new_w += g[0, 0] * p_k[0, k] + g[1, 0] * middle + g[2, 0] * p_k[3, k]
                new_wd += g[0, 1] * p_k[0, k] + g[1, 1] * middle + g[2, 1] * p_k[3, k]
                w[k], wd[k] = new_w, new_wd
