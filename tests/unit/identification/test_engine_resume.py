"""A run of the worker's deciding part that goes on from what earlier runs said."""

import logging
from collections.abc import Iterable

import numpy as np
import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.results import BridgeResult, ResultHeader
from schemas.results_on_the_wire import crossing_to_protobuf, state_to_bridge
from schemas.settings import IdentificationSettings
from schemas.signals import decode_accel, encode_accel
from schemas.site_file import site_hash
from schemas.topics import Key, Message
from services.common.geodesy import bridge_frame, to_lat_lon
from services.drives.runs import GnssTrack, Run, run_to_messages
from services.execution.inline import InlineExecutor
from services.identification.bridge_state import state_of
from services.identification.engine import Engine
from services.identification.known import search_hash
from services.identification.outputs import (
    FusionTask,
    IdentificationTask,
    Output,
    ValidationRequest,
)
from services.simulation.drive import paper_site
from tests.builders.ledger import known_crossings
from tests.identifications import Identifications
from tests.working_engine import WorkingEngine

REALM = "sim-test"
START_S = 1_767_225_600.0
SITE = paper_site()
SETTINGS = IdentificationSettings(method="least_squares")
HEADER = ResultHeader("0", 0.0, site_hash(SITE), SETTINGS.model_dump(mode="json"), SETTINGS.seed)
EngineOutput = list[tuple[Key, bytes]]


def engine(counted: Identifications | None = None, header: ResultHeader = HEADER) -> WorkingEngine:
    return WorkingEngine(
        SITE, SETTINGS, header, InlineExecutor(identify=counted or Identifications())
    )


def messages_of(
    *legs: tuple[float, float],
    begin_s: float = 0.0,
    without_fixes: tuple[float, float] = (0.0, 0.0),
) -> list[Message]:
    """A drive through (time s, chainage m); the bridge is from 0 to 30 m, the wheelbase 4.4 m."""
    times, places = np.array(legs).T
    accel = np.arange(0.0, times[-1], 0.02)
    fixes = np.arange(0.0, times[-1] + 0.05, 0.1)
    front = np.interp(fixes, times, places)
    latitude, longitude = to_lat_lon(bridge_frame(SITE.bridges[0]), front)
    speed = np.abs(np.gradient(front, fixes))
    rng = np.random.default_rng(1)
    names = ("sprung_front", "sprung_rear", "unsprung_front", "unsprung_rear")
    run = Run(
        "made up",
        START_S + accel,
        50.0,
        {name: rng.standard_normal(accel.size) for name in names},
        GnssTrack(START_S + fixes, latitude, longitude, np.full(fixes.size, 5.0), speed, None),
    )
    return [
        message
        for message in run_to_messages([run], SITE, REALM, "truck-1")
        if (time_s := message.log_time_ns * 1e-9 - START_S) >= begin_s
        and not (message.key.stream == "gnss" and without_fixes[0] <= time_s < without_fixes[1])
    ]


def fed(one: WorkingEngine, messages: Iterable[Message]) -> list[Output]:
    return [output for m in messages for output in one.feed(m.key, m.payload)]


def until(time_s: float) -> list[Message]:
    """Return what a truck has sent by then."""
    return [m for m in TWO if m.log_time_ns * 1e-9 - START_S < time_s]


def output_of(outputs: Iterable[Output]) -> EngineOutput:
    return [(output.key, output.payload) for output in outputs]


def resumed(
    sent: EngineOutput,
    messages: Iterable[Message],
    counted: Identifications | None = None,
    header: ResultHeader = HEADER,
) -> list[Output]:
    one = engine(counted, header)
    return [*one.resume(sent), *fed(one, messages), *one.finish()]


def states(outputs: Iterable[Output]) -> list[pb.Crossing]:
    return [pb.Crossing.FromString(o.payload) for o in outputs if o.key.stream == "crossing"]


def bridge_states(outputs: Iterable[Output]) -> list[pb.BridgeState]:
    return [pb.BridgeState.FromString(o.payload) for o in outputs if o.key.stream == "state"]


THERE = ((0.0, -60.0), (20.0, 140.0))
THERE_AND_BACK = (*THERE, (30.0, 140.0), (50.0, -60.0))
TWO = messages_of(*THERE_AND_BACK)
WHOLE = fed(engine(), TWO)


def test_two_crossings_are_twelve_messages() -> None:
    once = ["crossing", "crossing", "crossing", "estimate", "crossing", "state"]
    assert [output.key.stream for output in WHOLE] == once + once


