"""What else could be done at a site, and that nothing else is changed by it."""

import pytest

from schemas.site import Bridge, Site
from schemas.site_file import parse_site, site_toml
from schemas.site_vehicle import axle_loads_kg
from services.finding.placed import middle_site
from services.planning.alternatives import Plan, alternatives, as_planned, with_noise, with_tyres
from services.planning.crossings import axles_of
from services.planning.survey import middle_elements
from services.simulation.drive import paper_site
from services.simulation.usual_trucks import usual_tandem

SPANS = {"interior_supports_m": (15.0,), "elements": 8}


def named(site: Site) -> dict[str, Plan]:
    return {plan.name: plan for plan in alternatives(site, 10.0)}


def test_the_plan_drives_at_speeds_about_the_one_asked_for() -> None:
    ((slow, fast),) = as_planned(paper_site(), 10.0).tracks
    assert (slow.speed_m_per_s, fast.speed_m_per_s) == (8.5, 11.5)
    assert slow.site == paper_site()


def test_single_tyres_are_proposed_only_where_there_are_others() -> None:
    name = "equal single tyres on both axles"
    single = named(paper_site())[name].site
    front, rear = axles_of(single.vehicles[0])
    assert rear._replace(offset_m=front.offset_m) == front
    assert name not in named(single)
    assert name in named(with_tyres(paper_site(), "twin"))


def test_equal_single_tyres_are_planned_on_equal_tracks() -> None:
    unlike = {"track_m": (2.05, 1.83), "tyre_contact_length_m": (0.2, 0.25)}
    vehicle = paper_site().vehicles[0].model_copy(update=unlike)
    site = paper_site().model_copy(update={"vehicles": (vehicle,)})
    single = named(site)["equal single tyres on both axles"].site.vehicles[0]
    assert single.track_m == (2.05, 2.05)
    front, rear = axles_of(single)
    assert rear._replace(offset_m=front.offset_m) == front
    assert with_tyres(site, "twin").vehicles[0].track_m == (2.05, 1.83)


def test_other_loads_change_nothing_but_the_mass() -> None:
    site = paper_site()
    plans = [plan for name, plan in named(site).items() if name.startswith("half of the runs at")]
    masses = []
    for plan in plans:
        (crossings,) = plan.tracks  # one track: the mismatch does not depend on the load
        assert [one.site == site for one in crossings] == [True, True, False, False]
        other = crossings[2].site.vehicles[0]
        masses.append(other.total_mass_kg)
        same = other.model_copy(update={"total_mass_kg": site.vehicles[0].total_mass_kg})
        assert same == site.vehicles[0]
    assert masses == pytest.approx([1220.0 + 0.4 * 8310.0, 1220.0 + 1.5 * 8310.0])


@pytest.mark.parametrize(
    ("total_kg", "share", "heaviest_kg"),
    [(13_000.0, 0.5, 18_000.0), (13_000.0, 0.7, 16_575.7), (17_000.0, 0.5, None)],
)
def test_no_load_beyond_what_is_legal_is_proposed(
    total_kg: float, share: float, heaviest_kg: float | None
) -> None:
    """Two axles carry 18 t, and one of them 11.5 t at most."""
    site = paper_site()
    truck = site.vehicles[0]
    changed = {"total_mass_kg": total_kg, "front_axle_to_cg_m": share * truck.wheelbase_m}
    site = site.model_copy(update={"vehicles": (truck.model_copy(update=changed),)})
    masses = [
        plan.tracks[0][2].site.vehicles[0].total_mass_kg
        for name, plan in named(site).items()
        if name.startswith("half of the runs at")
    ]
    heavier = [mass for mass in masses if mass > total_kg]
    assert heavier == ([] if heaviest_kg is None else [pytest.approx(heaviest_kg, abs=1.0)])


def test_the_way_back_is_in_another_track() -> None:
    there, back = named(paper_site())["half of the runs the other way"].tracks
    assert [one.forward for one in (*there, *back)] == [True, True, False, False]


