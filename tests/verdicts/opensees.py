"""Crossings whose bridge is a finite-element model of OpenSeesPy, a program by others.

The bridge is marched by OpenSees (constant average acceleration), the truck by its exact response
to profiles that are linear within a step; they exchange contact forces and deflections, the latter
predicted from displacement and velocity of the step before. Nothing of it is shared with the
simulation or the model of this project: sums of sines for the road, beam or shell elements by
others, forces that enter by their cubic shape functions.

OpenSeesPy is free for research, education and internal use; it is needed by these tests alone.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from schemas.site import Site
from services.common.arrays import Floats

STEP_S, EVERY = 0.5e-3, 2
"""Time step, and its multiple at which the sensors are read (1 kHz)."""
SPEED_M_PER_S = 10.0
BEFORE_M, AFTER_M = 60.0, 40.0
TRACK_M = 2.0
_GRAVITY = 9.80665
_BEGIN_S = 1_790_000_000.0
_WAVES = np.linspace(0.02, 4.0, 400)
"""Spatial frequencies of the road in cycles/m."""
_CLASS_A_M3 = 16e-6
"""Displacement spectrum of ISO 8608, class A, at 0.1 cycles/m."""
_YOUNG_N_PER_M2 = 3.5e10
_PER_ELEMENT = 4
"""Shells along each element of EI; across there is one a metre."""


class Deck(NamedTuple):
    """A bridge in OpenSees: nodes along each line of wheels, and the share of the load on each."""

    x_m: Floats
    """Chainages (n,) of the nodes."""
    lines: NDArray[np.int64]
    """Node numbers (lines, n)."""
    vertical: int
    """Degree of freedom of the deflection, counted from one."""
    rotation: int
    slope: float
    """Derivative of the deflection by the chainage for a unit of that rotation: 1 or -1."""


class Truck(NamedTuple):
    """Linear response of a half-car: state (8,), profiles (2,) under the axles."""

    state: Floats  # (8, 8)
    profile: Floats  # (8, 2)
    advance: Floats  # (8, 8) over one step
    from_begin: Floats  # (8, 2): response to the profile at the begin of the step, and at its end
    from_end: Floats
    static_n: Floats  # (2,)
    tyre_n_per_m: Floats  # (2,)
    arms_m: Floats
    """Distances (2,) from the body's centre of gravity, the front one positive."""


