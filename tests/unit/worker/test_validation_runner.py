"""Pairs whose crossings wait: which certificate is made, found, looked for again."""

import logging
from collections import deque
from functools import partial
from pathlib import Path
from typing import cast

import pytest

from schemas.settings import IdentificationSettings
from schemas.validation_records import (
    ValidationCrossing,
    ValidationRecord,
    VehicleBridgePair,
    load_validation,
    pair_hash,
    validation_json,
    validation_path,
)
from services.execution.processes import BackgroundResult, BackgroundTask, ProcessExecutor
from services.history.validation_files import passed_validations, save
from services.simulation.drive import paper_site
from services.worker.validation_runner import CHECK_EVERY_S, ValidationRunner
from tests.builders.certificates import certificate
from tests.unit.simulation.test_validation_trial import made_up

SECOND = VehicleBridgePair("truck-1", "bridge-2")
_PAPER = paper_site()
SITE = _PAPER.model_copy(
    update={
        "bridges": (
            *_PAPER.bridges,
            _PAPER.bridges[0].model_copy(update={"id": "bridge-2"}),
        )
    }
)
PAIR = VehicleBridgePair("truck-1", "bridge-1")
SETTINGS = IdentificationSettings()


class Places:
    """In the place of processes: whoever calls computes, with outcomes that are made up."""

    def __init__(self, verdict: str = "good") -> None:
        self.verdict = verdict
        self.asides: deque[BackgroundTask] = deque()
        self.begun = 0
        self._aftermaths: list[BackgroundResult] = []

    @property
    def wants_background(self) -> bool:
        return len(self.asides) < 2

    def submit_background(self, task: BackgroundTask) -> None:
        self.asides.append(task)

    def cancel_background(self) -> None:
        self.asides.clear()

    def collect_background(self) -> list[BackgroundResult]:
        found, self._aftermaths = self._aftermaths, []
        return found

    def compute(self) -> None:
        outcome: ValidationCrossing | None = (
            None if self.verdict == "died" else made_up(verdict=self.verdict)
        )
        self._aftermaths.append(BackgroundResult(self.asides.popleft(), outcome))
        self.begun += 1


def certificates(folder: Path, places: Places) -> ValidationRunner:
    return ValidationRunner(folder, SITE, SETTINGS, cast(ProcessExecutor, places))


def until_over(
    one: ValidationRunner, places: Places, now_s: float = 0.0
) -> dict[VehicleBridgePair, str]:
    passed: dict[VehicleBridgePair, str] = {}
    idle = 0
    while idle < 2:  # once more: what ends makes room for the next
        passed |= one.advance(now_s)
        idle = 0 if places.asides else idle + 1
        if places.asides:
            places.compute()
    return passed


def hash_of(pair: VehicleBridgePair) -> str:
    return pair_hash(SITE, pair, SETTINGS)


def put(
    folder: Path, pair: VehicleBridgePair, *, passed: bool, reason: str = "made up"
) -> ValidationRecord:
    made = certificate(SITE, pair, passed=passed, reason=reason)
    save(folder, made)
    return made


def test_nothing_is_done_that_nobody_wants(tmp_path: Path) -> None:
    places = Places()
    one = certificates(tmp_path / "certificates", places)
    assert until_over(one, places) == {}
    assert (places.begun, one.note, one.has_news, one.progress) == (0, "", False, None)
    assert not (tmp_path / "certificates").exists()


@pytest.mark.parametrize("verdict", ["good", "rejected"])
def test_pair_requested_twice_is_validated_once(tmp_path: Path, verdict: str) -> None:
    """By a live crossing and by one of a recording, before, during and after its validation."""
    once, places = Places(verdict), Places(verdict)
    single = certificates(tmp_path / "once", once)
    single.request(PAIR)
    until_over(single, once)
    one = certificates(tmp_path / "twice", places)
    one.request(PAIR)
    one.request(PAIR)
    assert one.advance(0.0) == {}
    one.request(PAIR)
    passed = until_over(one, places, now_s=1.0)
    assert list(passed) == ([PAIR] if verdict == "good" else [])
    assert places.begun == once.begun
    one.request(PAIR)
    until_over(one, places, now_s=2.0)
    assert places.begun == once.begun


def test_pairs_are_validated_in_the_order_in_which_they_are_wanted(tmp_path: Path) -> None:
    places, folder = Places(), tmp_path / "certificates"
    one = certificates(folder, places)
    one.request(SECOND)
    one.request(PAIR)
    assert one.advance(0.0) == {}
    assert one.has_news
    assert one.note == "truck-1 on bridge-2 is being validated; 1 more wait for it"
    assert one.progress == (SECOND, 0.0)
    passed = until_over(one, places)
    assert list(passed) == [SECOND, PAIR]
    assert passed == {pair: hash_of(pair) for pair in (SECOND, PAIR)}
    assert places.begun == 16  # eight each, all good
    assert one.note == ""
    assert passed_validations(folder, SITE, SETTINGS) == passed
    assert load_validation(validation_path(folder, hash_of(PAIR))).reason.startswith("8 of 8")


