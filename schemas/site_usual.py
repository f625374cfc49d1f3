"""Usual ranges of what a site file implies: frequencies, damping, deflection; and likely slips.

What no truck or bridge can have is refused (`site_vehicle`, `site_bridge`). What is only unlikely
is named here, with the value that was probably meant: a stiffness in kN/m for N/m, a mass in t, a
damping ratio for a Rayleigh coefficient.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final, NamedTuple

from schemas.site import Bridge, Sensor, Site, Vehicle
from schemas.site_damping import rayleigh_of
from schemas.site_frequency import first_frequency_hz, given_frequencies
from schemas.site_implied import MAX_BRIDGES, ImpliedQuantity
from schemas.site_physics import G_M_PER_S2
from schemas.site_vehicle import TOTAL_T

_FIRST_HZ: Final = (0.25, 4.0)
"""First natural frequency relative to 100 Hz/L, L in m: a rule of thumb for road bridges."""
_DAMPING: Final = (0.002, 0.15)
_DEFLECTION: Final = (0.0, 1.0 / 250.0)
"""Deflection relative to the span, under the truck at rest in the middle."""
_BOUNCE_HZ: Final = (0.7, 6.0)
_PITCH_HZ: Final = (0.5, 10.0)
_HOP_HZ: Final = (4.0, 40.0)
_SUSPENSION: Final = (0.01, 1.5)
"""Damping ratio of the body on its springs."""
_NOISE_UG: Final = (0.5, 5000.0)

_STIFFNESS: Final = (("kN/m", 1e3), ("N/m times 1000", 1e-3))
_TYRE_OVER_SPRING: Final = (0.9, 25.0)
_FRONT_OVER_REAR: Final = (0.15, 2.5)
"""Ratio, front to rear, of a spring's stiffness to the mass on it: rear springs carry the load."""
_AXLE_OVER_REAR: Final = (0.3, 1.4)
_LOADS_REVERSED: Final = (2.0, 0.4)
"""Smallest factor between the ratio of the axle loads and that for which springs, tyres and axles
are made, and the largest share of its logarithm that remains if the loads are swapped."""
_RATIO_AS_ALPHA: Final = (0.003, 0.1)
"""Values of alpha in 1/s that are damping ratios of bridges."""
_IDLE: Final = 0.25
"""Ratio of alpha's damping of the first mode to beta's, below which alpha has no effect."""
_ELEMENT_M: Final = 4.5
"""Usual length of an element."""
_TYRE_WIDTH_M: Final = (0.1, 0.6)
_TWIN_M: Final = (0.2, 0.6)
_TRACK_M: Final = (1.0, 2.6)
_AXLE_T: Final = (0.05, 5.0)
"""Mass of an axle with its wheels in t."""
_SURVEY_M_PER_S: Final = (3.0, 30.0)
_RIGIDITY: Final = (("kN·m²", 1e3), ("MN·m²", 1e6), ("GN·m²", 1e9))


class Slip(NamedTuple):
    """A key whose value may be in another unit, and its effect on an implied quantity."""

    key: str
    value: float
    quantity: Callable[[float], float]
    """Function from a factor of `value` to the implied quantity."""
    units: tuple[tuple[str, float], ...]
    """Possible units with their factors."""


def implied_by(site: Site, vehicle: Vehicle) -> Iterator[ImpliedQuantity]:
    """Yield what a site file implies of a truck, its sensors and the bridges under it."""
    yield from of_truck(vehicle)
    yield from of_sensors(site.sensor, vehicle)
    for bridge in site.bridges[:MAX_BRIDGES]:
        yield from of_bridge(bridge, vehicle)


def warnings_of(site: Site, toml_text: str = "") -> list[str]:
    """Return a line for everything that is unusual in a site, and in its text if it is given."""
    found = [one for vehicle in site.vehicles for one in implied_by(site, vehicle)]
    found += given_frequencies(toml_text)
    return list(dict.fromkeys(f"{one.text}; {one.advice}" for one in found if one.is_unusual))


