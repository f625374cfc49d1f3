"""Crossings that wait for a certificate, and what becomes of them."""

import logging
from collections.abc import Iterable

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.topics import Message
from schemas.validation_records import VehicleBridgePair
from services.execution.dispatch import dispatch
from services.execution.inline import InlineExecutor
from services.identification import waiting as under_test
from services.identification.engine import Engine
from services.identification.known import CrossingRecord, search_hash
from services.identification.outputs import IdentificationTask, Output, ValidationRequest
from services.identification.waiting import Validations
from tests.builders.ledger import known_crossings
from tests.identifications import Identifications
from tests.unit.identification.test_engine_resume import (
    HEADER,
    SETTINGS,
    SITE,
    THERE_AND_BACK,
    TWO,
    WHOLE,
    EngineOutput,
    messages_of,
    output_of,
)

PAIR = VehicleBridgePair("truck-1", "bridge-1")
DIGEST = "0123456789abcdef"
FIVE = messages_of(
    *THERE_AND_BACK, (60.0, -60.0), (80.0, 140.0), (90.0, 140.0), (110.0, -60.0),
    (120.0, -60.0), (140.0, 140.0),
)  # fmt: skip


class Asking:
    """An engine that asks for certificates, whose works are done at once."""

    def __init__(
        self, certificates: dict[VehicleBridgePair, str] | None = None, *, has_room: bool = True
    ) -> None:
        self.engine = Engine(
            SITE,
            SETTINGS,
            HEADER,
            validations=Validations(certificates or {}, are_required=True),
            has_room=lambda: has_room,
        )
        self.here = InlineExecutor(identify=Identifications(), stopwatch=lambda: 0.0)
        self.wanted: list[VehicleBridgePair] = []

    def fed(self, messages: Iterable[Message]) -> list[Output]:
        return [o for m in messages for o in self.published(self.engine.feed(m.key, m.payload))]

    def published(
        self, sent: Iterable[Output | IdentificationTask | ValidationRequest]
    ) -> list[Output]:
        return list(dispatch(self.engine, self.here, sent, self.wanted.append))

    def resumed(self, sent: EngineOutput) -> list[Output]:
        return self.published(self.engine.resume(known(sent)))

    def released(self) -> list[Output]:
        found = []
        while self.engine.has_released:
            found += self.published(self.engine.release())
        return found


def names(outputs: Iterable[Output]) -> list[tuple[str, str]]:
    """Published states and estimates by crossing."""
    found = []
    for output in outputs:
        if output.result is not None:
            found.append((output.result.crossing_id, "estimate"))
        elif output.key.stream == "crossing":
            message = pb.Crossing.FromString(output.payload)
            found.append((message.crossing_id, pb.CrossingState.Name(message.state)))
    return found


def of_one(crossing_id: str, *what: str) -> list[tuple[str, str]]:
    return [(crossing_id, one) for one in what]


WAITS = ("DETECTED", "COMPLETE", "WAITING_NOT_VALIDATED")
GOES_ON = ("IDENTIFYING", "estimate", "DONE")
ONE, OTHER = list(dict.fromkeys(name for name, _ in names(WHOLE)))


def test_without_a_certificate_all_wait_and_it_is_wanted_once() -> None:
    asking = Asking()
    outputs = asking.fed(TWO)
    assert names(outputs) == of_one(ONE, *WAITS) + of_one(OTHER, *WAITS)
    assert asking.wanted == [PAIR]
    assert asking.engine.waiting() == {PAIR: [ONE, OTHER]}
    assert not asking.engine.has_released
    assert asking.released() == []
    assert asking.published(asking.engine.release()) == []
    assert not asking.engine.has_undecided(*("sim-test", "truck-1"))


