"""A worker's thousandth crossing costs what its first did: bytes on the disk and on the bus, and
what is kept in memory. Nothing is identified."""

import os
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult, ResultHeader, load_results, results, results_json
from schemas.results_on_the_wire import crossing_to_protobuf, state_to_bridge
from schemas.topics import Key, Message
from services.common.errors import FailureError
from services.execution.inline import InlineExecutor
from services.finding import truck as truck_memory
from services.identification.bridge_state import (
    LISTED_AT_MOST,
    RecentCrossings,
    add_crossings,
    state_of,
    usable,
)
from services.identification.known import search_hash
from services.identification.outputs import state_output
from services.ledger.crossing_log import CrossingLog
from services.ledger.growing_json import AppendableResults
from services.ledger.runs import ResultFiles
from services.simulation.drive import paper_site
from tests.identifications import Identifications
from tests.unit.identification.test_engine_resume import HEADER as ENGINE_HEADER
from tests.unit.identification.test_engine_resume import (
    SETTINGS,
    fed,
    messages_of,
)
from tests.working_engine import WorkingEngine

HEADER = ResultHeader("0.1", 1_800_000_000.0, "abc", {"method": "pre", "threads": 2}, 1)
MAX_ON_BUS = 1 << 20


def result(number: int) -> CrossingResult:
    values = {"mean": 1.5e10, "std": 1e8, "q025": 1.3e10, "q50": 1.5e10, "q975": 1.7e10}
    x_m = tuple(0.05 * n for n in range(601))
    profile = tuple(1e-3 * n for n in range(601))
    return CrossingResult.model_validate(
        {
            "crossing_id": f"truck-1.bridge-1.{number:06d}",
            "realm": "live",
            "vehicle": "truck-1",
            "bridge": "bridge-1",
            "direction": "start_to_end",
            "entry_time": 1.8e9 + 100.0 * number,
            "exit_time": 1.8e9 + 100.0 * number + 3.0,
            "speed_m_per_s": 10.0,
            "method": "pre",
            "verdict": "suspect",
            "reasons": ("no_noise_model",),
            "reason_texts": ('with "quotes",\na line break, and\u2028Unicode\'s own: µ',),
            "parameters": {f"EI_{n}": {"unit": "N·m²"} | values for n in range(1, 11)},
            "road": {"x_m": x_m, "front_m": profile, "rear_m": profile, "mean_m": profile},
        }
    )