def of_truck(vehicle: Vehicle) -> Iterator[ImpliedQuantity]:
    """Yield bounce, pitch and wheel hop of a truck, and the damping of its springs."""
    base = vehicle.wheelbase_m
    arms = (vehicle.front_axle_to_cg_m, vehicle.cg_to_rear_axle_m)
    loads = (arms[1] / base, arms[0] / base)
    springs, tyres = vehicle.suspension_stiffness_n_per_m, vehicle.tyre_stiffness_n_per_m
    axles, total = vehicle.unsprung_mass_kg, vehicle.total_mass_kg
    for k, where in enumerate(("front", "rear")):
        body = vehicle.sprung_mass_kg * loads[k]
        key = f"suspension_stiffness_n_per_m[{k}]"
        value = _hz(springs[k], body)
        slips: tuple[Slip, ...] = (
            *_in_tonnes("total_mass_kg", total, TOTAL_T, value),
            Slip(key, springs[k], _power(value, 0.5), _STIFFNESS),
        )
        text = f"{vehicle.id}: body bounces at {value:.3g} Hz on its {where} springs"
        yield _implied(f"bounce_{where}", text, value, _BOUNCE_HZ, "Hz", slips)
        damping = vehicle.suspension_damping_ns_per_m[k]
        value = damping / (2.0 * math.sqrt(springs[k] * body))
        text = f"{vehicle.id}: damping ratio {value:.3g} of the body on its {where} springs"
        critical = 2.0 * math.sqrt(springs[k] * body)
        slips = (
            *_in_tonnes("total_mass_kg", total, TOTAL_T, value),
            Slip(
                f"suspension_damping_ns_per_m[{k}]",
                damping,
                _power(value, 1.0),
                (("kN·s/m", 1e3), ("N·s/mm", 1e3), *_as_ratio(damping, critical)),
            ),
            Slip(key, springs[k], _power(value, -0.5), _STIFFNESS),
        )
        yield _implied(f"suspension_damping_{where}", text, value, _SUSPENSION, "", slips)
        axle, tyre = axles[k], tyres[k]
        value = _hz(springs[k] + tyre, axle)
        text = f"{vehicle.id}: {where} axle hops at {value:.3g} Hz on its tyres"
        slips = (
            *_in_tonnes(f"unsprung_mass_kg[{k}]", axle, _AXLE_T, value),
            Slip(
                f"tyre_stiffness_n_per_m[{k}]",
                tyre,
                partial(_hop_hz, springs[k], tyre, axle),
                _STIFFNESS,
            ),
        )
        yield _implied(f"hop_{where}", text, value, _HOP_HZ, "Hz", slips)
    inertia = vehicle.pitch_inertia_ratio * vehicle.sprung_mass_kg * arms[0] * arms[1]
    value = _hz(springs[0] * arms[0] ** 2 + springs[1] * arms[1] ** 2, inertia)
    text = f"{vehicle.id}: body pitches at {value:.3g} Hz"
    yield _implied(
        "pitch", text, value, _PITCH_HZ, "Hz", _in_tonnes("total_mass_kg", total, TOTAL_T, value)
    )
    yield from _odd(_loads(vehicle))
    yield from _odd(_pairs(vehicle, loads))
    yield from _odd(_tyres(vehicle))


def _loads(vehicle: Vehicle) -> Iterator[ImpliedQuantity]:
    """Yield loads that fit springs, tyres and axle masses only if front and rear are swapped."""
    pairs = (
        vehicle.suspension_stiffness_n_per_m,
        vehicle.tyre_stiffness_n_per_m,
        vehicle.unsprung_mass_kg,
    )
    made_for = math.prod(rear / front for front, rear in pairs) ** (1.0 / len(pairs))
    loads = vehicle.front_axle_to_cg_m / vehicle.cg_to_rear_axle_m
    apart, reversed_apart = math.log(made_for / loads), math.log(made_for * loads)
    factor, left = _LOADS_REVERSED
    if abs(reversed_apart) > left * abs(apart):
        return
    text = (
        f"{vehicle.id}: rear over front spring load {loads:.2g}, but springs, tyres and axle "
        f"masses suit {made_for:.2g}, {made_for / loads:.2g} times as much"
    )
    meant = (
        f"front_axle_to_cg_m is {vehicle.front_axle_to_cg_m:g}: measured from the rear axle? then "
        f"it is {vehicle.cg_to_rear_axle_m:.4g}"
    )
    yield ImpliedQuantity("loads_reversed", text, math.exp(apart), 1.0 / factor, factor, "", meant)


