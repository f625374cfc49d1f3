"""Whether a recording may be deleted: the worker and the logger find the same crossings in it."""

from pathlib import Path

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.results import ResultHeader
from schemas.settings import IdentificationSettings
from schemas.site import Receiver, Site
from schemas.site_file import site_hash, site_toml
from schemas.topics import Message
from services.execution.inline import InlineExecutor
from services.identification.known import search_hash
from services.ledger.processed import is_processed
from services.recordings.writer import write_recording
from services.simulation.drive import paper_site
from tests.builders.ledger import known_crossings
from tests.identifications import Identifications
from tests.unit.identification.test_engine_resume import messages_of
from tests.working_engine import WorkingEngine

REALM = "sim-test"
START_S = 1_767_225_600.0
SITE = paper_site()
SETTINGS = IdentificationSettings(method="least_squares")


def site(position_noise_m: float) -> Site:
    receiver = Receiver(position_noise_m=position_noise_m)
    return SITE.model_copy(update={"receiver": receiver})


def published_by_worker(messages: list[Message], known: Site) -> list[Message]:
    """Messages of a worker with this site file, as they are recorded."""
    header = ResultHeader(
        "0", 0.0, site_hash(known), SETTINGS.model_dump(mode="json"), SETTINGS.seed
    )
    worker = WorkingEngine(known, SETTINGS, header, InlineExecutor(identify=Identifications()))
    outputs = [o for m in messages for o in worker.feed(m.key, m.payload)]
    outputs += worker.finish()
    time_ns = messages[-1].log_time_ns
    return [Message(o.key, o.payload, 1, n, time_ns, time_ns) for n, o in enumerate(outputs)]


def recorded(path: Path, messages: list[Message], known: Site | None = None) -> Path:
    text = None if known is None else site_toml(known)
    write_recording(path, messages, site_toml=text, reason="test")
    return path


TURNED = ((0.0, -40.0), (8.0, 0.0), (9.0, 4.0), (10.0, 0.0), (18.0, -40.0))
"""Four metres onto the bridge and back: a stay for a receiver with a noise of 0.4 m, and none for
one with 1 m, whose positions may jump so far."""
THROUGH = ((0.0, -40.0), (18.0, 90.0), (30.0, 200.0))


@pytest.mark.parametrize(("noise_m", "stays"), [(0.4, 1), (1.0, 0)])
def test_what_is_no_stay_for_the_worker_is_none_for_the_logger(
    tmp_path: Path, noise_m: float, stays: int
) -> None:
    messages = messages_of(*TURNED)
    published = published_by_worker(messages, site(noise_m))
    assert len([m for m in published if m.key.stream == "estimate"]) == stays
    path = recorded(tmp_path / "drive.mcap", messages, site(noise_m))
    results = [recorded(tmp_path / "results.mcap", published)] if published else []
    assert is_processed(path, results)
    assert is_processed(path, []) == (stays == 0)


@pytest.mark.parametrize("kept", ["estimate", "crossing"])
def test_a_result_or_the_word_that_there_is_one_is_enough(tmp_path: Path, kept: str) -> None:
    messages = messages_of(*THROUGH)
    published = [m for m in published_by_worker(messages, SITE) if m.key.stream == kept]
    path = recorded(tmp_path / "drive.mcap", messages, SITE)
    assert is_processed(path, [recorded(tmp_path / "results.mcap", published)])


def test_the_word_that_it_is_being_identified_is_not_enough(tmp_path: Path) -> None:
    messages = messages_of(*THROUGH)
    states = [m for m in published_by_worker(messages, SITE) if m.key.stream == "crossing"]
    path = recorded(tmp_path / "drive.mcap", messages, SITE)
    assert not is_processed(path, [recorded(tmp_path / "begun.mcap", states[:-1])])


@pytest.mark.parametrize("cut_s", [7.0, 8.5])
def test_a_crossing_that_is_cut_by_the_next_file_is_known_in_both(
    tmp_path: Path, cut_s: float
) -> None:
    """The truck is on the bridge from 5.5 to 10.3 s."""
    messages = messages_of(*THROUGH)
    results = recorded(tmp_path / "results.mcap", published_by_worker(messages, SITE))
    first = [m for m in messages if m.log_time_ns * 1e-9 - START_S < cut_s]
    second = [m for m in messages if m.log_time_ns * 1e-9 - START_S >= cut_s]
    for name, part in (("first.mcap", first), ("second.mcap", second)):
        path = recorded(tmp_path / name, part, SITE)
        assert is_processed(path, [results])
        assert not is_processed(path, [])


def test_a_truck_that_stays_on_the_bridge_is_known_by_its_entry(tmp_path: Path) -> None:
    """No exit was published."""
    messages = messages_of((0.0, -40.0), (8.0, 15.0), (30.0, 15.0))
    published = published_by_worker(messages, SITE)
    done = [pb.Crossing.FromString(m.payload) for m in published if m.key.stream == "crossing"][-1]
    assert (done.state, done.exit_time_ns) == (pb.DONE, 0)
    path = recorded(tmp_path / "drive.mcap", messages, SITE)
    states = [m for m in published if m.key.stream == "crossing"]
    assert is_processed(path, [recorded(tmp_path / "results.mcap", states)])


def header(**changes: object) -> ResultHeader:
    settings = SETTINGS.model_dump(mode="json") | changes
    return ResultHeader("0", 0.0, site_hash(SITE), settings, SETTINGS.seed)


def test_one_and_two_threads_are_one_search() -> None:
    assert search_hash(header(threads=1)) == search_hash(header(threads=2))
    assert search_hash(header(method_edition=1)) == search_hash(header())
    assert search_hash(header(starts=1)) != search_hash(header(starts=2))
    messages = messages_of(*THROUGH)
    published = published_by_worker(messages, SITE)
    output = [(m.key, m.payload) for m in published]
    for threads in (1, 2, 7):
        (known,) = known_crossings(output, search_hash(header(threads=threads)))
        assert known.is_identified
    (other,) = known_crossings(output, search_hash(header(starts=7)))
    assert not other.is_identified
