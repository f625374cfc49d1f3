"""Physical bounds of a site file: values that no truck, bridge or sensor can have are refused.

The bounds are generous, for a laboratory model is a bridge too; `driveby check` reports unlikely
values. Most bounds hold for ratios of quantities, such as natural frequencies and damping ratios.
The message gives the resulting range of the key that violates one.
"""

import math
from typing import TYPE_CHECKING, Final

from schemas.site_errors import error_at

if TYPE_CHECKING:
    from schemas.site import Bridge, Receiver, Sensor
    from schemas.site_vehicle import Vehicle

_G_M_PER_S2: Final = 9.80665
_SMALLEST_MASS_KG: Final = 0.1
_MASS_PER_LENGTH_KG_PER_M: Final = (0.01, 1e6)
_SMALLEST_AXLE: Final = 1e-3
"""Smallest share of the truck's mass in one axle, and in the body."""
_SMALLEST_LOAD: Final = 0.01
"""Smallest share of the weight on one axle."""
_SPRING_HZ: Final = (0.1, 300.0)
"""Natural frequency of the body on an axle's springs; at 0.1 Hz it sags by 25 m under its weight.
"""
_TYRE_HZ: Final = (0.1, 1000.0)
"""Natural frequency: lower bound for the body on the tyres, upper bound for the axle on them."""
_MAX_DAMPING: Final = 20.0
"""Largest damping ratio of a suspension and of a tyre."""
_WAVE_SPEED_M_PER_S: Final = 6000.0
"""Largest wave speed of bridge materials: 5100 in steel, 4000 in concrete."""
_GYRATION: Final = 0.25
"""Largest radius of gyration over the span: a truss half as deep as it is long."""
_SAG: Final = 0.1
"""Largest deflection under self-weight over the span; 1/100 and less in real bridges."""
_SHORTEST_PART: Final = 1e-3
"""Smallest length of an element over the span, and of a span over the bridge."""
_SUPPORT_SPRING: Final = (1e-6, 1e6)
"""Bounds of a rotational restraint over EI / span."""
_SMALLEST_COMPLIANCE_M_PER_N: Final = 1e-15
_SLOWEST_RATE_HZ: Final = 10.0
_LARGEST_POSITION_M: Final = 100.0
_LARGEST_SPEED_M_PER_S: Final = 10.0
_TYRE_M: Final = (1e-3, 2.0)
_LIGHTEST_DECK_KG_PER_M, _SHORTEST_BRIDGE_M = 100.0, 5.0
"""A deck of less is a laboratory's, and these are shorter."""
_USUAL_DAMPING: Final = (0.002, 0.15)
_SLIPS: Final[dict[str, dict[str, float]]] = {
    "N/m": {"kN/m": 1e3},
    "N·s/m": {"kN·s/m": 1e3},
    "N·m²": {"kN·m²": 1e3, "MN·m²": 1e6, "GN·m²": 1e9},
    "kg": {"t": 1e3},
    "kg/m": {"t/m": 1e3},
    "m": {"cm": 1e-2, "mm": 1e-3},
}
"""Units in which values are written by mistake, with their factors, by the unit of a key."""


def check_vehicle(vehicle: "Vehicle") -> None:
    """Raise an error for the first key whose value no truck can have."""
    total = vehicle.total_mass_kg
    _check("total_mass_kg", total, (_SMALLEST_MASS_KG, 1e6), "a mass", "kg")
    wheelbase = vehicle.wheelbase_m
    _check("wheelbase_m", wheelbase, (0.05, 30.0), "a length", "m")
    _check(
        "front_axle_to_cg_m",
        vehicle.front_axle_to_cg_m,
        (_SMALLEST_LOAD * wheelbase, (1.0 - _SMALLEST_LOAD) * wheelbase),
        "a length",
        "m",
        "each axle carries a part of the truck",
    )
    _check("pitch_inertia_ratio", vehicle.pitch_inertia_ratio, (0.01, 10.0), "a number")
    for k, mass in enumerate(vehicle.unsprung_mass_kg):
        limits = (_SMALLEST_AXLE * total, (1.0 - _SMALLEST_AXLE) * total)
        _check(f"unsprung_mass_kg.{k}", mass, limits, "a mass", "kg", f"the truck has {total:g} kg")
    if vehicle.sprung_mass_kg < _SMALLEST_AXLE * total:
        raise error_at(
            "unsprung_mass_kg",
            f"adds up to {sum(vehicle.unsprung_mass_kg):g}, it must be a mass of at most "
            f"{(1.0 - _SMALLEST_AXLE) * total:g} kg: a part of the truck is on springs",
        )
    loads = (vehicle.cg_to_rear_axle_m / wheelbase, vehicle.front_axle_to_cg_m / wheelbase)
    for k in range(2):
        _check_axle(vehicle, k, vehicle.sprung_mass_kg * loads[k])
    for key in ("tyre_width_m", "tyre_contact_length_m"):
        for k, value in enumerate(getattr(vehicle, key) or ()):
            _check(f"{key}.{k}", value, _TYRE_M, "a length", "m")
    for k, value in enumerate(vehicle.twin_tyre_distance_m or ()):
        _check(f"twin_tyre_distance_m.{k}", value, (0.0, _TYRE_M[1]), "a length", "m")
    for k, value in enumerate(vehicle.track_m or ()):
        _check(f"track_m.{k}", value, (0.02, 5.0), "a length", "m")


