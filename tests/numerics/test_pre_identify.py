"""Method `pre` from a recording to a result: one noisy crossing of the paper's scenario 6.

One crossing shows that the parts fit together. It does not show that the intervals are right: that
takes many crossings.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from pre_core.bridge import natural_frequencies_hz, refine
from pre_core.paper import scenario_ratios
from schemas.results import Crossing, Results, results_json
from schemas.settings import IdentificationSettings
from services.identify import identify_recordings
from services.simulation import beam_of, declared, paper_site, simulate_drive, write_drive

NOISE_UG = 25.0
SEED = 3


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Scenario 6 at 10 m/s over a road of class A, 25 µg/√Hz, with errors of the receiver."""
    path: Path = tmp_path_factory.mktemp("pre") / "scenario-6.mcap"
    site = paper_site()
    drive = simulate_drive(
        site,
        scenario_ratios(6),
        road_class="A",
        seed=SEED,
        noise_ug_per_rthz=NOISE_UG,
        receiver_errors=True,
    )
    known = declared(site, NOISE_UG, drive.run.rate_hz)
    write_drive(path, drive, known)
    return identify_recordings([path], known, IdentificationSettings(method="pre", seed=0))


@pytest.fixture(scope="module")
def crossing(found: Results) -> Crossing:
    assert len(found.crossings) == 1
    return found.crossings[0]


@pytest.mark.slow
def test_rigidities_lie_within_their_intervals(crossing: Crossing) -> None:
    assert crossing.verdict != "rejected", crossing.reasons
    assert crossing.parameters is not None
    assert crossing.chi2_per_dof is not None
    assert 0.85 < crossing.chi2_per_dof < 1.15
    nominal = paper_site().bridges[0].nominal_flexural_rigidity_nm2
    for e, ratio in enumerate(scenario_ratios(6)):
        p = crossing.parameters[f"EI_{e + 1}"]
        z = (p.mean - ratio * nominal[e]) / p.std
        assert abs(z) < 4.0, (e + 1, z)
        assert 0.01 < p.std / p.mean < 0.15, (e + 1, p.std / p.mean)
        assert p.q025 < p.q50 < p.q975
    weak = crossing.parameters["EI_4"]
    assert weak.mean / nominal[3] == pytest.approx(0.4, abs=4.0 * weak.std / nominal[3])
    assert weak.mean / nominal[3] == pytest.approx(0.4, abs=0.05)


@pytest.mark.slow
def test_result_says_all_that_the_contract_asks(found: Results, crossing: Crossing) -> None:
    text = results_json(found)
    assert Results.model_validate(json.loads(text)) == found
    assert "NaN" not in text
    assert crossing.parameters is not None
    assert {"r_hat", "ess", "acceptance", "iterations", "seconds"} <= set(crossing.diagnostics)
    # Total mass 1 %, common gain 1 %, mean of four gains of 1 % each.
    assert crossing.scale_error == pytest.approx(np.sqrt(0.01**2 + 0.01**2 + 0.005**2), rel=1e-6)
    assert crossing.covariance is not None
    matrix = np.array(crossing.covariance.matrix)
    assert matrix.shape == (len(crossing.covariance.names),) * 2
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9)
    for i, name in enumerate(crossing.covariance.names):
        assert np.sqrt(matrix[i, i]) == pytest.approx(crossing.parameters[name].std, rel=0.01), name
    assert crossing.scale_error is not None
    for e in range(1, 8):  # no interval is narrower than the scale error
        p = crossing.parameters[f"EI_{e}"]
        assert p.std / p.mean > 0.9 * crossing.scale_error
        assert p.prior is not None
    assert crossing.road is not None
    assert crossing.road.std_m is not None
    assert len(crossing.road.std_m) == len(crossing.road.x_m) > 500
    assert min(crossing.road.std_m) > 0.0
    assert crossing.derived is not None
    truth = refine(beam_of(paper_site().bridges[0], scenario_ratios(6)), 10)
    frequency = crossing.derived.f1_hz
    assert frequency.std / frequency.mean < 0.01
    assert abs(frequency.mean - natural_frequencies_hz(truth, 1)[0]) < 4.0 * frequency.std
    assert 0.002 < crossing.derived.max_deflection_m.mean < 0.008  # static: near 5 mm


@pytest.mark.slow
@pytest.mark.xfail(reason="the deflection's interval leaves out the error of the common gain")
def test_deflection_knows_of_the_common_gain(crossing: Crossing) -> None:
    """A deflection M/EI is proportional to the common gain; the mass cancels."""
    assert crossing.derived is not None
    deflection = crossing.derived.max_deflection_m
    assert deflection.std / deflection.mean > np.hypot(0.01, 0.005)
