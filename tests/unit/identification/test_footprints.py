"""Axles ahead of a tandem."""

from collections.abc import Callable

import numpy as np
import pytest

from schemas.site import Vehicle
from services.identification.footprints import (
    displaced_trucks_of,
    front_footprints_of,
    tandem_truck_of,
)
from services.simulation.usual_trucks import usual_four_axles, usual_tandem
from studies.simulation.truths import default_site


@pytest.mark.parametrize("usual", [usual_tandem, usual_four_axles])
def test_each_value_of_an_axle_ahead_is_displaced_by_its_spread(
    usual: Callable[[float], Vehicle],
) -> None:
    vehicle = usual(25.0).model_copy(update={"unsprung_mass_kg_spread": 0.2})
    nominal = tandem_truck_of(vehicle).front
    displaced = [truck.front for truck in displaced_trucks_of(vehicle)]
    count = nominal.ahead_m.size
    each = 3 if count == 1 else 5  # the springs of several axles, too
    assert len(displaced) == each * count
    for number in range(count):
        mass, tyre, damped, *springs = displaced[each * number : each * (number + 1)]
        of = np.arange(count) == number
        heavier = np.where(of, 1.2, 1.0) * nominal.unsprung_mass_kg
        np.testing.assert_array_equal(mass.unsprung_mass_kg, heavier)
        harder = 1.0 + of * vehicle.tyre_stiffness_n_per_m_spread
        np.testing.assert_array_equal(
            tyre.tyre_stiffness_n_per_m, harder * nominal.tyre_stiffness_n_per_m
        )
        scale = vehicle.tyre_damping_ns_per_m_scale_at_zero
        np.testing.assert_array_equal(damped.tyre_damping_ns_per_m, scale * of)
        np.testing.assert_array_equal(mass.tyre_stiffness_n_per_m, nominal.tyre_stiffness_n_per_m)
        for key, other in zip(("stiffness_n", "damping_ns"), springs, strict=False):
            name = f"suspension_{key}_per_m"
            harder = 1.0 + of * getattr(vehicle, f"{name}_spread")
            np.testing.assert_array_equal(getattr(other, name), harder * getattr(nominal, name))


def test_front_axles_are_placed_from_the_first_compared_one() -> None:
    truck = tandem_truck_of(usual_four_axles(25.0))
    assert truck.front.ahead_m == pytest.approx([5.1, 3.15])
    assert truck.front.share == pytest.approx([0.5, 0.5])
    assert truck.ahead_m == pytest.approx(5.1 - 0.975)
    assert len(front_footprints_of(usual_four_axles(25.0))) == 2


def test_a_truck_of_two_axles_has_no_axle_ahead() -> None:
    assert displaced_trucks_of(default_site().vehicles[0]) == ()
    assert front_footprints_of(default_site().vehicles[0]) == ()