@pytest.mark.parametrize("number", range(len(WHOLE) + 1))
def test_wherever_a_run_is_cut_off_the_next_says_the_rest(number: int) -> None:
    """Byte for byte, and in the same order; only what has no result is identified again."""
    counted = Identifications()
    before = output_of(WHOLE[:number])
    after = resumed(before, TWO, counted)
    assert before + output_of(after) == output_of(WHOLE)
    assert counted.made == sum(output.result is not None for output in WHOLE[number:])


@pytest.mark.parametrize("numbers", [(2, 5), (4, 9), (5, 6), (3, 3)])
def test_a_run_may_be_cut_off_twice(numbers: tuple[int, int]) -> None:
    first, second = numbers
    sent = output_of(WHOLE[:first])
    sent += output_of(resumed(sent, TWO))[: second - first]
    assert sent + output_of(resumed(sent, TWO)) == output_of(WHOLE)


def test_earlier_crossings_count_in_the_next_state() -> None:
    """The truck has gone meanwhile and nothing of the first crossing comes again."""
    after = resumed(output_of(WHOLE[:6]), [m for m in TWO if m.log_time_ns * 1e-9 > START_S + 25.0])
    assert [s.SerializeToString() for s in bridge_states(after)] == [WHOLE[11].payload]
    (state,) = bridge_states(after)
    first = WHOLE[3].result
    assert first is not None
    assert [out.crossing_id for out in state.crossings_left_out] == [first.crossing_id]


def test_results_file_has_the_published_state() -> None:
    """Not before: it may be published long after the result that it is about."""
    one = engine()
    results, used = [], []
    for m in TWO:
        for output in one.feed(m.key, m.payload):
            if output.result is not None:
                results.append((output.result.crossing_id,))
            published = bridge_states([output])
            used += [tuple(state.crossings_used) for state in published]
            now = [state.crossings_used for state in one.bridges().values()]
            assert now == used[-1:]
    assert used == results


def fuses_of(
    run: Engine, sent: Iterable[Output | IdentificationTask | FusionTask | ValidationRequest]
) -> list[FusionTask]:
    """What is to be fused when the works of a run are done; their states are published later."""
    found = []
    for one in sent:
        if isinstance(one, IdentificationTask):
            result = Identifications()(one.data, SETTINGS, stopwatch=lambda: 0.0)
            found += fuses_of(run, run.done(one, result))
        elif isinstance(one, FusionTask):
            found.append(one)
    return found


def state_made_of(fuse: FusionTask) -> BridgeResult:
    state = state_of(fuse.counted, fuse.bridge, fuse.fusing)
    assert state is not None
    return state


def test_a_state_that_was_made_before_a_result_does_not_count_it() -> None:
    """The first is published behind both results: the second one's is owed to the next run."""
    one = Engine(SITE, SETTINGS, HEADER)
    first, second = (f for m in TWO for f in fuses_of(one, one.feed(m.key, m.payload)))
    outputs = [o for o in WHOLE if o.key.stream != "state"]
    outputs += one.fused(first, state_made_of(first))
    assert one.bridges() == {"bridge-1": state_made_of(first)}
    (again,) = resumed(output_of(outputs), [])
    assert again.payload == WHOLE[11].payload
    outputs += one.fused(second, state_made_of(second))
    assert resumed(output_of(outputs), []) == []


def test_next_run_publishes_one_state_of_several_results() -> None:
    outputs = [o for o in WHOLE if o.key.stream != "state"]
    assert [o.payload for o in resumed(output_of(outputs), [])] == [WHOLE[11].payload]


def test_crossings_that_could_not_be_fused_are_a_warning_and_owed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    one = Engine(SITE, SETTINGS, HEADER)
    first, second = (f for m in TWO for f in fuses_of(one, one.feed(m.key, m.payload)))
    assert list(one.fused(first, None)) == []
    assert one.bridges() == {}
    assert "bridge-1: fusing its crossings failed" in caplog.text
    assert [o.payload for o in one.fused(second, state_made_of(second))] == [WHOLE[11].payload]


def test_new_run_has_the_published_states() -> None:
    """Nothing is fused for them once more."""
    published = state_to_bridge(bridge_states(WHOLE)[-1])[2]
    known = known_crossings(output_of(WHOLE), search_hash(HEADER))
    one = Engine(SITE, SETTINGS, HEADER)
    assert (
        list(one.resume(known, {(REALM, "bridge-1"): published, (REALM, "other"): published})) == []
    )
    assert one.bridges() == {"bridge-1": published}


SLOW = ((0.0, -30.0), (40.0, 90.0))
"""On the bridge from 10 to 21.5 s: far longer than two entries of one crossing are apart."""


