"""Crossings of a site's truck with a tandem whose truth is drawn from the priors of the site.

The module is like `drawn`, with the simulation of left and right wheels: axles follow strips of a
2-D road surface, and springs may have friction. Bearings are rigid, and the receiver's latency has
its nominal value, because the simulation has no others.
"""

from typing import Final, NamedTuple

import numpy as np

from schemas.site import Site, Vehicle
from services.common.errors import InputError
from services.drives.runs import Run
from services.simulation.drawn import ChannelErrors, CrossingTruth
from services.simulation.drive_tandem import TandemDrive, tandem_case, truck_with_tandem
from services.simulation.wheel_paths import WANDER_M, SurfaceOptions
from services.simulation.wide_crossings import (
    SatelliteErrors,
    WideCase,
    WideDrivenRun,
    WideRun,
    WideSensor,
    drive_case,
)


class TandemEffects(NamedTuple):
    """Effects in truck and road that a site file does not declare."""

    friction_share: float = 0.0
    """Dry friction of the springs over their static load."""
    offset_m: float = 0.005
    """Lateral offset of the tandem's second axle."""
    outer_share: float = 0.5
    """Share of the outer twin tyre in a side's load."""
    wander_m: float = WANDER_M
    """Standard deviation of the lateral position between runs."""


USUAL: Final = TandemEffects()


class DrawnTandem(NamedTuple):
    """A drawn crossing."""

    case: WideCase
    site: Site
    """Declared site: nominal values, with noise and rate of the sensors."""
    driven: WideDrivenRun

    @property
    def recorded(self) -> tuple[Run, Site]:
        """The recorded run, and the site that declares its sensors."""
        return self.driven.run, self.site


def drawn_tandem(
    site: Site, truth: CrossingTruth, seed: int, truck_seed: int, effects: TandemEffects = USUAL
) -> DrawnTandem:
    """Simulate one crossing of the site's first truck, which has a tandem.

    `truth` is of `draw_truth`: its bridge, channels and conditions are used. The truck is drawn
    with `truck_seed`, noise, receiver and lateral position with `seed`. Raise InputError for a
    tandem without load equalisation.
    """
    vehicle, how = site.vehicles[0], truth.conditions
    if vehicle.tandem is None or not vehicle.tandem.is_equalised:
        raise InputError(
            f"{vehicle.id}: the axles of its tandem have springs of their own, only an equalised "
            "tandem is simulated"
        )
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x7A2F]))
    beam, bridge = truth.beam, site.bridges[0]
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2)
    drive = TandemDrive(
        (how.road_class, how.road_seed),
        how.noise_ug_per_rthz,
        rate_hz=how.rate_hz,
        has_receiver_errors=True,
        friction_share=effects.friction_share,
        support_springs=beam.support_rotational_stiffness_nm_per_rad,
        surface=SurfaceOptions(None, effects.offset_m, effects.wander_m),
    )
    case = tandem_case(site, beam.flexural_rigidity_nm2 / nominal, drive)
    truck = truck_with_tandem(drawn_vehicle(vehicle, truck_seed), drive)
    ahead = len(vehicle.tandem.front_axles)
    behind = [axle._replace(outer_share=effects.outer_share) for axle in truck.axles[ahead:]]
    receiver = site.receiver
    case = case._replace(
        seed=seed,
        truck=truck._replace(axles=(*truck.axles[:ahead], *behind)),
        deck=case.deck._replace(
            mass_per_length_kg_per_m=float(beam.mass_per_length_kg_per_m[0]),
            rayleigh_alpha_per_s=beam.rayleigh_alpha_per_s,
            rayleigh_beta_s=beam.rayleigh_beta_s,
        ),
        sensors=_with_errors(case.sensors, vehicle, truth.channels),
        runs=(
            WideRun(
                how.speed_m_per_s,
                how.forward,
                effects.wander_m * float(rng.standard_normal()),
                how.change_m_per_s,
                how.period_s,
            ),
        ),
        receiver=SatelliteErrors(
            receiver.position_spread_m, receiver.position_noise_m, receiver.speed_noise_m_per_s
        ),
    )
    rated = tuple(one.model_copy(update={"rate_hz": how.rate_hz}) for one in vehicle.sensors)
    declared = vehicle.model_copy(update={"sensors": rated})
    declared_site = site.model_copy(update={"vehicles": (declared,)})
    return DrawnTandem(case, declared_site, drive_case(case, 0))


def _with_errors(
    sensors: tuple[WideSensor, ...], vehicle: Vehicle, errors: ChannelErrors
) -> tuple[WideSensor, ...]:
    """Return the four sensors with the declared noise and the drawn errors."""
    return tuple(
        one._replace(
            noise_ug_per_rthz=declared.noise_density_ug_per_rthz,
            gain_error=float((1.0 + errors.common_gain) * (1.0 + errors.gain[c]) - 1.0),
            delay_s=float(errors.delay_s[c]),
            bias_m_per_s2=float(errors.bias_m_per_s2[c]),
        )
        for c, (one, declared) in enumerate(zip(sensors, vehicle.sensors, strict=True))
    )


def drawn_vehicle(vehicle: Vehicle, seed: int) -> Vehicle:
    """Return the truck with each value drawn from its prior; raise ValueError without a tandem."""
    tandem = vehicle.tandem
    if tandem is None:
        raise ValueError(f"{vehicle.id} has no tandem")
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x7A30]))

    def factor(spread: float) -> float:
        return float(np.exp(spread * rng.standard_normal()))

    number = tandem.number
    gap_m = tandem.gap_m * factor(vehicle.spread("wheelbase_m"))
    share = min(tandem.share * factor(vehicle.tandem_share_spread), 0.95)
    axles = []
    for place, axle in enumerate(vehicle.axles):
        of_axle = {
            key: getattr(axle, key) * factor(vehicle.spread(key))
            for key in (
                "unsprung_mass_kg",
                "suspension_stiffness_n_per_m",
                "suspension_damping_ns_per_m",
                "tyre_stiffness_n_per_m",
                "tyre_damping_ns_per_m",
            )
        }
        if axle.tyre_damping_ns_per_m == 0.0:
            scale = vehicle.scale_at_zero("tyre_damping_ns_per_m")
            of_axle["tyre_damping_ns_per_m"] = scale * abs(float(rng.standard_normal()))
        if place == number:
            of_axle["position_m"] = tandem.first.position_m + gap_m
        axles.append(axle.model_copy(update=of_axle))
    bogies = tuple(
        bogie.model_copy(
            update={"axles": (number, number + 1), "shares": (share, 1.0 - share)}
            if number in bogie.axles
            else {}
        )
        for bogie in vehicle.bogies
    )
    drawn = vehicle.model_copy(update={"axles": tuple(axles), "bogies": bogies})
    of_drawn = drawn.tandem
    assert of_drawn is not None  # noqa: S101 - it has the same axles
    return drawn.model_copy(
        update={
            "total_mass_kg": vehicle.total_mass_kg * factor(vehicle.spread("total_mass_kg")),
            "unsprung_mass_kg": (of_drawn.front.unsprung_mass_kg, of_drawn.rear.unsprung_mass_kg),
            "wheelbase_m": of_drawn.rear.position_m - of_drawn.front.position_m,
            "front_axle_to_cg_m": vehicle.front_axle_to_cg_m
            * factor(vehicle.spread("front_axle_to_cg_m")),
            "pitch_inertia_ratio": vehicle.pitch_inertia_ratio
            * factor(vehicle.spread("pitch_inertia_ratio")),
        }
    )
