"""Targets and tables of a validation on records that were made up: met by true intervals only."""

import copy
import io
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scipy.special import ndtr

from pre_core.constants import NORMAL_975
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.validation_records import METHOD_EDITION
from services.common.log_lines import progress_log
from services.simulation.drawn import IdentifiedCrossing, draw_truth, drive
from services.simulation.validation_options import IntervalOptions
from studies.simulation.truths import default_site
from studies.validation import calibration, run_intervals, uncertainty
from studies.validation.calibration import (
    GROUPS,
    StudyTarget,
    by_condition,
    checks,
    distribution,
    one_crossing,
    rank_tests,
    scores,
)
from studies.validation.page import validation_page
from studies.validation.run_intervals import print_outcome
from studies.validation.uncertainty import (
    HALF,
    SCENARIO_NOISE_UG,
    ValidationOutcome,
    control_checks,
    judged_checks,
    scenario_checks,
    targets,
)

ELEMENTS = 7
NAMES = [f"EI_{e + 1}" for e in range(ELEMENTS)]


def made_up(count: int, *, narrow: float = 1.0, shift: float = 0.0) -> list[dict[str, Any]]:
    """Crossings with log-normal posteriors; `narrow` divides their widths, `shift` moves them."""
    rng = np.random.default_rng(11)
    records = []
    for seed in range(count):
        truth: dict[str, float] = {}
        estimates: dict[str, dict[str, float]] = {}
        ranks: dict[str, float] = {}
        bound: dict[str, float] = {}
        for name in [*NAMES, *(n for names in GROUPS.values() for n in names)]:
            std = float(rng.uniform(0.02, 0.1))
            truth[name] = 1.56e10
            middle = np.log(truth[name]) + std * (rng.standard_normal() + shift)
            own = std / narrow
            low, high = np.exp(middle - NORMAL_975 * own), np.exp(middle + NORMAL_975 * own)
            mean = float(np.exp(middle + 0.5 * own**2))
            estimates[name] = {
                "mean": mean,
                "std": mean * float(np.sqrt(np.expm1(own**2))),
                "q025": float(low),
                "q50": float(np.exp(middle)),
                "q975": float(high),
            }
            z = (np.log(truth[name]) - middle) / own
            ranks[name] = float(ndtr(z))
            bound[name] = std
        records.append(
            {
                "seed": seed,
                "conditions": {
                    "rate_hz": 1000.0,
                    "speed_m_per_s": 10.0 + seed % 10,
                    "change_m_per_s": 0.1,
                    "period_s": 10.0,
                    "road_class": "A",
                    "noise_ug_per_rthz": 30.0,
                    "forward": seed % 2 == 0,
                    "fix_rate_hz": 10.0,
                },
                "truth": truth,
                "verdict": "good",
                "reasons": [],
                "chi2_per_dof": 1.0 + 0.02 * float(rng.standard_normal()),
                "diagnostics": {"r_hat": 1.01, "ess": 900.0, "seconds": 4.0},
                "estimates": estimates,
                "ranks": ranks,
                "bound": {"std": bound},
                "road_z": 1.0,
            }
        )
    return records


def missed(found: list[StudyTarget]) -> set[str]:
    return {check.name for check in found if not check.is_met}


def test_true_intervals_meet_all_targets() -> None:
    assert missed(checks(made_up(200))) == set()


def test_intervals_that_are_too_narrow_miss_coverage_scores_and_ranks() -> None:
    names = missed(checks(made_up(200, narrow=1.6)))
    assert {"pooled coverage", "root mean square of z, ln EI", "ranks of EI, p"} <= names
    assert "ranks of vehicle, p" in names


def test_intervals_that_are_too_wide_are_no_better() -> None:
    names = missed(checks(made_up(200, narrow=0.7)))
    assert {"pooled coverage", "mean standard deviation over bound", "ranks of EI, p"} <= names


def test_estimates_to_one_side_show_in_the_ranks() -> None:
    names = missed(checks(made_up(200, shift=0.3)))
    assert {"ranks of EI, p", "ranks of vehicle, p"} <= names
    assert "root mean square of z, ln EI" not in names  # which is why ranks are looked at


def test_one_good_crossing_that_is_far_off_misses_its_target() -> None:
    records = made_up(100)
    element = records[7]["estimates"]["EI_3"]
    for key in ("mean", "q025", "q50", "q975"):
        element[key] *= 3.0
    assert "largest |z| among good" in missed(checks(records))
    records[7]["verdict"] = "suspect"
    assert "largest |z| among good" not in missed(checks(records))


