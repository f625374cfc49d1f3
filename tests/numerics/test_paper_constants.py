"""The paper's experiment in pre_core/paper/experiment.py against its printed tables."""

from typing import Any

import numpy as np
import pytest

from pre_core.paper import experiment


def test_tables_1_2_and_4(paper_tables: dict[str, Any]) -> None:
    vehicle, bridge = paper_tables["table1_vehicle"], paper_tables["table2_bridge"]
    truck = experiment.TRUCK
    assert truck.body_mass_kg == vehicle["m_s_kg"]
    assert truck.front_axle_to_cg_m == vehicle["d_m"][0]
    assert truck.wheelbase_m == pytest.approx(sum(vehicle["d_m"]), rel=1e-15)
    assert truck.suspension_stiffness_n_per_m == tuple(vehicle["k_s_n_per_m"])
    assert truck.suspension_damping_ns_per_m == tuple(vehicle["c_s_ns_per_m"])
    assert truck.unsprung_mass_kg == tuple(vehicle["m_u_kg"])
    assert truck.tyre_stiffness_n_per_m == tuple(vehicle["k_u_n_per_m"])
    assert vehicle["speed_m_per_s"] == experiment.SPEED_M_PER_S
    beam = experiment.beam(np.ones(experiment.ELEMENTS))
    assert beam.element_lengths_m.sum() == pytest.approx(bridge["span_m"], rel=1e-15)
    assert np.all(beam.flexural_rigidity_nm2 == bridge["EI_n_m2"])
    assert np.all(beam.mass_per_length_kg_per_m == bridge["rhoA_kg_per_m"])
    assert beam.rayleigh_alpha_per_s == bridge["alpha_per_s"]
    assert beam.rayleigh_beta_s == bridge["beta_s"]
    simulation = paper_tables["table4_simulation"]
    assert simulation["dt_s"] == experiment.STEP_S
    assert simulation["front_axle_start_m"] == experiment.FRONT_AXLE_START_M


@pytest.mark.parametrize("scenario", experiment.SCENARIOS)
def test_table_3(scenario: int, paper_tables: dict[str, Any]) -> None:
    expected = paper_tables["table3_scenarios_EI_ratio"][str(scenario)]
    np.testing.assert_array_equal(experiment.scenario_ratios(scenario), expected)