def test_of_a_hundred_pairs_those_that_drive_come_first(tmp_path: Path) -> None:
    """Who drives most is next when a place is free, however long others have waited."""
    places = Places()
    many = [VehicleBridgePair("truck-1", f"bridge-{n}") for n in range(1, 101)]
    bridges = tuple(_PAPER.bridges[0].model_copy(update={"id": pair.bridge}) for pair in many)
    site = _PAPER.model_copy(update={"bridges": bridges})
    one = ValidationRunner(tmp_path, site, SETTINGS, cast(ProcessExecutor, places))
    for pair in many:
        one.request(pair)
    driving = [many[70], many[3]]
    began: list[VehicleBridgePair] = []
    for _ in range(3000):
        one.advance(0.0, partial(tuple, driving))
        if one.progress is not None and one.progress[0] not in began:
            began.append(one.progress[0])
            if len(began) == 2:
                driving = [many[99]]
        if places.asides:
            places.compute()
        if len(began) == 4:
            break
    assert began == [many[70], many[3], many[99], many[0]]


@pytest.mark.parametrize("verdict", ["rejected", "died"])
def test_failed_validation_is_logged_once_and_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, verdict: str
) -> None:
    places = Places(verdict)
    one = certificates(tmp_path, places)
    one.request(PAIR)
    with caplog.at_level(logging.INFO):
        assert until_over(one, places) == {}
        assert "truck-1 on bridge-1 is not validated: 0 of 5 crossings are good" in one.note
        one.has_news = False
        for n in range(1, 4):
            assert until_over(one, places, n * CHECK_EVERY_S) == {}
        assert (places.begun, one.has_news) == (5, False)
        errors = [r.getMessage() for r in caplog.records if r.levelno == logging.ERROR]
        (line,) = errors
        assert line.startswith("truck-1 on bridge-1 is not validated, its crossings wait: 0 of 5")
        assert "\n" not in line
        assert passed_validations(tmp_path, SITE, SETTINGS) == {}
        # The cause is gone: somebody has made one that passes.
        put(tmp_path, PAIR, passed=True)
        assert one.advance(3.5 * CHECK_EVERY_S) == {}
        assert one.advance(4.0 * CHECK_EVERY_S) == {PAIR: hash_of(PAIR)}
    assert (one.note, one.has_news) == ("", True)
    assert one.advance(5.0 * CHECK_EVERY_S) == {}


def test_one_that_has_failed_before_is_not_tried_again(tmp_path: Path) -> None:
    """The same seeds give the same answer: only another site, method or seed could help."""
    put(tmp_path, PAIR, passed=False, reason="it was so")
    places = Places()
    one = certificates(tmp_path, places)
    one.request(PAIR)
    assert until_over(one, places) == {}
    assert places.begun == 0
    assert one.note == "truck-1 on bridge-1 is not validated: it was so"


def test_one_that_has_come_meanwhile_is_taken(tmp_path: Path) -> None:
    places = Places()
    one = certificates(tmp_path, places)
    put(tmp_path, PAIR, passed=True)
    one.request(PAIR)
    assert one.advance(0.0) == {PAIR: hash_of(PAIR)}
    assert places.begun == 0


def test_one_that_cannot_be_read_is_made_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = validation_path(tmp_path, hash_of(PAIR))
    path.write_text("{")
    places = Places()
    one = certificates(tmp_path, places)
    one.request(PAIR)
    assert until_over(one, places) == {PAIR: hash_of(PAIR)}
    assert load_validation(path).passed
    assert str(path) in caplog.text


def test_what_is_over_does_not_count_for_the_next_pair(tmp_path: Path) -> None:
    """A crossing of a trial whose judgement is there may come back later."""
    places = Places("rejected")
    one = certificates(tmp_path, places)
    one.request(PAIR)
    one.request(SECOND)
    one.advance(0.0)
    while one.progress is not None and one.progress[0] == PAIR:
        late = places.asides[-1]
        places.compute()
        one.advance(0.0)
    one.advance(0.0)
    assert one.progress == (SECOND, 0.0)
    places._aftermaths.append(BackgroundResult(late, made_up(verdict="rejected")))
    places.verdict = "good"
    assert until_over(one, places) == {SECOND: hash_of(SECOND)}
    found = load_validation(validation_path(tmp_path, hash_of(SECOND)))
    assert found.figures.crossings == found.figures.good == 8


def test_at_the_end_nothing_more_is_begun(tmp_path: Path) -> None:
    places = Places()
    one = certificates(tmp_path, places)
    one.request(PAIR)
    one.advance(0.0)
    assert places.asides
    one.end()
    assert not places.asides
    assert list(tmp_path.iterdir()) == []


def test_certificates_of_others_are_none_of_ours(tmp_path: Path) -> None:
    mine = put(tmp_path, PAIR, passed=True)
    save(tmp_path, certificate(SITE, SECOND, passed=False))
    stranger = mine.model_copy(update={"vehicle": "truck-9", "hash": "1" * 16})
    void = mine.model_copy(update={"bridge": "bridge-2", "hash": "2" * 16})
    for one in (stranger, void):
        validation_path(tmp_path, one.hash).write_text(validation_json(one))
    (tmp_path / "nonsense.json").write_text("?")
    assert passed_validations(tmp_path, SITE, SETTINGS) == {PAIR: mine.hash}
    assert passed_validations(tmp_path / "none", SITE, SETTINGS) == {}
