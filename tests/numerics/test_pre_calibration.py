"""A small part of `make validate`: are the intervals of method `pre` true?

Few crossings have little power: limits are those that true intervals miss once in thousands of
runs. The whole is on docs/validation.md.
"""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from schemas.settings import IdentificationSettings
from studies.simulation.truths import default_site
from studies.validation import calibration_statistics as statistics
from studies.validation.calibration import Record, in_processes, one_crossing, scores
from studies.validation.uncertainty import HALF, JUDGED, judged_checks, one_judged, one_scenario

SITE = default_site()
SETTINGS = IdentificationSettings(method="pre", threads=1)
CROSSINGS = 12
CONTROLS = range(4, 7)


def test_one_crossing_is_found_as_well_as_its_data_allow() -> None:
    line = one_crossing(SITE, 29, SETTINGS)
    assert line["verdict"] in ("good", "suspect"), line["reasons"]
    assert line["bound"]["at_truth"]["chi2_per_dof"] == pytest.approx(1.0, abs=0.1)
    found = scores([line])
    assert np.abs(found.z_log).max() < 5.0
    np.testing.assert_allclose(found.std_log / found.bound, 1.0, atol=0.4)
    assert all(0.0 <= rank <= 1.0 for rank in line["ranks"].values())


@pytest.fixture(scope="module")
def lines() -> list[Record]:
    jobs = [partial(one_crossing, SITE, seed, SETTINGS) for seed in range(CROSSINGS)]
    jobs += [partial(one_crossing, SITE, seed, SETTINGS, HALF) for seed in CONTROLS]
    jobs.append(partial(one_scenario, 12, 25.0, SETTINGS))
    return in_processes(jobs, 2)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_dozen_crossings(lines: list[Record]) -> None:
    drawn = lines[:CROSSINGS]
    assert [line["seed"] for line in drawn] == list(range(CROSSINGS))
    found = scores(drawn)
    assert found.seeds.size >= CROSSINGS - 1
    assert found.is_covered.mean() > 0.85
    assert 0.75 < statistics.root_mean_square(found.z_log) < 1.4
    assert found.std_log.mean() < 1.25 * found.bound.mean()
    assert np.abs(found.z_log[found.is_good]).max(initial=0.0) < 5.0


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_half_the_noise_declared_is_seen(lines: list[Record]) -> None:
    for line in lines[CROSSINGS : CROSSINGS + len(CONTROLS)]:
        assert line["verdict"] != "good"
        assert {"model_misfit", "noise_above_declared"} & set(line["reasons"])


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_weak_edge_element_of_scenario_12(lines: list[Record]) -> None:
    element = lines[-1]["elements"]["EI_7"]
    assert element["mean"] / lines[-1]["nominal"]["EI_7"] == pytest.approx(0.4, abs=0.05)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", JUDGED)
def test_crossings_of_an_independent_simulator(shared: Path, name: str) -> None:
    folder = shared / "crossings" / name
    line = one_judged(folder, 0, SETTINGS)
    missed = [check.name for check in judged_checks(line) if not check.is_met]
    assert missed == [], line["reasons"]
