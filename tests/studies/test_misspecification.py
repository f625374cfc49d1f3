"""Crossings with more physics: what is drawn, what is kept, and what the table says."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2 as STANDARD_GRAVITY
from pre_core.physics.bridge import natural_frequencies_hz, refine
from pre_core.physics.vehicle import static_axle_loads_n
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS
from services.common.errors import InputError
from services.common.geodesy import bridge_frame, to_chainage
from services.simulation import drawn as drawn_crossings
from services.simulation.drawn import draw_truth
from services.simulation.effects import ALONE, EVERYTHING, ON_SURFACES
from services.simulation.pavement import PLAIN
from services.simulation.two_sided import static_axle_loads_n as static_loads
from services.simulation.two_sided_deck import bending_frequencies_hz
from services.simulation.wheel_paths import SurfaceOptions, wheel_paths_of
from studies.simulation import out_of_model
from studies.simulation.drive_wide import deck_with_width, truck_with_width
from studies.simulation.out_of_model import OutOfModelTruth, draw_out_of_model
from studies.simulation.truths import default_site
from studies.validation import misspecification as validation
from studies.validation.misspecification import (
    append_record,
    effect_checks,
    lines_of,
    read_records,
    run_effects,
)

SITE = default_site()
SEEDS = range(200)
SETTINGS = IdentificationSettings(method="pre", threads=1)


def drawn(effect: str) -> list[OutOfModelTruth]:
    return [draw_out_of_model(SITE, effect, seed) for seed in SEEDS]


def within(values: Any, limits: tuple[float, float]) -> bool:
    """All inside, and both ends of the range come: within a tenth of it."""
    found = np.ravel(np.array(values, dtype=np.float64))
    tenth = 0.1 * (limits[1] - limits[0])
    return bool(
        limits[0] <= found.min() < limits[0] + tenth
        and limits[1] - tenth < found.max() <= limits[1]
    )


def test_without_an_effect_the_world_is_the_methods() -> None:
    for case in drawn("free")[:20]:
        assert case.effects == (((0.0, 0.0), (0.0, 0.0), None) + (0.0,) * 4 + (None,))
        assert case.truth.beam.support_rotational_stiffness_nm_per_rad == (0.0, 0.0)
        assert case.truth.car.tyre_damping_ns_per_m == (0.0, 0.0)
        assert case.site == SITE


@pytest.mark.parametrize("effect", ALONE)
def test_an_effect_alone_changes_nothing_else(effect: str) -> None:
    """Truck, rigidities and drive of the seed are the same; of other effects there is none."""
    for seed in range(10):
        plain, case = draw_out_of_model(SITE, "free", seed), draw_out_of_model(SITE, effect, seed)
        assert draw_out_of_model(SITE, effect, seed).effects == case.effects
        if effect != "spans":
            np.testing.assert_array_equal(
                plain.truth.beam.flexural_rigidity_nm2, case.truth.beam.flexural_rigidity_nm2
            )
            assert plain.truth.car.body_mass_kg == case.truth.car.body_mass_kg
            assert plain.truth.conditions.road_seed == case.truth.conditions.road_seed
        others = {
            "sprung": any(case.effects.support_rotational_stiffness_nm_per_rad),
            "sinking": any(case.effects.support_compliance_m_per_n),
            "swing": case.truth.departed is not None,
            "tyres": any(case.truth.car.tyre_damping_ns_per_m),
            "friction": any(case.truth.car.dry_friction_n),
            "bilinear": case.truth.car.bilinear_damping > 0.0,
            "air": case.truth.car.air_spring_exponent > 0.0,
            "spans": bool(case.site.bridges[0].interior_supports_m),
            "surface": case.truth.paths is not None and case.truth.paths.pavement == PLAIN,
            "pavement": case.truth.paths is not None and case.truth.paths.pavement != PLAIN,
            "torsion": case.width is not None and case.width.torsion is not None,
            "left-and-right": case.width is not None and bool(case.width.sensors),
        }
        assert [name for name, there in others.items() if there] == [effect] * (effect != "free")


def test_ranges_are_those_that_are_stated() -> None:
    scale = 1.56e10 / 30.0
    springs = [w.truth.beam.support_rotational_stiffness_nm_per_rad for w in drawn("sprung")]
    assert within(np.array(springs) / scale, out_of_model.SPRUNG_EI_PER_SPAN)
    compliance = np.array([w.truth.beam.support_compliance_m_per_n for w in drawn("sinking")])
    limits = np.log(out_of_model.BEARINGS_N_PER_M)
    assert within(-np.log(compliance), (float(limits[0]), float(limits[1])))
    departed = [w.truth.departed for w in drawn("swing")]
    assert within([one.weight_n / 9.80665 for one in departed if one], out_of_model.LORRY_KG)
    assert within([abs(one.speed_m_per_s) for one in departed if one], out_of_model.LORRY_M_PER_S)
    assert within([one.seconds for one in departed if one], out_of_model.LEFT_S)
    assert {one.speed_m_per_s > 0.0 for one in departed if one} == {True, False}
    tyres = [w.truth.car.tyre_damping_ns_per_m for w in drawn("tyres")]
    assert within(tyres, out_of_model.TYRE_DAMPING_NS_PER_M)
    cars = [w.truth.car for w in drawn("friction")]
    for car in cars[:20]:
        loads = np.array(static_axle_loads_n(car, 9.80665))
        carried = loads - 9.80665 * np.array(car.unsprung_mass_kg)
        shares = np.array(car.dry_friction_n) / carried
        assert shares[0] == pytest.approx(shares[1])
    assert within(
        [w.effects.friction_share for w in drawn("friction")], out_of_model.FRICTION_SHARE
    )
    assert within([car.friction_length_m for car in cars], out_of_model.FRICTION_LENGTH_M)
    assert {car.friction_load_growth for car in cars} == {0.0, 1.0}
    assert within([w.truth.car.bilinear_damping for w in drawn("bilinear")], out_of_model.BILINEAR)
    assert within(
        [w.truth.car.air_spring_exponent for w in drawn("air")], out_of_model.AIR_EXPONENT
    )


def test_ranges_of_pavements_are_those_that_are_stated() -> None:
    pavements = [w.truth.paths.pavement for w in drawn("pavement") if w.truth.paths]
    for name, limits in (
        ("deck_roughness", out_of_model.DECK_ROUGHNESS),
        ("anisotropy", out_of_model.ANISOTROPY),
    ):
        low, high = np.log(limits)
        found = np.log([getattr(one, name) for one in pavements])
        assert within(found, (float(low), float(high)))
    assert within([one.largest_joint_m for one in pavements], out_of_model.LARGEST_JOINT_M)


def test_spans_are_continuous_bridges_from_the_same_start() -> None:
    bridges = [w.site.bridges[0] for w in drawn("spans")]
    assert {len(bridge.lengths_of_spans_m) for bridge in bridges} == {2, 3, 4, 5}
    assert within([length for b in bridges for length in b.lengths_of_spans_m], out_of_model.SPAN_M)
    for case, bridge in zip(drawn("spans")[:20], bridges[:20], strict=True):
        assert bridge.ends_distance_m == pytest.approx(bridge.span_m, rel=1e-3)
        end = to_chainage(
            bridge_frame(SITE.bridges[0]),
            np.array([bridge.end_latitude_deg]),
            np.array([bridge.end_longitude_deg]),
        )
        assert float(end[0][0]) == pytest.approx(bridge.span_m, abs=0.01)
        assert abs(float(end[1][0])) < 0.01
        assert case.truth.beam.interior_supports == bridge.interior_support_nodes
        assert case.truth.beam.element_lengths_m.sum() == pytest.approx(bridge.span_m)


def test_everything_is_all_of_it() -> None:
    found = drawn(EVERYTHING)
    for case in found:
        car, beam = case.truth.car, case.truth.beam
        assert all(car.tyre_damping_ns_per_m)
        assert all(car.dry_friction_n)
        assert all(beam.support_compliance_m_per_n)
        assert case.truth.departed is not None
        assert case.truth.conditions.body_noise_ug_per_rthz is not None
    springs = np.array([w.truth.beam.support_rotational_stiffness_nm_per_rad for w in found]) > 0.0
    assert 0.4 < springs.mean() < 0.6
    assert 0.4 < np.mean([bool(w.site.bridges[0].interior_supports_m) for w in found]) < 0.6


def test_on_a_surface_the_rear_axle_has_twin_tyres_and_runs_beside() -> None:
    found = [w.truth.paths for w in drawn("surface")]
    assert all(paths is not None for paths in found)
    offsets = [paths.rear.offset_m for paths in found if paths]
    assert within(offsets, out_of_model.REAR_OFFSET_M)
    for paths in found:
        assert paths == wheel_paths_of(
            SITE.vehicles[0], SurfaceOptions("twin", paths.rear.offset_m, 0.12)
        )
    assert {w.truth.conditions.road_class for w in drawn("surface")} == {"A", "B"}
    assert all(w.truth.paths is None and w.width is None for w in drawn(EVERYTHING))


def test_surface_tyres_default_to_the_site_file() -> None:
    vehicle = SITE.vehicles[0].model_copy(
        update={"twin_tyre_distance_m": (0.0, 0.0), "rear_axle_offset_m": 0.02}
    )
    paths = draw_out_of_model(
        SITE.model_copy(update={"vehicles": (vehicle,)}), "surface", 0
    ).truth.paths
    assert paths == wheel_paths_of(vehicle, SurfaceOptions(wander_m=0.12))
    assert paths is not None
    assert (paths.rear.twin_distance_m, paths.rear.offset_m) == (0.0, 0.02)


def test_the_surface_is_driven_over_by_the_worlds_truck(monkeypatch: pytest.MonkeyPatch) -> None:
    """The truth's paths reach the simulation, and the record has them."""
    reported: list[object] = []
    real = drawn_crossings.measured_run

    def keeping(*arguments: Any) -> Any:
        reported.append(arguments[4].paths)
        return real(*arguments)

    monkeypatch.setattr(drawn_crossings, "measured_run", keeping)
    monkeypatch.setattr(validation, "identify_simulated", lambda runs, site, settings: [])
    lines = [validation.one_effect(SITE, effect, 2, SETTINGS) for effect in ("free", "surface")]
    paths = draw_out_of_model(SITE, "surface", 2).truth.paths
    assert paths is not None
    assert reported == [None, paths]
    assert lines[0]["world"]["wheel_paths"] is None
    assert lines[1]["world"]["wheel_paths"]["rear"] == paths.rear._asdict()
    assert json.loads(json.dumps(lines[1]["world"]))["wheel_paths"]["wander_m"] == 0.12