def test_with_one_they_go_on_in_order_and_name_it() -> None:
    asking = Asking()
    waiting = asking.fed(TWO)
    asking.engine.certify(PAIR, DIGEST)
    outputs = asking.released()
    assert names(outputs) == of_one(ONE, *GOES_ON) + of_one(OTHER, *GOES_ON)
    results = [output.result for output in outputs if output.result is not None]
    assert [result.certificate for result in results] == [DIGEST, DIGEST]
    on_the_wire = [
        pb.Estimate.FromString(o.payload).certificate for o in outputs if o.key.stream == "estimate"
    ]
    assert on_the_wire == [DIGEST, DIGEST]
    assert asking.engine.waiting() == {}
    # Nothing else differs from what was published where nobody asks.
    waited = pb.WAITING_NOT_VALIDATED
    published = [
        o
        for o in [*waiting, *outputs]
        if o.key.stream != "crossing" or pb.Crossing.FromString(o.payload).state != waited
    ]
    assert sorted(payload_but_certificate(o) for o in published) == sorted(
        payload_but_certificate(o) for o in WHOLE
    )


def payload_but_certificate(output: Output) -> tuple[str, bytes]:
    if output.key.stream != "estimate":
        return output.key.stream, output.payload
    estimate = pb.Estimate.FromString(output.payload)
    estimate.certificate = ""
    return output.key.stream, estimate.SerializeToString(deterministic=True)


def test_one_that_is_known_before_holds_up_nothing() -> None:
    asking = Asking({PAIR: DIGEST})
    outputs = asking.fed(TWO)
    assert [o.key.stream for o in outputs] == [o.key.stream for o in WHOLE]
    assert asking.wanted == []
    assert {o.result.certificate for o in outputs if o.result} == {DIGEST}


def test_where_nobody_asks_results_name_one_that_is_known() -> None:
    engine = Engine(SITE, SETTINGS, HEADER, validations=Validations({PAIR: DIGEST}))
    here = InlineExecutor(identify=Identifications())
    outputs = [o for m in TWO for o in dispatch(engine, here, engine.feed(m.key, m.payload))]
    assert {o.result.certificate for o in outputs if o.result} == {DIGEST}
    assert {o.result.certificate for o in WHOLE if o.result} == {None}


def test_one_at_a_time_and_none_overtakes_another() -> None:
    """The third comes while the second still waits behind the first: it waits, but untold."""
    asking = Asking()
    first = asking.fed(m for m in FIVE if m.log_time_ns < TWO[-1].log_time_ns)
    assert names(first)[-1] == (OTHER, "WAITING_NOT_VALIDATED")
    asking.engine.certify(PAIR, DIGEST)
    assert names(asking.published(asking.engine.release())) == of_one(ONE, *GOES_ON)
    rest = asking.fed(m for m in FIVE if m.log_time_ns >= TWO[-1].log_time_ns)
    assert {what for _, what in names(rest)} == {"DETECTED", "COMPLETE"}
    after = names(asking.released())
    assert [name for name, what in after if what == "estimate"] == [
        OTHER, *dict.fromkeys(name for name, _ in names(rest))
    ]  # fmt: skip
    assert asking.engine.waiting() == {}


def test_another_pair_is_not_held_up() -> None:
    """A second truck on the same bridge, which has its certificate."""
    second = SITE.vehicles[0].model_copy(update={"id": "truck-2"})
    site = SITE.model_copy(update={"vehicles": (*SITE.vehicles, second)})
    other = VehicleBridgePair("truck-2", "bridge-1")
    asking = Asking()
    known = Validations({other: DIGEST}, are_required=True)
    asking.engine = Engine(site, SETTINGS, HEADER, validations=known)
    asking.fed(TWO)
    theirs = [m._replace(key=m.key._replace(identifier="truck-2")) for m in TWO]
    outputs = asking.fed(theirs)
    assert [o.result.vehicle for o in outputs if o.result] == ["truck-2"] * 2
    assert asking.engine.waiting() == {PAIR: [ONE, OTHER]}


