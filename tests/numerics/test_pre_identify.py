"""Method `pre` from a recording to a result: one noisy crossing of the paper's scenario 6.

One crossing shows that the parts fit together. It does not show that the intervals are right: that
takes many crossings.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from pre_core.paper.experiment import scenario_ratios
from pre_core.physics.bridge import natural_frequencies_hz, refine
from pre_core.physics.simulate import CoupledResponse
from schemas.results import CrossingResult, Results, results_json
from schemas.settings import IdentificationSettings
from services.drives.runs import Run
from services.simulation import drive as simulation
from services.simulation.drive import (
    DrivenRoad,
    Measurement,
    beam_of,
    declared_site,
    measured_run,
    paper_site,
    simulate_drive,
    write_drive,
)
from services.simulation.wheel_paths import AxleRoads
from tests.identifications import identify_recordings

NOISE_UG = 25.0
SEED = 3


class Found(NamedTuple):
    results: Results
    largest_deflection_m: float
    """True, under a wheel."""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    """Scenario 6 at 10 m/s over a road of class A, 25 µg/√Hz, with errors of the receiver."""
    path: Path = tmp_path_factory.mktemp("pre") / "scenario-6.mcap"
    site = paper_site()
    simulated: list[CoupledResponse] = []

    def keeping(*arguments: Any, **named: Any) -> tuple[Run, AxleRoads, CoupledResponse]:
        measured = measured_run(*arguments, **named)
        simulated.append(measured[2])
        return measured

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "measured_run", keeping)
        drive = simulate_drive(
            site,
            scenario_ratios(6),
            DrivenRoad("A", SEED),
            Measurement(NOISE_UG, has_receiver_errors=True),
        )
    known = declared_site(site, NOISE_UG, drive.run.rate_hz)
    write_drive(path, drive, known)
    results = identify_recordings([path], known, IdentificationSettings(method="pre", seed=0))
    return Found(results, -float(simulated[0].wheel_deflection_m.min()))


@pytest.fixture(scope="module")
def crossing(found: Found) -> CrossingResult:
    assert len(found.results.crossings) == 1
    return found.results.crossings[0]


@pytest.mark.slow
def test_rigidities_lie_within_their_intervals(crossing: CrossingResult) -> None:
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
def test_result_says_all_that_the_contract_asks(found: Found, crossing: CrossingResult) -> None:
    text = results_json(found.results)
    assert Results.model_validate(json.loads(text)) == found.results
    assert "NaN" not in text
    assert crossing.parameters is not None
    assert {"r_hat", "ess", "acceptance", "iterations", "seconds"} <= set(crossing.diagnostics)
    # Total mass 1 %; common gain 1 % and the mean of four gains of 1 % each, less what the static
    # load observes of them. (The draws' standard deviation has an error of 2 %.)
    assert crossing.scale_error is not None
    assert 0.01 < crossing.scale_error < 1.06 * np.sqrt(0.01**2 + 0.01**2 + 0.005**2)
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
def test_deflection_is_that_of_the_simulation(found: Found) -> None:
    """Within its interval, which is narrower than the common gain's own prior spread of 1.1 %: the
    weight of the truck, which no sensor measures, determines both."""
    derived = found.results.crossings[0].derived
    assert derived is not None
    deflection = derived.max_deflection_m
    assert abs(deflection.mean - found.largest_deflection_m) < 4.0 * deflection.std
    assert 0.001 < deflection.std / deflection.mean < 0.012