def test_torsion_and_sides_are_drawn_from_the_stated_ranges() -> None:
    widths = [w.width for w in drawn("torsion")]
    for case, width in zip(drawn("torsion"), widths, strict=True):
        assert width is not None
        assert width.torsion is not None
        assert width.paths.rear.twin_distance_m == 0.0
        assert case.site.vehicles[0].twin_tyre_distance_m == (0.0, 0.0)
    lanes = [abs(width.lane_offset_m) for width in widths if width]
    assert within(lanes, out_of_model.LANE_OFFSET_M)
    assert {width.lane_offset_m > 0.0 for width in widths if width} == {True, False}
    of_torsion = [width.torsion for width in widths if width and width.torsion]
    # 3.286 Hz is the first frequency of the paper's undamaged bridge.
    frequencies = np.array([t.frequency_hz for t in of_torsion])
    masses = [w.truth.beam.mass_per_length_kg_per_m[0] for w in drawn("torsion")]
    ratios = frequencies / (0.5 * np.pi / 30.0**2 * np.sqrt(1.56e10 / np.array(masses)))
    assert within(ratios, out_of_model.TORSIONAL_RATIO)
    assert within([t.gyration_m for t in of_torsion], out_of_model.GYRATION_M)
    pairs = [w.width for w in drawn("left-and-right")]
    assert within([width.load_left_m for width in pairs if width], out_of_model.LOAD_LEFT_M)
    for width in pairs:
        assert width is not None
        assert width.torsion is None
        delays, gains = np.array([(s.delay_s, s.gain_error) for s in width.sensors]).T
        np.testing.assert_array_equal(delays[::2], delays[1::2])
        assert np.unique(gains).size == 8
        assert np.unique(delays).size == 4
        assert sorted({(s.on, s.lateral_m) for s in width.sensors}) == [
            ("axle", -0.9),
            ("axle", 0.9),
            ("body", -0.4),
            ("body", 0.4),
        ]