def test_few_good_ones_miss_a_target_and_rejected_ones_count() -> None:
    records = made_up(100)
    for line in records[:6]:
        line |= {"verdict": "rejected", "estimates": {}, "ranks": {}, "reasons": ["failed"]}
    assert "share good" in missed(checks(records))
    assert scores(records).seeds.size == 94


def test_nothing_to_measure_is_a_missed_target() -> None:
    records = [line | {"estimates": {}, "verdict": "rejected"} for line in made_up(5)]
    assert missed(checks(records)) == {"crossings with numbers"}


def test_what_is_declared_reaches_the_site_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """The control's owner believes in half the noise; the sensors have all of it."""
    drawn = drive(default_site(), draw_truth(default_site(), 3), 3)
    published: list[Site] = []

    def see(runs: object, site: Site, settings: object) -> list[IdentifiedCrossing]:
        published.append(site)
        return []

    monkeypatch.setattr(calibration, "drive", lambda *_: drawn)
    monkeypatch.setattr(calibration, "identify_simulated", see)
    one_crossing(default_site(), 3, IdentificationSettings(), HALF)
    [site] = published
    density = np.array(drawn.site.sensor.noise_density_ug_per_rthz)
    np.testing.assert_allclose(site.sensor.noise_density_ug_per_rthz, 0.5 * density, rtol=1e-12)


def test_a_control_that_stays_unnoticed_is_a_missed_target() -> None:
    records = made_up(20)
    assert len(missed(control_checks(records))) == 2
    seen = [line | {"verdict": "rejected", "reasons": ["model_misfit"]} for line in records]
    assert missed(control_checks(seen)) == set()


def test_ranks_are_tested_by_group_and_parameter() -> None:
    tests = rank_tests(made_up(60))
    assert set(tests) == {"EI", *GROUPS}
    assert tuple(tests["supports"]) == ("k_rot_start", "k_rot_end")
    assert sum(tests["EI"]["EI_1"].counts) == 60


def test_group_is_tested_without_what_a_truck_lacks() -> None:
    records = made_up(60)
    for line in records:
        del line["ranks"]["share"]
    tests = rank_tests(records)
    assert set(tests) == {"EI", *GROUPS}
    assert set(tests["vehicle"]) == set(GROUPS["vehicle"]) - {"share"}


def test_conditions_and_distributions_count_what_they_say() -> None:
    records = made_up(50)
    rows = {row[0]: row for row in by_condition(records)}
    assert rows["start to end"][1] == rows["end to start"][1] == 25
    assert "at most 200 Hz" not in rows
    seconds = distribution(records, "seconds")
    assert seconds is not None
    assert seconds["median"] == 4.0
    spread = distribution([{"seconds": float(n)} for n in (3, 1, 2)], "seconds")
    assert spread is not None
    assert (spread["least"], spread["median"], spread["most"]) == (1.0, 2.0, 3.0)
    assert distribution(records, "starts") is None


def _scenario(off: float) -> dict[str, Any]:
    nominal = dict.fromkeys(NAMES, 1.56e10)
    ratios = dict.fromkeys(NAMES, 1.0) | {"EI_7": 0.4}
    return {
        "scenario": 12,
        "noise_ug_per_rthz": 25.0,
        "verdict": "good",
        "reasons": [],
        "chi2_per_dof": 1.0,
        "nominal": nominal,
        "elements": {
            name: {"truth": r * 1.56e10, "mean": (r + off) * 1.56e10, "std": 0.03 * 1.56e10}
            for name, r in ratios.items()
        },
    }


@pytest.mark.parametrize(("off", "is_met"), [(0.0, True), (0.049, True), (0.051, False)])
def test_scenario_12_must_be_found_within_its_limit(off: float, is_met: bool) -> None:
    (check, _) = scenario_checks([_scenario(off)])
    assert check.is_met == is_met


def _judged(off: float = 0.0, **others: Any) -> dict[str, Any]:
    line = _scenario(0.0)
    for element in line["elements"].values():
        element |= {"mean": element["truth"] * (1.0 + off), "std": 0.01 * element["truth"]}
        element["bound"] = 0.009 * element["truth"]
    return line | {"folder": "d1_clean_const_speed", "run": 0, "chi2_at_truth": 1.0} | others