@pytest.mark.parametrize("begin_s", [10.5, 15.5, 17.0])
def test_a_history_that_begins_on_the_bridge_is_no_second_crossing(begin_s: float) -> None:
    """The truck's cache goes back to the middle of the bridge only."""
    rest = messages_of(*SLOW, begin_s=begin_s)
    assert fed_all_alone(rest)  # there is something to be mistaken
    assert resumed(output_of(fed_all_alone(messages_of(*SLOW))), rest) == []


@pytest.mark.parametrize("published", [1, 3])
def test_published_half_crossing_keeps_its_name(published: int) -> None:
    whole = fed_all_alone(messages_of(*SLOW))
    after = resumed(output_of(whole[:published]), messages_of(*SLOW, begin_s=17.0))
    assert len([o for o in after if o.result]) == 1
    assert {state.crossing_id for state in states(after)} == {states(whole)[0].crossing_id}
    assert [s.state for s in states(whole[:published] + after)] == [1, 2, 4, 5]


def fed_all_alone(messages: list[Message]) -> list[Output]:
    one = engine()
    return [*fed(one, messages), *one.finish()]


@pytest.mark.parametrize("change", ["settings", "site_hash", "seed"])
def test_a_result_of_another_search_does_not_count(change: str) -> None:
    other = {"settings": {"method": "pre"}, "site_hash": "other", "seed": 7}[change]
    header = HEADER._replace(**{change: other})
    after = resumed(output_of(WHOLE), TWO, header=header)
    assert [s.state for s in states(after)] == [s.state for s in states(WHOLE)]
    assert [s.crossing_id for s in states(after)] == [s.crossing_id for s in states(WHOLE)]
    assert [list(s.crossings_used) for s in bridge_states(after)] == [
        list(s.crossings_used) for s in bridge_states(WHOLE)
    ]


@pytest.mark.parametrize("number", [4, 5])
def test_a_run_cut_off_after_one_of_another_search(number: int) -> None:
    """That one published a `done` and a state of the bridge, too: of its own result."""
    other = output_of(fed(engine(header=HEADER._replace(settings={"method": "pre"})), TWO)[:6])
    whole = resumed(other, TWO)
    after = resumed(other + output_of(whole[:number]), TWO)
    assert output_of(after) == output_of(whole[number:])


def test_another_version_of_the_program_does_not_identify_anew() -> None:
    assert resumed(output_of(WHOLE), TWO, header=HEADER._replace(version="99", created=5.0)) == []


def test_another_truck_bridge_or_realm_is_another_crossing() -> None:
    for old, new in (("truck-1", "truck-2"), ("bridge-1", "bridge-2"), (REALM, "live")):
        changed = [
            (Key(*(new if part == old else part for part in key)), payload)
            for key, payload in output_of(WHOLE[:6])
        ]
        if old == "truck-1":  # not in a key of a bridge
            changed = [(key, of_truck(payload, new)) for key, payload in changed if is_state(key)]
            result = WHOLE[3].result
            assert result is not None
            other = result.model_copy(update={"vehicle": new, "crossing_id": "other"})
            estimate = crossing_to_protobuf(other, HEADER).SerializeToString(deterministic=True)
            changed.append((WHOLE[3].key, estimate))
        counted = Identifications()
        resumed(changed, TWO, counted)
        assert counted.made == 2, new


def is_state(key: Key) -> bool:
    return key.stream == "crossing"


def of_truck(payload: bytes, vehicle: str) -> bytes:
    message = pb.Crossing.FromString(payload)
    message.vehicle, message.crossing_id = vehicle, "other"
    return message.SerializeToString(deterministic=True)


def test_what_is_malformed_is_left_out() -> None:
    broken = [
        (Key(REALM, "bridge", "bridge-1", stream), payload)
        for stream in ("crossing", "estimate", "state")
        for payload in (b"\xff\xff", b"\x08\x09", b"")
    ]
    sent = output_of(WHOLE[:6])
    assert resumed([*broken, *sent, *broken], TWO) == WHOLE[6:]


def without(messages: list[Message], stream: str, begin_s: float, stop_s: float) -> list[Message]:
    return [m for m in messages if m not in between(messages, stream, begin_s, stop_s)]


def between(messages: list[Message], stream: str, begin_s: float, stop_s: float) -> list[Message]:
    return [
        m
        for m in messages
        if m.key.stream == stream and begin_s <= m.log_time_ns * 1e-9 - START_S < stop_s
    ]