def test_alike_axles_are_loaded_otherwise() -> None:
    site = paper_site()
    assert "load moved to the heavier axle" not in named(site)
    alike = site.vehicles[0].model_copy(update={"front_axle_to_cg_m": 2.1})
    plan = named(site.model_copy(update={"vehicles": (alike,)}))["load moved to the heavier axle"]
    front, rear = axle_loads_kg(plan.site.vehicles[0])
    assert abs(front - rear) > 0.1 * (front + rear)


def test_another_kind_of_truck_is_proposed() -> None:
    name = "a truck with an equalised tandem"
    site = named(with_noise(paper_site(), (7.0,) * 4))[name].site
    vehicle = site.vehicles[0]
    assert vehicle.tandem is not None
    assert vehicle.tandem.is_equalised
    assert {one.noise_density_ug_per_rthz for one in vehicle.sensors} == {7.0}
    assert site.bridges == paper_site().bridges
    # The simulation of a tandem has one span of equal elements.
    two = Bridge.model_validate(paper_site().bridges[0].model_dump() | SPANS)
    assert name not in named(paper_site().model_copy(update={"bridges": (two,)}))


def test_a_truck_with_a_tandem_is_compared_with_lorries() -> None:
    site = middle_site(paper_site().model_copy(update={"vehicles": (usual_tandem(10.0),)}))
    plans = named(site)
    lighter = next(plan for name, plan in plans.items() if name.startswith("half of the runs at"))
    assert parse_site(site_toml(lighter.tracks[0][2].site), "a").vehicles[0].tandem is not None
    single = plans["single tyres on the tandem"].site.vehicles[0]
    assert [one.twin_distance_m for one in axles_of(single)] == [0.0, 0.0]
    for name, distance in (("twin tyres behind", 0.33), ("equal single tyres", 0.0)):
        lorry = plans[f"a lorry of two axles, {name}"].site.vehicles[0]
        assert lorry.tandem is None
        front, rear = axles_of(lorry)
        assert rear.twin_distance_m == distance
        assert (rear._replace(offset_m=front.offset_m) == front) == (distance == 0.0)
    quiet = plans["sensors of a quarter of the noise"].site.vehicles[0]
    assert {one.noise_density_ug_per_rthz for one in quiet.sensors} == {2.5}
    assert "single tyres on the tandem" not in named(plans["single tyres on the tandem"].site)


def test_offset_of_a_tandem_is_a_few_millimetres_unless_declared() -> None:
    vehicle = usual_tandem(10.0)
    assert axles_of(vehicle)[1].offset_m == 0.005
    last = vehicle.axles[2].model_copy(update={"lateral_offset_m": 0.02})
    aside = vehicle.model_copy(update={"axles": (*vehicle.axles[:2], last)})
    assert axles_of(aside)[1].offset_m == 0.02


def test_fewer_elements_end_at_the_supports_all_the_same() -> None:
    bridge = paper_site().bridges[0]
    spans = Bridge.model_validate(
        bridge.model_dump() | {"interior_supports_m": (12.0,), "elements": 8}
    )
    site = paper_site().model_copy(update={"bridges": (spans,)})
    coarse = named(site)["3 elements"].site.bridges[0]
    assert coarse.elements == len(coarse.lengths_m) == 3
    assert any(abs(sum(coarse.lengths_m[:k]) - 12.0) < 1e-9 for k in (1, 2))
    assert middle_elements(bridge) == (3,)
    assert middle_elements(coarse) == (1, 2)  # that meet in the middle of the longer span
    assert middle_elements(bridge.model_copy(update={"elements": 6})) == (2, 3)
    small = spans.model_copy(update={"elements": 3})
    few = named(site.model_copy(update={"bridges": (small,)}))
    assert not [name for name in few if name.endswith("elements")]


def test_quieter_sensors() -> None:
    quiet = named(with_noise(paper_site(), (8.0, 8.0, 4.0, 4.0)))[
        "sensors of a quarter of the noise"
    ]
    assert quiet.site.sensor.noise_density_ug_per_rthz == (2.0, 2.0, 1.0, 1.0)