def _check_axle(vehicle: "Vehicle", k: int, body_kg: float) -> None:
    """Raise if springs, tyres or dampers of an axle that carries `body_kg` are impossible."""
    axle_kg = vehicle.unsprung_mass_kg[k]
    spring, tyre = vehicle.suspension_stiffness_n_per_m[k], vehicle.tyre_stiffness_n_per_m[k]
    low, high = (_stiffness(body_kg, hz) for hz in _SPRING_HZ)
    because = f"{body_kg:.3g} kg swing on it at {_SPRING_HZ[0]:g} to {_SPRING_HZ[1]:g} Hz"
    key = f"suspension_stiffness_n_per_m.{k}"
    _check(key, spring, (low, high), "a stiffness", "N/m", because)
    low, high = _stiffness(body_kg, _TYRE_HZ[0]), _stiffness(axle_kg, _TYRE_HZ[1])
    because = f"an axle of {axle_kg:.3g} kg swings on it at {_TYRE_HZ[1]:g} Hz at most"
    _check(f"tyre_stiffness_n_per_m.{k}", tyre, (low, high), "a stiffness", "N/m", because)
    because = f"the damping ratio is {_MAX_DAMPING:g} then"
    for key, damping, stiffness, mass in (
        ("suspension_damping_ns_per_m", vehicle.suspension_damping_ns_per_m[k], spring, body_kg),
        ("tyre_damping_ns_per_m", vehicle.tyre_damping_ns_per_m[k], tyre, axle_kg),
    ):
        most = 2.0 * _MAX_DAMPING * math.sqrt(stiffness * mass)
        _check(f"{key}.{k}", damping, (0.0, most), "a damping", "N·s/m", because)


def check_bridge(bridge: "Bridge") -> None:
    """Raise an error for the first key whose value no bridge can have."""
    _check("span_m", bridge.span_m, (0.1, 1000.0), "a length", "m")
    mass = bridge.mass_per_length_kg_per_m
    key = "mass_per_length_kg_per_m"
    _check(key, mass, _MASS_PER_LENGTH_KG_PER_M, "a mass per length", "kg/m")
    shortest = _SHORTEST_PART * bridge.span_m
    for k, length in enumerate(bridge.element_lengths_m or ()):
        _check(f"element_lengths_m.{k}", length, (shortest, bridge.span_m), "a length", "m")
    for k, support in enumerate(bridge.interior_supports_m):
        before = (0.0, *bridge.interior_supports_m)[k]
        limits = (before + shortest, bridge.span_m - shortest)
        _check(f"interior_supports_m.{k}", support, limits, "a chainage", "m")
    span = max(bridge.lengths_of_spans_m)
    limits = _rigidities(span, mass)
    low_hz, high_hz = (_first_hz(span, mass, rigidity) for rigidity in limits)
    because = f"{span:g} m of {mass:g} kg/m swing at {low_hz:.2g} to {high_hz:.3g} Hz"
    if mass < _LIGHTEST_DECK_KG_PER_M and span > _SHORTEST_BRIDGE_M:
        because += f"; or is mass_per_length_kg_per_m in t/m? then it is {1e3 * mass:g}"
    single = "flexural_rigidity_nm2"
    if bridge.flexural_rigidity_nm2 is not None:
        value = bridge.flexural_rigidity_nm2
        _check(single, value, limits, "a flexural rigidity", "N·m²", because)
    for k, value in enumerate(bridge.flexural_rigidity_per_element_nm2 or ()):
        key = f"flexural_rigidity_per_element_nm2.{k}"
        _check(key, value, limits, "a flexural rigidity", "N·m²", because)
    nominal = bridge.nominal_flexural_rigidity_nm2
    mean = math.exp(math.fsum(map(math.log, nominal)) / len(nominal))
    first_hz = _first_hz(span, mass, mean)
    omega = 2.0 * math.pi * first_hz
    because = f"beyond it the first mode, {first_hz:.2g} Hz, does not swing"
    because += _damping_meant(bridge.rayleigh_alpha_per_s, bridge.rayleigh_beta_s, omega)
    for key, value, most, noun, unit in (
        ("rayleigh_alpha_per_s", bridge.rayleigh_alpha_per_s, 2.0 * omega, "a coefficient", "1/s"),
        ("rayleigh_beta_s", bridge.rayleigh_beta_s, 2.0 / omega, "a time", "s"),
    ):
        _check(key, value, (0.0, most), noun, unit, because)
    if bridge.support_rotational_stiffness_spread_nm_per_rad is not None:
        key = "support_rotational_stiffness_spread_nm_per_rad"
        low, high = (share * mean / span for share in _SUPPORT_SPRING)
        _check(key, getattr(bridge, key), (low, high), "a rotational stiffness", "N·m/rad")
    key = "support_compliance_spread_m_per_n"
    _check(key, getattr(bridge, key), (_SMALLEST_COMPLIANCE_M_PER_N, 1e-6), "a compliance", "m/N")