def _pairs(vehicle: Vehicle, loads: tuple[float, float]) -> Iterator[ImpliedQuantity]:
    """Yield ratios of a truck's pairs, which show swapped values."""
    swapped = "[front, rear] swapped?"
    springs, tyres = vehicle.suspension_stiffness_n_per_m, vehicle.tyre_stiffness_n_per_m
    for key, pair in (("suspension_stiffness", springs), ("tyre_stiffness", tyres)):
        ratio = pair[0] / pair[1] * loads[1] / loads[0]
        text = f"{vehicle.id}: {key} over its load, front over rear, {ratio:.3g}"
        low, high = _FRONT_OVER_REAR
        yield ImpliedQuantity(key, text, ratio, low, high, "", f"{key}_n_per_m: {swapped}")
    ratio = vehicle.unsprung_mass_kg[0] / vehicle.unsprung_mass_kg[1]
    text = f"{vehicle.id}: front axle over rear axle, masses, {ratio:.3g}"
    low, high = _AXLE_OVER_REAR
    yield ImpliedQuantity("axle_masses", text, ratio, low, high, "", f"unsprung_mass_kg: {swapped}")
    ratio = min(tyre / spring for tyre, spring in zip(tyres, springs, strict=True))
    text = f"{vehicle.id}: tyres over springs, stiffness, {ratio:.3g}"
    low, high = _TYRE_OVER_SPRING
    meant = "tyre_stiffness_n_per_m and suspension_stiffness_n_per_m swapped?"
    yield ImpliedQuantity(
        "tyres_over_springs", text, ratio, low, high, "", meant if ratio < low else ""
    )


def _tyres(vehicle: Vehicle) -> Iterator[ImpliedQuantity]:
    """Yield widths and distances of tyres and wheels."""
    for key, pair, (low, high) in (
        ("tyre_width_m", vehicle.tyre_width_m, _TYRE_WIDTH_M),
        ("twin_tyre_distance_m", vehicle.twin_tyre_distance_m, _TWIN_M),
        ("track_m", vehicle.track_m, _TRACK_M),
    ):
        for value in dict.fromkeys(pair or ()):
            if value > 0.0:
                text = f"{vehicle.id}: {key} {value:g} m"
                yield ImpliedQuantity(key, text, value, low, high, "m", "")
    apart = vehicle.twin_tyre_distance_m
    if apart is not None and apart[0] > 0.0 == apart[1]:
        text = f"{vehicle.id}: twin tyres in front, single ones behind"
        meant = "twin_tyre_distance_m: [front, rear] swapped?"
        yield ImpliedQuantity("twin_tyres", text, 1.0, 0.0, 0.5, "", meant)


def _odd(found: Iterator[ImpliedQuantity]) -> Iterator[ImpliedQuantity]:
    """Yield what is unusual, never as certainly wrong: such trucks exist."""
    for one in found:
        if one.is_unusual:
            yield one._replace(is_certain=False)


def _in_tonnes(
    key: str, mass: float, usual_t: tuple[float, float], value: float
) -> tuple[Slip, ...]:
    """Return t as a unit of a mass that may be in t; `value` is proportional to its power -1/2."""
    is_likely = usual_t[0] <= mass <= usual_t[1]
    return (Slip(key, mass, _power(value, -0.5), (("t", 1e3),)),) if is_likely else ()