def test_busiest_and_latest_pairs_are_printed_first() -> None:
    names = ("truck-1", "truck-2", "truck-3")
    site = SITE.model_copy(
        update={"vehicles": tuple(SITE.vehicles[0].model_copy(update={"id": n}) for n in names)}
    )
    asking = Asking()
    asking.engine = Engine(site, SETTINGS, HEADER, validations=Validations(are_required=True))

    def drives(name: str, messages: list[Message]) -> None:
        asking.fed(m._replace(key=m.key._replace(identifier=name)) for m in messages)

    one_way = [m for m in TWO if m.log_time_ns < TWO[-1].log_time_ns - 25_000_000_000]
    pairs = [VehicleBridgePair(name, "bridge-1") for name in names]
    drives("truck-1", one_way)
    drives("truck-2", one_way)
    assert asking.engine.waiting_pairs() == [pairs[1], pairs[0]]
    drives("truck-3", TWO)
    assert asking.engine.waiting_pairs() == [pairs[2], pairs[1], pairs[0]]
    drives("truck-1", TWO)
    assert asking.engine.waiting_pairs() == [pairs[0], pairs[2], pairs[1]]


def test_results_wait_for_room_and_delay_no_process() -> None:
    """Only those of which there is a recording, should too many wait; and they go on in order."""
    asking = Asking({PAIR: DIGEST}, has_room=False)
    assert len([o for o in asking.fed(TWO) if o.result]) == 2
    asking = Asking({PAIR: DIGEST}, has_room=False)
    asking.engine.note_recorded({"truck-1": 1 << 62})
    outputs = asking.fed(TWO)
    assert names(outputs) == of_one(ONE, "DETECTED", "COMPLETE") + of_one(
        OTHER, "DETECTED", "COMPLETE"
    )
    assert asking.wanted == []
    assert asking.engine.has_released
    outputs += asking.released()
    assert sorted(output_of(outputs)) == sorted(output_of(Asking({PAIR: DIGEST}).fed(TWO)))


@pytest.mark.parametrize("number", range(7))
def test_a_run_that_was_cut_off_while_they_waited_goes_on(number: int) -> None:
    """Whatever was published of them before: no state is published twice, none is left out."""
    before = Asking().fed(TWO)[:number]
    asking = Asking()
    asking.resumed(output_of(before))
    again = asking.fed(TWO)
    assert output_of(before) + output_of(again) == output_of(Asking().fed(TWO))
    assert asking.wanted == [PAIR]
    asking.engine.certify(PAIR, DIGEST)
    assert names(asking.released()) == of_one(ONE, *GOES_ON) + of_one(OTHER, *GOES_ON)


@pytest.mark.parametrize("number", range(13))
def test_a_run_that_was_cut_off_while_they_went_on_goes_on(number: int) -> None:
    """The certificate is in the folder by now."""

    def whole() -> list[Output]:
        asking = Asking()
        outputs = asking.fed(TWO)
        asking.engine.certify(PAIR, DIGEST)
        return outputs + asking.released()

    before = whole()[: 6 + number]
    asking = Asking({PAIR: DIGEST})
    after = [*asking.resumed(output_of(before)), *asking.fed(TWO)]
    assert sorted(output_of(before) + output_of(after)) == sorted(output_of(whole()))


def known(sent: EngineOutput) -> list[CrossingRecord]:
    return known_crossings(sent, search_hash(HEADER))


def test_overdue_crossings_are_reported_as_given_up(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(under_test, "MAX_WAITING_CROSSINGS", 3)
    asking = Asking()
    with caplog.at_level(logging.WARNING):
        published = names(asking.fed(FIVE))
    crossings = list(dict.fromkeys(name for name, _ in published))
    assert len(crossings) == 5
    assert asking.engine.waiting() == {PAIR: crossings[2:]}
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 2
    assert all(f"dropping {name}:" in line for name, line in zip(crossings, lines, strict=False))
    assert all("driveby identify" in line for line in lines)