@pytest.mark.parametrize(
    ("stream", "begin_s", "stop_s"),
    [("accel", 7.0, 7.2), ("accel", 5.2, 5.4), ("accel", 9.0, 99.0), ("gnss", 5.0, 8.0)],
)
def test_reconnected_truck_may_deliver_missing_messages(
    stream: str, begin_s: float, stop_s: float
) -> None:
    """Half a second behind the bridge the truck's token goes, and what is under way is lost."""
    there = [m for m in messages_of(*THERE) if m.log_time_ns * 1e-9 < START_S + 10.0]
    one = engine()
    assert states(fed(one, without(there, stream, begin_s, stop_s)))[1:] == []
    assert list(one.gone(REALM, "truck-1")) == []
    assert one.has_undecided(REALM, "truck-1")
    again = fed(one, between(there, stream, begin_s, stop_s))
    (result,) = [o.result for o in [*again, *one.gone(REALM, "truck-1")] if o.result]
    assert result.verdict == "good"
    assert not one.has_undecided(REALM, "truck-1")


def test_what_never_comes_is_given_up_when_the_truck_is_gone_for_good() -> None:
    there = [m for m in messages_of(*THERE) if m.log_time_ns * 1e-9 < START_S + 10.0]
    one = engine()
    fed(one, without(there, "accel", 7.0, 7.2))
    assert list(one.gone(REALM, "truck-1")) == []
    outputs = list(one.gone(REALM, "truck-1", for_good=True))
    assert [o.result.reasons for o in outputs if o.result] == [("gap_on_bridge",)]
    late = fed(one, between(there, "accel", 7.0, 7.2))
    assert [*late, *one.gone(REALM, "truck-1", for_good=True)] == []


def test_fixes_that_come_after_the_decision_make_no_second_crossing() -> None:
    """The receiver's fixes are missing while the truck halts before the bridge and crosses it:
    the entry is thought to be 8 s before it was."""
    legs = ((0.0, -60.0), (5.0, -10.0), (21.0, -10.0), (27.0, 50.0), (60.0, 380.0))
    messages = messages_of(*legs)
    one = engine()
    first = fed(one, without(messages, "gnss", 5.0, 27.0))
    first += one.gone(REALM, "truck-1", for_good=True)
    second = fed(one, between(messages, "gnss", 5.0, 27.0))
    second += [*one.gone(REALM, "truck-1", for_good=True), *one.finish()]
    published = [o.result for o in first + second if o.result]
    assert len(published) == 1
    (whole,) = [o.result for o in fed_all_alone(messages) if o.result]
    assert whole.entry_time - published[0].entry_time > 5.0  # or it would prove nothing


@pytest.mark.parametrize("ends", ["drives on", "gone", "finish"])
def test_a_history_that_comes_after_what_is_live_is_looked_at(ends: str) -> None:
    """Half a minute behind, when its fixes had long counted as lost: it reveals a crossing."""
    long = messages_of(*THERE, (60.0, 540.0))
    stop_s = 60.0 if ends == "drives on" else 40.0
    live = [m for m in long if 12.0 <= m.log_time_ns * 1e-9 - START_S < stop_s]
    history = [m for m in long if m.log_time_ns * 1e-9 - START_S < 12.0]
    middle = round(0.6 * len(live))
    one = engine()
    outputs = fed(one, [*live[:middle], *history, *live[middle:]])
    if ends == "gone":
        outputs += one.gone(REALM, "truck-1", for_good=True)
    if ends == "finish":
        outputs += one.finish()
    (result,) = [o.result for o in outputs if o.result]
    assert result.verdict == "good"
    assert result.crossing_id == next(o.result for o in WHOLE if o.result).crossing_id


@pytest.mark.parametrize("number", [0, 5])
def test_one_batch_from_far_ahead_costs_no_crossing(
    number: int, caplog: pytest.LogCaptureFixture
) -> None:
    """It lies well before the bridge; what comes after it is taken in as ever."""
    messages = messages_of(*THERE)
    bad = [m for m in messages if m.key.stream == "accel"][number]
    ahead = decode_accel(bad.payload)._replace(device_time_ns=2**62)
    changed = [m._replace(payload=encode_accel(ahead)) if m is bad else m for m in messages]
    (result,) = [o.result for o in fed_all_alone(changed) if o.result]
    assert result.verdict == "good"
    assert ("truck-1: device time jumped ahead" in caplog.text) == (number > 0)


def test_pause_of_both_clocks_is_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    """As between two runs of a recording that are published with --skip-gaps."""
    caplog.set_level(logging.INFO)
    messages = messages_of(*THERE, (600.0, 640.0))
    first, rest = messages[:50], [m for m in messages if m.log_time_ns * 1e-9 - START_S > 500.0]
    fed_all_alone([*first, *rest])
    (line,) = [one for one in caplog.records if "measured nothing for" in one.getMessage()]
    assert line.levelno == logging.INFO
    assert "jumped ahead" not in caplog.text