def _as_ratio(damping: float, critical: float) -> tuple[tuple[str, float], ...]:
    """Return a damping ratio as a unit of a damper, where the value may be one."""
    return (("parts of critical damping", critical),) if 0.0 < damping <= 1.5 else ()


def of_sensors(sensor: Sensor, vehicle: Vehicle) -> Iterator[ImpliedQuantity]:
    """Yield the noise densities that are unusual; 0 is a simulation without noise."""
    declared = tuple(one.noise_density_ug_per_rthz for one in vehicle.sensors)
    for density in dict.fromkeys(declared or sensor.noise_density_ug_per_rthz):
        units = (("mg/√Hz", 1e3), ("ng/√Hz", 1e-3), ("m/s²/√Hz", 1e6 / G_M_PER_S2))
        slips = (Slip("noise_density_ug_per_rthz", density, _power(density, 1.0), units),)
        text = f"{vehicle.id}: noise {density:.3g} µg/√Hz"
        found = _implied("noise_usual", text, density, _NOISE_UG, "µg/√Hz", slips)
        if density > 0.0 and found.is_unusual:
            yield found


def of_bridge(bridge: Bridge, vehicle: Vehicle) -> Iterator[ImpliedQuantity]:
    """Yield first frequency, damping and mesh of a bridge, and a truck's effect on it."""
    span, rigidity, mass = bridge.uniform()
    per_element = bridge.flexural_rigidity_per_element_nm2 is not None
    key = "flexural_rigidity_" + ("per_element_nm2" if per_element else "nm2")
    first_hz = first_frequency_hz(bridge)
    usual = 100.0 / span
    slips: tuple[Slip, ...] = (
        Slip(key, rigidity, _power(first_hz, 0.5), _RIGIDITY),
        Slip(
            "mass_per_length_kg_per_m",
            mass,
            _power(first_hz, -0.5),
            (("t/m", 1e3), ("kg of the whole span", 1.0 / bridge.span_m)),
        ),
    )
    text = f"{bridge.id}: first natural frequency {first_hz:.3g} Hz"
    limits = (_FIRST_HZ[0] * usual, _FIRST_HZ[1] * usual)
    yield _implied("first_frequency", text, first_hz, limits, "Hz", slips)
    yield _damping(bridge, first_hz)
    yield from _odd(_idle_alpha(bridge, first_hz))
    yield from _odd(_elements(bridge))
    weight = vehicle.total_mass_kg * G_M_PER_S2
    deflection = weight * span**3 / (48.0 * rigidity)
    slips = (Slip(key, rigidity, _power(deflection / span, -1.0), _RIGIDITY),)
    text = (
        f"{bridge.id}: deflects by {1e3 * deflection:.3g} mm under {vehicle.id} at rest, 1/"
        f"{span / deflection:.0f} of the span"
    )
    yield _implied("static_deflection", text, deflection / span, _DEFLECTION, "", slips)
    speed = bridge.survey_speed_m_per_s
    if speed is not None:
        low, high = _SURVEY_M_PER_S
        text = f"{bridge.id}: to be crossed at {speed:g} m/s"
        slips = (Slip("survey_speed_m_per_s", speed, _power(speed, 1.0), (("km/h", 1 / 3.6),)),)
        yield from _odd(
            iter([_implied("survey_speed_usual", text, speed, (low, high), "m/s", slips)])
        )
    ratio = vehicle.wheelbase_m / span
    text = f"{bridge.id}: wheelbase of {vehicle.id} is {ratio:.2g} of the span"
    yield _implied("wheelbase_over_span", text, ratio, (0.0, 1.0), "", ())