def test_judged_crossings_have_a_tolerance_a_width_and_a_verdict() -> None:
    assert missed(judged_checks(_judged())) == set()
    assert len(missed(judged_checks(_judged(off=0.031)))) == 1
    assert len(missed(judged_checks(_judged(verdict="suspect")))) == 1
    assert len(missed(judged_checks(_judged(chi2_per_dof=1.3)))) == 1
    wide = _judged()
    wide["elements"]["EI_2"]["bound"] *= 0.7
    assert missed(judged_checks(wide)) == {"d1 run 0: std over bound"}
    one_off = _judged()
    one_off["elements"]["EI_2"]["mean"] *= 1.05
    assert missed(judged_checks(one_off)) == {"d1 run 0: error over allowed"}
    rejected = _judged(verdict="rejected", chi2_per_dof=None)
    assert len(missed(judged_checks(rejected))) == 4


def _outcome() -> ValidationOutcome:
    control = [
        line | {"verdict": "rejected", "reasons": ["model_misfit"], "estimates": {}}
        for line in made_up(5)
    ]
    return ValidationOutcome(
        made_up(40), control, [_scenario(0.01)], [_judged()], Path("crossings")
    )


def test_page_holds_every_target_and_every_part() -> None:
    outcome = _outcome()
    page = validation_page(outcome)
    judged = [check.name for line in outcome.judged for check in judged_checks(line)]
    assert judged
    for check in targets(outcome):
        # What has a table of its own is listed only where it is missed.
        is_listed = check.name not in judged or not check.is_met
        assert (f"| {check.name.replace('|', chr(92) + '|')} |" in page) is is_listed
    assert f"of method version {METHOD_EDITION}." in " ".join(page.split())
    assert "40 crossings, seeds 0 to 39" in page
    assert "0 of 5 are `good`, 5 of 5 have a reason that names the misfit" in " ".join(page.split())
    assert "| 12 | EI_7 | 0.40 |" in page
    assert "d1_clean_const_speed 0 | good" in page
    assert "{" not in page
    left_out = validation_page(outcome._replace(judged=[], judged_from=None))
    assert "Not judged in this run" in left_out


def test_page_counts_listed_and_unlisted_targets() -> None:
    outcome = _outcome()
    outcome = outcome._replace(judged=[_judged(), _judged(run=1, verdict="suspect")])
    page = " ".join(validation_page(outcome).split())
    listed = page.count("| met |") + page.count("| **missed** |")
    assert "Met of them: d1 run 0: 4 of 4, d1 run 1: 3 of 4." in page
    missed_, all_ = re.search(r"(\d+) of (\d+) targets are missed", page).groups()  # type: ignore[union-attr]
    assert int(missed_) == page.count("| **missed** |")
    assert int(all_) == listed + 4 + 3 == len(targets(outcome))
    assert "Met of them" not in validation_page(outcome._replace(judged=[]))


def test_a_missed_target_stands_out_on_page_and_screen() -> None:
    outcome = _outcome()
    bad = copy.deepcopy(outcome.judged)
    bad[0]["verdict"] = "suspect"
    outcome = outcome._replace(judged=bad)
    assert "| d1 run 0: is good | 0 | 1 | **missed** |" in validation_page(outcome)
    out = io.StringIO()
    print_outcome(Console(file=out, width=80), outcome, targets(outcome))
    text = out.getvalue()
    assert "d1 run 0: is good" in text
    assert "MISSED" in text
    assert max(len(line) for line in text.splitlines()) <= 80


def _options(truth: Path, processes: int) -> IntervalOptions:
    return IntervalOptions(
        crossings=40,
        control=5,
        scenarios=(12,),
        out_of_model=0,
        effects=(),
        records=Path("unused"),
        truth=truth,
        site=None,
        processes=processes,
        json=None,
        figures=None,
        page=None,
    )


@pytest.mark.parametrize(("verdict", "code"), [("good", 0), ("suspect", 1)])
def test_the_command_ends_with_1_where_a_target_is_missed(
    monkeypatch: pytest.MonkeyPatch, verdict: str, code: int
) -> None:
    """The hours of computing are left out: what they gave is made up."""
    outcome = _outcome()._replace(drawn=made_up(200), judged=[_judged(verdict=verdict)])
    monkeypatch.setattr(run_intervals, "run_parts", lambda *_, **__: outcome)
    asked = _options(Path("unused"), processes=1)
    assert run_intervals.run(asked, Console(file=io.StringIO(), width=80)) == code


def test_study_announces_its_crossings_before_the_first(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level(logging.INFO, progress_log.name)
    monkeypatch.setattr(uncertainty, "in_processes", _stopped)
    asked = _options(tmp_path, processes=2)
    with pytest.raises(KeyboardInterrupt):
        run_intervals.run(asked, Console(file=io.StringIO(), width=80))
    noises = len(SCENARIO_NOISE_UG)
    assert caplog.messages == [f"validating {45 + noises} simulated crossings on 2 processes"]


def _stopped(*_: object) -> None:
    raise KeyboardInterrupt