def beam(ops: Any, site: Site, ratios: Floats) -> Deck:
    """Build a simply supported beam of 70 elements in OpenSees."""
    (bridge,) = site.bridges
    _new_model(ops, 2, 3)
    per_element = 70 // ratios.size
    count = per_element * ratios.size
    x = np.linspace(0.0, bridge.span_m, count + 1)
    for k, place in enumerate(x):
        ops.node(k + 1, float(place), 0.0)
    ops.fix(1, 1, 1, 0)
    ops.fix(count + 1, 0, 1, 0)
    ops.geomTransf("Linear", 1)
    inertia = np.array(bridge.nominal_flexural_rigidity_nm2) * ratios / _YOUNG_N_PER_M2
    for k in range(count):
        ops.element(
            *("elasticBeamColumn", k + 1, k + 1, k + 2, 1.0, _YOUNG_N_PER_M2),
            *(float(inertia[k // per_element]), 1),
            *("-mass", bridge.mass_per_length_kg_per_m, "-cMass"),
        )
    _analyse(ops, site)
    return Deck(x, np.arange(1, count + 2)[None, :], 2, 3, 1.0)


def plate(ops: Any, site: Site, ratios: Floats, width_m: float, lane_m: float = 0.0) -> Deck:
    """Build a plate of shells on two line supports in OpenSees, the lane `lane_m` off its axis.

    Without lateral contraction its flexural rigidity along the axis is that of the beam.
    """
    (bridge,) = site.bridges
    _new_model(ops, 3, 6)
    along, across = _PER_ELEMENT * ratios.size, round(width_m)
    x = np.linspace(0.0, bridge.span_m, along + 1)
    y = np.linspace(-0.5, 0.5, across + 1) * width_m
    number = 1 + np.arange(x.size * y.size).reshape(x.size, y.size)
    for i, j in np.ndindex(number.shape):
        ops.node(int(number[i, j]), float(x[i]), float(y[j]), 0.0)
        # In-plane motion does not matter; both ends are free to rotate about their line.
        ops.fix(int(number[i, j]), 1, 1, int(i in (0, along)), 0, 0, 1)
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2)
    depth = np.cbrt(12.0 * nominal * ratios / (_YOUNG_N_PER_M2 * width_m))
    density = bridge.mass_per_length_kg_per_m / (width_m * depth)
    for e in range(ratios.size):
        ops.section(
            *("ElasticMembranePlateSection", e + 1, _YOUNG_N_PER_M2, 0.0),
            *(float(depth[e]), float(density[e])),
        )
    for i, j in np.ndindex(along, across):
        corners = number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]
        ops.element("ShellMITC4", 1 + i * across + j, *map(int, corners), 1 + i // _PER_ELEMENT)
    _analyse(ops, site)
    wheels = [int(np.argmin(np.abs(y - lane_m - side * TRACK_M / 2))) for side in (-1, 1)]
    return Deck(x, number[:, wheels].T, 3, 5, -1.0)


def _new_model(ops: Any, dimensions: int, freedoms: int) -> None:
    ops.wipe()
    ops.model("basic", "-ndm", dimensions, "-ndf", freedoms)


def _analyse(ops: Any, site: Site) -> None:
    (bridge,) = site.bridges
    ops.rayleigh(bridge.rayleigh_alpha_per_s, bridge.rayleigh_beta_s, 0.0, 0.0)
    ops.timeSeries("Constant", 1)
    ops.constraints("Plain")
    ops.numberer("RCM")
    ops.system("BandGeneral")
    ops.integrator("Newmark", 0.5, 0.25)
    ops.algorithm("Linear", "-factorOnce")
    ops.analysis("Transient")


def half_car(site: Site) -> Truck:
    """Return the site's truck, with its exact response over one step."""
    vehicle = site.vehicles[0]
    length, d_1 = vehicle.wheelbase_m, vehicle.front_axle_to_cg_m
    arms = np.array([d_1, d_1 - length])
    unsprung = np.array(vehicle.unsprung_mass_kg)
    body = vehicle.total_mass_kg - unsprung.sum()
    spring = np.array(vehicle.suspension_stiffness_n_per_m)
    damper = np.array(vehicle.suspension_damping_ns_per_m)
    tyre = np.array(vehicle.tyre_stiffness_n_per_m)
    # Strokes of the springs from heave, pitch and both axles.
    stroke = np.column_stack([-np.ones(2), -arms, np.eye(2)])
    mass = np.diag([body, body * d_1 * (length - d_1), *unsprung])
    stiffness = stroke.T @ np.diag(spring) @ stroke
    stiffness[2:, 2:] += np.diag(tyre)
    damping = stroke.T @ np.diag(damper) @ stroke
    inverse = np.linalg.inv(mass)
    state = np.zeros((8, 8))
    state[:4, 4:] = np.eye(4)
    state[4:, :4], state[4:, 4:] = -inverse @ stiffness, -inverse @ damping
    profile = np.zeros((8, 2))
    profile[6:] = np.diag(tyre / unsprung)
    # The profile and its slope as states: exact for a profile that is linear within the step.
    whole = np.zeros((12, 12))
    whole[:8, :8], whole[:8, 8:10] = state, profile
    whole[8:10, 10:] = np.eye(2)
    moved = expm(whole * STEP_S)
    from_slope = moved[:8, 10:] / STEP_S
    static = _GRAVITY * (body * np.array([length - d_1, d_1]) / length + unsprung)
    return Truck(
        *(state, profile, moved[:8, :8], moved[:8, 8:10] - from_slope, from_slope),
        *(static, tyre, arms),
    )


def road(seed: int) -> Callable[[Floats], Floats]:
    """Return a profile of class A as a sum of sines: heights (n,) in m at chainages (n,)."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES.size)
    density = _CLASS_A_M3 * (_WAVES / 0.1) ** -2
    size = np.sqrt(2.0 * density * (_WAVES[1] - _WAVES[0]))

    def heights(x: Floats) -> Floats:
        return np.asarray(np.cos(2.0 * np.pi * np.outer(x, _WAVES) + phase) @ size)

    return heights


def _hermite(deck: Deck, x: float) -> tuple[int, Floats]:
    """Return the element at x, and the deflection there by its ends' deflections and slopes."""
    k = min(int(np.searchsorted(deck.x_m, x, side="right")) - 1, deck.x_m.size - 2)
    length = float(deck.x_m[k + 1] - deck.x_m[k])
    s = (x - float(deck.x_m[k])) / length
    return k, np.array(
        [
            1.0 - 3.0 * s**2 + 2.0 * s**3,
            length * (s - 2.0 * s**2 + s**3),
            3.0 * s**2 - 2.0 * s**3,
            length * (s**3 - s**2),
        ]
    )


def _predicted_m(ops: Any, deck: Deck, x: float) -> float:
    """Return the mean deflection under the wheels at x, one step after the last one."""
    k, shape = _hermite(deck, x)
    total = 0.0
    for line in deck.lines:
        ends = []
        for node in line[k : k + 2]:
            for freedom, sign in ((deck.vertical, 1.0), (deck.rotation, deck.slope)):
                moved = ops.nodeDisp(int(node), freedom)
                ends.append(sign * (moved + STEP_S * ops.nodeVel(int(node), freedom)))
        total += float(shape @ ends)
    return total / len(deck.lines)


def _apply(ops: Any, deck: Deck, x: float, force_n: float) -> None:
    """Load the bridge with a force at x, shared by the wheels."""
    k, shape = _hermite(deck, x)
    shape = -force_n / len(deck.lines) * shape
    freedoms = ops.getNDF()[0]
    for line in deck.lines:
        for end in range(2):
            load = [0.0] * freedoms
            load[deck.vertical - 1] = float(shape[2 * end])
            load[deck.rotation - 1] = float(deck.slope * shape[2 * end + 1])
            ops.load(int(line[k + end]), *load)


def crossing_files(
    ops: Any, deck: Deck, site: Site, folder: Path, seed: int, noise_ug_per_rthz: float = 25.0
) -> None:
    """Simulate one run over a bridge in OpenSees, and write its CSV files into the folder."""
    truck, span = half_car(site), site.bridges[0].span_m
    wheelbase = site.vehicles[0].wheelbase_m
    steps = round((BEFORE_M + span + wheelbase + AFTER_M) / (SPEED_M_PER_S * STEP_S))
    front = -BEFORE_M + SPEED_M_PER_S * STEP_S * np.arange(steps, dtype=np.float64)
    heights = road(seed)
    at_axles = np.column_stack([heights(front), heights(front - wheelbase)])
    state = np.zeros(8)
    # On its springs at rest on the first profile: its transient is over long before the bridge.
    state[:4] = at_axles[0].mean()
    profile = at_axles[0]
    acceleration = np.zeros((steps, 4))
    for n in range(1, steps):
        places = front[n] - np.array([0.0, wheelbase])
        on = (places > 0.0) & (places < span)
        under = at_axles[n].copy()
        for axle in np.flatnonzero(on):
            under[axle] += _predicted_m(ops, deck, float(places[axle]))
        state = truck.advance @ state + truck.from_begin @ profile + truck.from_end @ under
        profile = under
        if front[n] > 0.0 and places[1] < span:
            ops.pattern("Plain", 1, 1)
            force = truck.static_n + truck.tyre_n_per_m * (profile - state[2:4])
            for axle in np.flatnonzero(on):
                _apply(ops, deck, float(places[axle]), float(force[axle]))
            assert ops.analyze(1, STEP_S) == 0
            ops.remove("loadPattern", 1)
        motion = (truck.state @ state + truck.profile @ profile)[4:]
        acceleration[n] = [*(motion[0] + truck.arms_m * motion[1]), *motion[2:]]
    _write(site, folder, front[::EVERY], acceleration[::EVERY], seed, noise_ug_per_rthz)


def _write(
    site: Site, folder: Path, front_m: Floats, acceleration: Floats, seed: int, noise_ug: float
) -> None:
    rng = np.random.default_rng([seed, 1])
    apart = EVERY * STEP_S
    noise = noise_ug * 1e-6 * _GRAVITY * np.sqrt(0.5 / apart)
    time = _BEGIN_S + apart * np.arange(front_m.size)
    # The first second has the transient of the truck.
    kept = slice(round(1.0 / apart), None)
    rows = np.column_stack([time, acceleration + noise * rng.standard_normal(acceleration.shape)])
    heading = "time_s,sprung_front,sprung_rear,unsprung_front,unsprung_rear"
    _csv(folder / "accel_01.csv", heading, rows[kept], ["%.6f", *["%.9g"] * 4])
    fixes = np.arange(round(1.0 / apart), front_m.size, round(0.1 / apart))
    (bridge,) = site.bridges
    share = (
        front_m[fixes] + 0.05 * rng.standard_normal() + 0.005 * rng.standard_normal(fixes.size)
    ) / bridge.span_m
    begin = np.array([bridge.start_latitude_deg, bridge.start_longitude_deg])
    end = np.array([bridge.end_latitude_deg, bridge.end_longitude_deg])
    place = begin + share[:, None] * (end - begin)
    speed = SPEED_M_PER_S + 0.02 * rng.standard_normal(fixes.size)
    rows = np.column_stack([time[fixes], place, np.full(fixes.size, 30.0), speed])
    heading = "time_s,latitude_deg,longitude_deg,altitude_m,speed_mps"
    _csv(folder / "gps_01.csv", heading, rows, ["%.3f", "%.10f", "%.10f", "%.2f", "%.3f"])


def _csv(path: Path, heading: str, rows: Floats, formats: list[str]) -> None:
    np.savetxt(path, rows, formats, delimiter=",", header=heading, comments="")
