"""Groups of a survey's crossings: which there are, what is counted as seen and as falsely_named."""

import numpy as np
import pytest

from schemas.site import Bridge
from services.simulation.survey_kinds import KINDS
from studies.simulation.truths import default_site
from studies.validation import detection
from studies.validation.calibration import Record
from studies.validation.detection import CrossingGroup, groups_of
from studies.validation.surveys import crossing_truth
from tests.unit.identification.test_fusing import crossing

WEAK = (1.0, 1.0, 1.0, 0.7, 1.0, 1.0, 1.0)


def bridge() -> Bridge:
    return default_site().bridges[0]


def record(kind: str, survey: int, number: int, ratio: tuple[float, ...] = WEAK) -> Record:
    return {
        "effect": kind,
        "seed": survey,
        "number": number,
        "verdict": "good",
        "result": crossing(number, ratio).model_dump(mode="json"),
    }


def test_groups_of_a_size_share_no_crossing_and_no_survey() -> None:
    records = [record("scenario-5", survey, number) for survey in (0, 1) for number in range(5)]
    found = groups_of([*records, record("steady", 0, 0)], bridge(), (1, 2, 4, 8))
    sizes = [group.crossings for group in found]
    assert [sizes.count(size) for size in (1, 2, 4, 8)] == [10, 4, 2, 0]
    assert {group.weak for group in found} == {frozenset({4})}
    assert {group.kind for group in found} == {"scenario-5"}


def test_a_weak_element_is_seen_and_no_sound_one() -> None:
    found = groups_of([record("scenario-5", 0, n) for n in range(4)], bridge(), (2, 4))
    for line in detection.detection(found):
        assert (line.named, line.below, line.falsely_named, line.undamaged_below) == (
            1.0,
            1.0,
            0.0,
            0.0,
        )
        assert line.loss is not None
        low, middle, high = line.loss
        assert 0.2 < low < middle < high < 0.4
        assert middle == pytest.approx(0.3, abs=0.05)


def test_weak_element_of_a_tandem_survey_is_that_of_its_ratios() -> None:
    records = [record("tandem-weak", 0, n) for n in range(2)]
    (group,) = groups_of([*records, record("tandem", 0, 0)], bridge(), (2,))
    assert (group.kind, group.weak) == ("tandem-weak", frozenset({3}))
    truth, _ = crossing_truth(default_site(), KINDS["tandem-weak"], 0, 0, 0)
    ratios = truth.beam.flexural_rigidity_nm2 / truth.beam.flexural_rigidity_nm2[0]
    np.testing.assert_allclose(ratios, [1.0, 1.0, 0.8, 1.0, 1.0, 1.0, 1.0])


def test_a_sound_element_that_is_called_weak_is_an_accusation() -> None:
    """Scenario 10 has its weak element at the end, and these crossings show it in the middle."""
    (line,) = detection.detection(
        groups_of([record("scenario-10", 0, n) for n in range(4)], bridge(), (4,))
    )
    assert (line.named, line.below, line.falsely_named) == (0.0, 0.0, 1.0)
    assert line.undamaged_below == pytest.approx(1.0 / 6.0)
    (sound,) = detection.detection(
        groups_of([record("scenario-1", 0, n) for n in range(4)], bridge(), (4,))
    )
    assert (sound.named, sound.below, sound.loss) == (None, None, None)
    assert sound.falsely_named == 1.0
    assert detection.cells(sound)[3:6] == ["–"] * 3


def test_groups_without_an_answer_are_counted_apart() -> None:
    silent = record("scenario-5", 0, 0) | {"result": None}
    found = groups_of([silent, record("scenario-5", 0, 1)], bridge(), (1,))
    (line,) = detection.detection(found)
    assert (line.groups, line.answered, line.named) == (2, 0.5, 1.0)
    cells = detection.cells(line)
    assert len(cells) == len(detection.HEADINGS)
    assert cells[2] == "1 of 2"
    (nothing,) = detection.detection([CrossingGroup("scenario-5", 1, frozenset({4}), None)])
    assert detection.cells(nothing)[3:] == ["–"] * 5
    assert np.isclose(nothing.answered, 0.0)