class Bytes:
    """Counts what is written to files of this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.written = 0
        pwrite, write_bytes = os.pwrite, Path.write_bytes

        def counted_pwrite(descriptor: int, data: bytes, offset: int) -> int:
            self.written += len(data)
            return pwrite(descriptor, data, offset)

        def counted_write(path: Path, data: bytes) -> int:
            self.written += len(data)
            return write_bytes(path, data)

        monkeypatch.setattr(os, "pwrite", counted_pwrite)
        monkeypatch.setattr(Path, "write_bytes", counted_write)


def counted_bridges() -> Iterator[RecentCrossings]:
    counted = RecentCrossings()
    number = 0
    while True:
        one = usable(result(number))
        assert one is not None
        counted = add_crossings(counted, [one])
        yield counted
        number += 1


def test_a_crossing_costs_its_own_bytes_on_the_disk_however_many_were_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: None)
    bytes_of = Bytes(monkeypatch)
    file = AppendableResults(tmp_path / "results.json", HEADER)
    costs = []
    # The crossings left out are listed up to a number: from there on nothing grows.
    for number, counted in zip(range(1000), counted_bridges(), strict=False):
        state = state_of(counted, "bridge-1")
        assert state is not None
        before = bytes_of.written
        file.add(result(number), {"bridge-1": state})
        costs.append(bytes_of.written - before)
    assert costs[999] == pytest.approx(costs[LISTED_AT_MOST], rel=0.001)
    assert costs[999] < 1.5 * costs[0]


@pytest.mark.parametrize("number", [1, 2, 5])
def test_the_file_is_as_if_it_had_been_written_at_once(tmp_path: Path, number: int) -> None:
    """After every crossing, byte for byte; here the bridges become fewer in the end, too."""
    path = tmp_path / "results.json"
    file = AppendableResults(path, HEADER)
    crossings = []
    for n, counted in zip(range(number), counted_bridges(), strict=False):
        state = state_of(counted, "bridge-1")
        assert state is not None
        bridges = {"bridge-1": state, "bridge-2": state} if n % 2 == 0 else {}
        crossings.append(result(n))
        file.add(crossings[-1], bridges)
        assert path.read_text() == results_json(results(HEADER, crossings, bridges))
    assert load_results(path).crossings == tuple(crossings)


def test_later_states_replace_the_final_one(tmp_path: Path) -> None:
    """Longer or shorter, and crossings go on behind the one before."""
    path = tmp_path / "results.json"
    file = AppendableResults(path, HEADER)
    state = state_of(next(counted_bridges()), "bridge-1")
    assert state is not None
    file.replace_bridges({"bridge-1": state})
    assert not path.exists()  # without a crossing there is nothing to publish
    crossings = [result(n) for n in range(2)]
    file.add(crossings[0], {})
    for bridges in ({"bridge-1": state, "bridge-2": state}, {}, {"bridge-1": state}):
        file.replace_bridges(bridges)
        assert path.read_text() == results_json(results(HEADER, crossings[:1], bridges))
    file.add(crossings[1], bridges)
    assert path.read_text() == results_json(results(HEADER, crossings, bridges))


def test_file_changed_by_hand_receives_no_states(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    file = AppendableResults(path, HEADER)
    file.add(result(0), {})
    path.write_text("{}")
    file.replace_bridges({})
    assert path.read_text() == "{}"


def test_an_end_that_is_much_shorter_leaves_nothing_behind(tmp_path: Path) -> None:
    """More goes with the bridges than comes with the crossing."""
    path = tmp_path / "results.json"
    file = AppendableResults(path, HEADER)
    state = state_of(next(counted_bridges()), "bridge-1")
    assert state is not None
    short = [result(n).model_copy(update={"road": None}) for n in range(2)]
    file.add(short[0], {f"bridge-{n}": state for n in range(100)})
    file.add(short[1], {})
    assert path.read_text() == results_json(results(HEADER, short, {}))


def test_a_file_that_somebody_took_away_or_changed_is_not_written_into(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    file = AppendableResults(path, HEADER)
    file.add(result(0), {})
    path.rename(tmp_path / "taken.json")
    file.add(result(1), {})
    assert [c.crossing_id for c in load_results(path).crossings] == [result(1).crossing_id]
    path.write_text("{}")
    file.add(result(2), {})
    assert [c.crossing_id for c in load_results(path).crossings] == [result(2).crossing_id]


def test_the_messages_of_a_run_are_written_once(tmp_path: Path) -> None:
    """And nothing is kept of them: what the files object holds does not grow."""
    files = ResultFiles(tmp_path / "results.mcap", "", HEADER, None)
    where = Key("live", "bridge", "bridge-1", "estimate")
    sizes = []
    for number in range(60):
        message = Message(where, b"x" * 100, 1, number, number, number)
        files.write(message, result(number), {})
        kept = {k: v for k, v in vars(files).items() if k not in ("_writer", "_json")}
        sizes.append(len(pickle.dumps((kept, vars(files._json)))))
    assert max(sizes[1:]) - min(sizes[1:]) < 10  # a number with one digit more
    files.finish()


def test_a_state_stays_small_after_20_000_crossings() -> None:
    for number, counted in zip(range(20_000), cheap_counted(), strict=False):
        if number in (LISTED_AT_MOST + 1, 19_999):
            state = state_of(counted, "bridge-1")
            assert state is not None
            output = state_output("live", "bridge-1", 1.8e9, state)
            message = pb.BridgeState.FromString(output.payload)
            assert len(output.payload) < 0.01 * MAX_ON_BUS
            assert len(message.crossings_left_out) == LISTED_AT_MOST
            assert message.crossings_left_out_count == number
            assert state_to_bridge(message)[2] == state
            assert len(counted.newest) == LISTED_AT_MOST + 1


def cheap_counted() -> Iterator[RecentCrossings]:
    one = usable(result(0))
    assert one is not None
    counted = RecentCrossings()
    for number in range(20_000):
        another = one._replace(entry_time=1.8e9 + number, crossing_id=f"truck-1.bridge-1.{number}")
        counted = add_crossings(counted, [another])
        yield counted


def test_latest_entry_is_latest_whatever_the_arrival() -> None:
    ones = [usable(result(n)) for n in (3, 1, 2, 0)]
    counted = add_crossings(RecentCrossings(), [one for one in ones if one is not None])
    state = state_of(counted, "bridge-1")
    assert state is not None
    assert state.crossings_used == (result(3).crossing_id,)
    assert [o.crossing_id for o in state.crossings_left_out] == [
        result(n).crossing_id for n in range(3)
    ]


def test_a_state_of_before_lists_all_that_it_counts() -> None:
    left_out = [pb.LeftOut(crossing_id="b", reason="not_fused")]
    old = pb.BridgeState(schema_version=1, bridge="b", crossings_left_out=left_out)
    assert state_to_bridge(old)[2].crossings_left_out_count == 1


def test_what_the_store_keeps_of_a_result_is_small() -> None:
    """Two days of results are read at every start: not their roads and covariances."""
    log = CrossingLog(search_hash(HEADER))
    key = Key("live", "bridge", "bridge-1", "estimate")
    payload = crossing_to_protobuf(result(0), HEADER).SerializeToString()
    log.add(key, payload)
    (known,) = log.crossings()
    assert known.has_result
    assert len(pickle.dumps(known)) < 0.2 * len(payload)


def back_and_forth(crossings: int) -> list[tuple[float, float]]:
    """Legs of a drive that goes over the bridge and back again, once in 8 s."""
    return [(8.0 * n, -20.0 if n % 2 == 0 else 50.0) for n in range(crossings + 1)]


def test_what_the_engine_keeps_does_not_grow_with_the_drive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One truck in one boot, which forgets what is older than a minute here."""
    monkeypatch.setattr(truck_memory, "_KEEP_S", 60.0)
    counted = Identifications()
    messages = messages_of(*back_and_forth(24))
    one = WorkingEngine(paper_site(), SETTINGS, ENGINE_HEADER, InlineExecutor(identify=counted))
    third = len(messages) // 3
    kept = []
    for part in (messages[:third], messages[third : 2 * third], messages[2 * third :]):
        fed(one, part)
        (truck,) = one.inner._finder._trucks.values()
        (bridge,) = one.inner._states._of_bridge.values()
        sizes = truck.detected, truck.done, truck.decided, bridge.running, bridge.results
        kept.append([len(size) for size in sizes])
    assert counted.made >= 22
    assert max(kept[2]) < 15
    assert kept[2] == pytest.approx(kept[1], abs=2)


def test_a_json_file_that_cannot_grow_is_a_failure_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    files = ResultFiles(tmp_path / "results.mcap", "", HEADER, None)
    where = Key("live", "bridge", "bridge-1", "estimate")
    files.write(Message(where, b"x", 1, 0, 0, 0), result(0), {})
    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(FailureError, match="No space left on device"):
        files.write(Message(where, b"x", 1, 1, 0, 0), result(1), {})
    files.abandon()