def test_torsion_reaches_the_simulation_and_the_record(monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[Any] = []

    def keeping(found: list[Any], site: Any, settings: Any) -> list[Any]:
        runs.append((found[0], site))
        return []

    monkeypatch.setattr(validation, "identify_simulated", keeping)
    lines = [validation.one_effect(SITE, effect, 2, SETTINGS) for effect in ON_SURFACES]
    kept = [json.loads(json.dumps(line["world"]))["width"] for line in lines]
    assert kept[0] is None
    assert kept[1]["torsion"]["frequency_hz"] > 0.0
    assert len(kept[2]["sensors"]) == 8
    for run, _ in runs:
        assert tuple(sorted(run.channels)) == tuple(sorted(CHANNELS))
        assert run.accel_time_s.size == run.channels[CHANNELS[0]].size
    # The mean of two sensors has 1/sqrt(2) of the noise of one.
    density = [site.sensor.noise_density_ug_per_rthz[0] for _, site in runs]
    assert density[2] == pytest.approx(density[1] / np.sqrt(2.0))


def test_truck_with_width_has_loads_and_inertia_of_the_half_car() -> None:
    case = draw_out_of_model(SITE, "torsion", 4)
    width = case.width
    assert width is not None
    car, beam = case.truth.car, case.truth.beam
    truck, deck = truck_with_width(car, width), deck_with_width(beam, width)
    np.testing.assert_allclose(
        static_loads(truck), static_axle_loads_n(car, STANDARD_GRAVITY), rtol=1e-9
    )
    assert truck.bodies[0].pitch_inertia_kg_m2 == pytest.approx(
        car.pitch_inertia_ratio
        * car.body_mass_kg
        * car.front_axle_to_cg_m
        * (car.wheelbase_m - car.front_axle_to_cg_m)
    )
    np.testing.assert_allclose(
        bending_frequencies_hz(deck, 3), natural_frequencies_hz(refine(beam, 10), 3), rtol=1e-5
    )
    leaning = draw_out_of_model(SITE, "left-and-right", 4).width
    assert leaning is not None
    assert truck_with_width(car, leaning).bodies[0].cg_left_m == leaning.load_left_m
    with pytest.raises(ValueError, match="one span of equal elements"):
        deck_with_width(draw_out_of_model(SITE, "spans", 1).truth.beam, width)


def test_an_effect_that_is_none() -> None:
    with pytest.raises(ValueError, match="wind is none of free, sprung"):
        draw_out_of_model(SITE, "wind", 0)


def made_up(effect: str, seed: int, z: tuple[float, ...], verdict: str = "good") -> dict[str, Any]:
    """A record whose errors of ln EI are so many standard deviations of 5 %."""
    truth = {f"EI_{e + 1}": 1e10 for e in range(len(z))}
    estimates = {
        name: {
            "std": 5e8,
            "q025": 1e10 * np.exp(0.05 * (error - 1.959964)),
            "q50": 1e10 * np.exp(0.05 * error),
            "q975": 1e10 * np.exp(0.05 * (error + 1.959964)),
        }
        for name, error in zip(truth, z, strict=True)
    }
    return {
        "effect": effect,
        "seed": seed,
        "truth": truth,
        "verdict": verdict,
        "reasons": [],
        "estimates": {} if verdict == "rejected" else estimates,
    }


def test_the_table_by_hand() -> None:
    records = [
        made_up("swing", 0, (1.0, -3.0)),
        made_up("swing", 1, (2.0, 0.0), "suspect"),
        made_up("swing", 2, (0.0, 0.0), "rejected"),
        made_up("air", 0, (6.0,)),
    ]
    swing, air = lines_of(records)
    assert (swing.effect, swing.crossings) == ("swing", 3)
    assert (swing.answered, swing.good) == pytest.approx((2 / 3, 1 / 3))
    assert (swing.coverage, swing.coverage_good) == pytest.approx((0.5, 0.5))
    assert (swing.mean_z, swing.worst_mean_z) == pytest.approx((0.0, 1.5)) or (
        swing.mean_z,
        swing.worst_mean_z,
    ) == pytest.approx((0.0, -1.5))
    assert swing.rms_z == pytest.approx(np.sqrt(14.0 / 4.0))
    assert swing.largest_z_good == pytest.approx(3.0)
    assert swing.std == pytest.approx(0.05)
    assert swing.over_bound is None
    bounds = {"std": {"EI_1": 0.04, "EI_2": 0.025}}
    (surface,) = lines_of([made_up("surface", 0, (0.0, 0.0)) | {"bound": bounds}])
    assert surface.over_bound == pytest.approx(0.5 * (0.05 / 0.04 + 0.05 / 0.025))
    assert air.coverage == 0.0
    checks = {check.name: check for check in effect_checks(records)}
    assert checks["swing: largest |z| among good"].is_met
    assert not checks["air: largest |z| among good"].is_met
    assert len(checks) == 2  # too few for coverage and mean


def test_enough_crossings_have_to_be_covered_and_centred() -> None:
    rng = np.random.default_rng(1)

    def targets(shift: float, width: float) -> dict[str, bool]:
        records = [
            made_up("sprung", seed, tuple(shift + width * rng.standard_normal(7)))
            for seed in range(100)
        ]
        return {check.name: check.is_met for check in effect_checks(records)}

    assert all(targets(0.0, 1.0).values())
    assert not targets(0.8, 1.0)["sprung: mean z of the worst element"]
    assert not targets(0.0, 1.5)["sprung: coverage"]


def test_bridges_of_different_numbers_of_elements_have_no_worst_element() -> None:
    (line,) = lines_of([made_up("spans", 0, (1.0, 2.0)), made_up("spans", 1, (0.0, 0.0, 0.0))])
    assert line.worst_mean_z is None
    assert line.mean_z == pytest.approx(0.6)


def test_what_is_there_is_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out_of_model.jsonl"
    ran: list[tuple[str, int]] = []

    def quick(site: Any, effect: str, seed: int, settings: Any) -> dict[str, Any]:
        ran.append((effect, seed))
        identity = validation.identity_of(site, settings)
        return made_up(effect, seed, (0.5,)) | {"identity": identity}

    monkeypatch.setattr(validation, "one_effect", quick)
    run_effects(SITE, ("swing",), 2, path, SETTINGS, 1)
    assert ran == [("swing", 0), ("swing", 1)]
    # Killed in the middle of a line: that one is run again, and the next stands on its own line.
    path.write_bytes(path.read_bytes()[:-40])
    reported: list[tuple[int, int]] = []
    found = run_effects(
        SITE, ("swing", "air"), 2, path, SETTINGS, 1, lambda *counts: reported.append(counts)
    )
    assert ran[2:] == [("air", 0), ("swing", 1), ("air", 1)]
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert [(line["effect"], line["seed"]) for line in found] == [
        ("swing", 0),
        ("air", 0),
        ("swing", 1),
        ("air", 1),
    ]
    assert len(read_records(path)) == 4
    # Another site is another crossing.
    other = SITE.model_copy(update={"receiver": SITE.receiver.model_copy(update={"latency_s": 1})})
    run_effects(other, ("swing",), 1, path, SETTINGS, 1)
    assert ran[5:] == [("swing", 0)]


def test_records_that_are_none(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("hello\n")
    with pytest.raises(InputError, match="line 1 is no record of a crossing"):
        read_records(path)
    assert read_records(tmp_path / "absent.jsonl") == []
    append_record(tmp_path / "new.jsonl", made_up("air", 3, (0.0,)))
    (line,) = (tmp_path / "new.jsonl").read_text().splitlines()
    assert json.loads(line)["seed"] == 3


def test_the_plain_truth_is_that_of_the_priors_but_for_bearings_and_tyres() -> None:
    plain, prior = draw_out_of_model(SITE, "free", 4).truth, draw_truth(SITE, 4)
    assert plain.conditions == prior.conditions
    assert plain.channels.common_gain == prior.channels.common_gain
    assert plain.beam.rayleigh_beta_s == prior.beam.rayleigh_beta_s


def test_all_effects_at_once_leave_enough_draws() -> None:
    """A crossing whose weights kept a heavy tail while the surrogate's regression ignored them.

    It then ended suspect with 10,000 draws; with other linear algebra it takes 2,000 to 2,400 now.
    """
    line = validation.one_effect(SITE, EVERYTHING, 7, SETTINGS)
    assert line["verdict"] == "good", line["reasons"]
    assert line["diagnostics"]["draws"] <= 5_000