def _damping(bridge: Bridge, first_hz: float) -> ImpliedQuantity:
    """Return the damping ratio of the first mode; no damping at all is a simulation's."""
    omega = 2.0 * math.pi * first_hz
    alpha, beta = bridge.rayleigh_alpha_per_s, bridge.rayleigh_beta_s
    value = 0.5 * (alpha / omega + beta * omega)
    low, high = _DAMPING
    meant = ""
    if bridge.first_frequency_hz is not None:  # the coefficients are not in the site file
        ratio = alpha / rayleigh_of(1.0, bridge.first_frequency_hz)[0]
        if value > high:
            meant = f"damping_ratio is {ratio:.3g}: in %? then it is {ratio / 100.0:.3g}"
    elif value > high and low <= alpha / (2.0 * omega) + beta <= high:
        meant = (
            f"rayleigh_beta_s is {beta:g}: a damping ratio? then it is {2.0 * beta / omega:.3g} s"
        )
    elif 0.0 < value < low and low <= alpha + 0.5 * beta * omega <= high:
        meant = (
            f"rayleigh_alpha_per_s is {alpha:g}: a damping ratio? then it is "
            f"{2.0 * alpha * omega:.3g} 1/s"
        )
    elif value > high:
        larger = "rayleigh_beta_s" if beta * omega > alpha / omega else "rayleigh_alpha_per_s"
        meant = f"{larger} is too large"
    text = f"{bridge.id}: damping ratio {value:.3g} of the first mode"
    return ImpliedQuantity(
        "damping_ratio", text, value, low if value > 0.0 else 0.0, high, "", meant
    )


def _idle_alpha(bridge: Bridge, first_hz: float) -> Iterator[ImpliedQuantity]:
    """Yield an alpha that is a damping ratio by its size, and damps next to nothing."""
    omega = 2.0 * math.pi * first_hz
    alpha, beta = bridge.rayleigh_alpha_per_s, bridge.rayleigh_beta_s
    low, high = _RATIO_AS_ALPHA
    if not low <= alpha <= high or beta == 0.0:
        return
    share = alpha / (beta * omega**2)
    text = f"{bridge.id}: alpha over beta in the damping of the first mode {share:.2g}"
    probable = rayleigh_of(alpha, first_hz)[0]
    meant = f"rayleigh_alpha_per_s is {alpha:g}: a damping ratio? then it is {probable:.3g} 1/s"
    yield ImpliedQuantity("idle_alpha", text, share, _IDLE, math.inf, "", meant)


def _elements(bridge: Bridge) -> Iterator[ImpliedQuantity]:
    """Yield a bridge with one element for each span."""
    spans = len(bridge.lengths_of_spans_m)
    if bridge.elements > spans:
        return
    probable = sum(max(3, round(length / _ELEMENT_M)) for length in bridge.lengths_of_spans_m)
    text = f"{bridge.id}: {bridge.elements} elements over {spans} spans locate no weak element"
    if spans == 1:
        text = f"{bridge.id}: a single element locates no loss along the bridge"
    meant = f"elements is {bridge.elements}: {probable} are typical here"
    value = float(bridge.elements)
    yield ImpliedQuantity("elements", text, value, spans + 1.0, 3.0 * probable, "elements", meant)


def _implied(
    name: str,
    text: str,
    value: float,
    limits: tuple[float, float],
    unit: str,
    slips: tuple[Slip, ...],
) -> ImpliedQuantity:
    low, high = limits
    meant = "" if low <= value <= high else _meant(limits, slips)
    return ImpliedQuantity(name, text, value, low, high, unit, meant)


def _meant(limits: tuple[float, float], slips: tuple[Slip, ...]) -> str:
    """Return a hint at the first key that, in another unit, brings the quantity into its range."""
    for slip in slips:
        for unit, factor in slip.units:
            if limits[0] <= slip.quantity(factor) <= limits[1]:
                return (
                    f"{slip.key} is {slip.value:g}: in {unit}? then it is {slip.value * factor:g}"
                )
    return ""


def _power(value: float, exponent: float) -> Callable[[float], float]:
    """Return the function from a factor of a key's value to `value` times a power of the factor."""
    return lambda factor: value * factor**exponent


def _hop_hz(spring: float, tyre: float, axle_kg: float, factor: float) -> float:
    return _hz(spring + factor * tyre, axle_kg)


def _hz(stiffness: float, inertia: float) -> float:
    return math.sqrt(stiffness / inertia) / (2.0 * math.pi)
