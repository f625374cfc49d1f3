"""Priors of the axle ahead of a tandem."""

from services.identification.footprints import displaced_leads_of, lead_of
from services.simulation.usual_trucks import usual_tandem
from studies.simulation.truths import default_site


def test_each_value_of_the_front_axle_is_displaced_by_its_spread() -> None:
    vehicle = usual_tandem(25.0).model_copy(update={"unsprung_mass_kg_spread": 0.2})
    nominal = lead_of(vehicle)
    mass, tyre, damped = displaced_leads_of(vehicle)
    assert mass == nominal._replace(unsprung_mass_kg=1.2 * nominal.unsprung_mass_kg)
    stiffness = (1.0 + vehicle.tyre_stiffness_n_per_m_spread) * nominal.tyre_stiffness_n_per_m
    assert tyre == nominal._replace(tyre_stiffness_n_per_m=stiffness)
    scale = vehicle.tyre_damping_ns_per_m_scale_at_zero
    assert damped == nominal._replace(tyre_damping_ns_per_m=scale)


def test_a_truck_of_two_axles_has_no_axle_ahead() -> None:
    assert displaced_leads_of(default_site().vehicles[0]) == ()