def in_tonnes(mass_kg: float) -> str:
    """Return a hint that a mass of a truck may be in t; empty where it may not."""
    return f"; in t? then it is {1e3 * mass_kg:g}" if 1.0 <= mass_kg <= 100.0 else ""


def _damping_meant(alpha: float, beta: float, omega: float) -> str:
    """Return a hint what coefficients of damping may be; empty where it is not known."""
    swapped = 0.5 * (beta / omega + alpha * omega)
    if alpha and _USUAL_DAMPING[0] <= swapped <= _USUAL_DAMPING[1]:
        return "; swapped with the other coefficient?"
    if beta < 0.2:
        return f"; a damping ratio? then it is {2.0 * beta / omega:.3g} s"
    if beta <= 20.0:
        return f"; a damping ratio in %? then it is {0.02 * beta / omega:.3g} s"
    return ""


def check_sensor(sensor: "Sensor") -> "Sensor":
    """Return the sensor; raise if no accelerometer has such a rate."""
    for rate in sensor.rate_hz:
        if rate < _SLOWEST_RATE_HZ:
            raise error_at(
                "rate_hz",
                f"is {rate:g}, it must be a rate of at least {_SLOWEST_RATE_HZ:g} Hz (Hz, not kHz)",
            )
    return sensor


def check_receiver(receiver: "Receiver") -> "Receiver":
    """Return the receiver; raise if its errors exceed the length of a bridge."""
    for key in ("position_spread_m", "position_noise_m"):
        _check(key, getattr(receiver, key), (0.0, _LARGEST_POSITION_M), "a length", "m")
    key = "speed_noise_m_per_s"
    _check(key, receiver.speed_noise_m_per_s, (0.0, _LARGEST_SPEED_M_PER_S), "a speed", "m/s")
    return receiver


def _stiffness(mass_kg: float, frequency_hz: float) -> float:
    return mass_kg * (2.0 * math.pi * frequency_hz) ** 2


def _first_hz(span_m: float, mass_kg_per_m: float, rigidity_nm2: float) -> float:
    """Return the first natural frequency of a simply supported beam."""
    return math.pi / (2.0 * span_m**2) * math.sqrt(rigidity_nm2 / mass_kg_per_m)


def _rigidities(span_m: float, mass_kg_per_m: float) -> tuple[float, float]:
    """Return the EI at which a beam sags by a tenth of its span, and of the stiffest section."""
    least = 5.0 * mass_kg_per_m * _G_M_PER_S2 * span_m**3 / (384.0 * _SAG)
    return least, mass_kg_per_m * (_WAVE_SPEED_M_PER_S * _GYRATION * span_m) ** 2


def _check(
    path: str,
    value: float,
    limits: tuple[float, float],
    noun: str,
    unit: str = "",
    because: str = "",
) -> None:
    low, high = limits
    if low <= value <= high:
        return
    reach = f"from {low:.4g} to {high:.4g} {unit}".rstrip()
    reason = f": {because}" if because else ""
    meant = next((u for u, f in _SLIPS.get(unit, {}).items() if low <= value * f <= high), None)
    if meant is not None:
        reason += f"; in {meant}? then it is {value * _SLIPS[unit][meant]:g}"
    raise error_at(path, f"is {value:g}, it must be {noun} {reach}{reason}")
