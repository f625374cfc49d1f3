"""The deciding part of the worker: what it says of crossings, whatever way the messages come."""

import contextlib
from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult, ResultHeader
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS, VehicleInfo, decode_accel, encode_accel, encode_info
from schemas.site import Site
from schemas.site_file import site_hash, vehicle_toml
from schemas.topics import Key, Message
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, to_lat_lon
from services.drives.runs import GnssTrack, Run, run_to_messages
from services.finding import traffic
from services.identification.outputs import Output
from services.simulation.drive import SimulatedDrive, paper_site
from tests.working_engine import WorkingEngine

START_S = 1_767_225_600.0
SITE = paper_site()


REAL = IdentificationSettings(method="least_squares")
"""The simulated drive has no noise: what was put in must come out exactly."""
HASTY = IdentificationSettings(method="random_walk", particles=4, steps=1)
"""For drives whose accelerations mean nothing: others would look for long."""


def engine(site: Site = SITE, chosen: IdentificationSettings = HASTY) -> WorkingEngine:
    header = ResultHeader("0", 0.0, site_hash(site), chosen.model_dump(mode="json"), chosen.seed)
    return WorkingEngine(site, chosen, header)


def drive(
    front_m: Callable[[Floats], Floats],
    stop_s: float,
    *,
    site: Site = SITE,
    lateral_m: float = 0.0,
    rate_hz: float = 200.0,
    accel_kept: Callable[[Floats], NDArray[np.bool_]] = lambda t: np.ones(t.shape, bool),
    gnss_kept: Callable[[Floats], NDArray[np.bool_]] = lambda t: np.ones(t.shape, bool),
    channels: tuple[str, ...] = CHANNELS,
) -> Run:
    """A drive whose accelerations mean nothing: for verdicts that need no fit."""
    accel = np.arange(round(stop_s * rate_hz) + 1) / rate_hz
    fixes = np.arange(round(stop_s * 10.0) + 1) / 10.0
    speed = np.abs(np.gradient(front_m(fixes), fixes))
    accel, speed, fixes = accel[accel_kept(accel)], speed[gnss_kept(fixes)], fixes[gnss_kept(fixes)]
    latitude, longitude = to_lat_lon(bridge_frame(site.bridges[0]), front_m(fixes), lateral_m)
    rng = np.random.default_rng(3)
    return Run(
        "made up",
        START_S + accel,
        rate_hz,
        {name: rng.standard_normal(accel.size) for name in channels},
        GnssTrack(START_S + fixes, latitude, longitude, np.full(fixes.size, 5.0), speed, None),
    )


def legs(*points: tuple[float, float]) -> Callable[[Floats], Floats]:
    times, places = np.array(points).T
    return lambda t: np.asarray(np.interp(t, times, places))


def messages_of(*runs: Run, site: Site = SITE, vehicle: str = "truck-1") -> list[Message]:
    return list(run_to_messages(runs, site, "sim-test", vehicle))


def fed(
    messages: Iterable[Message], site: Site = SITE, chosen: IdentificationSettings = HASTY
) -> list[Output]:
    one = engine(site, chosen)
    outputs = []
    for message in messages:
        one.expect(message.key, message.payload)
        outputs += one.feed(message.key, message.payload)
    return [*outputs, *one.finish()]


def results_in(outputs: list[Output]) -> list[CrossingResult]:
    return [output.result for output in outputs if output.result is not None]


def states_in(outputs: list[Output]) -> list[pb.Crossing]:
    return [pb.Crossing.FromString(o.payload) for o in outputs if o.key.stream == "crossing"]


def rejected(run: Run, site: Site = SITE) -> CrossingResult:
    """The one crossing of a run, which must be rejected, without a number."""
    outputs = fed(messages_of(run, site=site), site)
    (crossing,) = results_in(outputs)
    assert crossing.verdict == "rejected"
    assert crossing.parameters is None
    assert [state.state for state in states_in(outputs)] == [
        pb.DETECTED,
        pb.COMPLETE,
        pb.IDENTIFYING,
        pb.DONE,
    ]
    assert not [o for o in outputs if o.key.stream == "state"]
    return crossing


@pytest.fixture(scope="module")
def crossing_messages(scenario_6: SimulatedDrive) -> list[Message]:
    return messages_of(scenario_6.run)


@pytest.fixture(scope="module")
def outputs(crossing_messages: list[Message]) -> list[Output]:
    return fed(crossing_messages, chosen=REAL)


@pytest.fixture(scope="module")
def hasty_outputs(crossing_messages: list[Message]) -> list[Output]:
    """As sensitive to every sample and fix as the real ones, and quicker."""
    return fed(crossing_messages)


def test_one_crossing_is_found_and_published_in_order(outputs: list[Output]) -> None:
    assert [output.key.stream for output in outputs] == [
        "crossing",
        "crossing",
        "crossing",
        "estimate",
        "crossing",
        "state",
    ]
    assert {output.key[:3] for output in outputs} == {("sim-test", "bridge", "bridge-1")}
    states = states_in(outputs)
    assert [state.state for state in states] == [
        pb.DETECTED,
        pb.COMPLETE,
        pb.IDENTIFYING,
        pb.DONE,
    ]
    assert len({state.crossing_id for state in states}) == 1
    entry_ns, exit_ns = ((START_S + t) * 1e9 for t in (3.0, 6.44))
    assert [state.entry_time_ns for state in states] == pytest.approx([entry_ns] * 4, abs=1e6)
    assert states[0].exit_time_ns == 0
    assert [state.exit_time_ns for state in states[1:]] == pytest.approx([exit_ns] * 3, abs=1e6)
    assert states[0].time_ns == pytest.approx(entry_ns, abs=1e6)
    assert states[-1].time_ns == pytest.approx(exit_ns, abs=1e6)
    assert states[0].direction == pb.START_TO_END


def test_the_estimate_is_the_result(outputs: list[Output]) -> None:
    (crossing,) = results_in(outputs)
    estimate = pb.Estimate.FromString(outputs[3].payload)
    assert crossing.parameters is not None
    assert crossing.crossing_id == "truck-1.bridge-1.20260101T000003.000Z"
    assert estimate.crossing_id == crossing.crossing_id
    assert pb.Verdict.Name(estimate.verdict) == "SUSPECT"
    assert crossing.entry_time == pytest.approx(START_S + 3.0, abs=1e-3)
    assert crossing.exit_time == pytest.approx(START_S + 6.44, abs=1e-3)
    assert crossing.speed_m_per_s == pytest.approx(10.0, rel=1e-6)
    assert estimate.parameters["EI_4"].mean == crossing.parameters["EI_4"].mean
    state = pb.BridgeState.FromString(outputs[5].payload)
    assert list(state.crossings_used) == [crossing.crossing_id]


def test_found_as_soon_as_its_data_are_there(crossing_messages: list[Message]) -> None:
    """One second after the exit, not at the end of the recording."""
    one = engine(chosen=REAL)
    sent = [
        message.log_time_ns * 1e-9 - START_S
        for message in crossing_messages
        for output in one.feed(message.key, message.payload)
        if output.key.stream == "estimate"
    ]
    assert sent == [pytest.approx(6.44 + 1.05, abs=0.11)]
    assert list(one.finish()) == []


def test_two_runs_give_the_same_bytes(
    crossing_messages: list[Message], outputs: list[Output]
) -> None:
    again = fed(crossing_messages, chosen=REAL)
    assert [(o.key, o.payload) for o in again] == [(o.key, o.payload) for o in outputs]


def shuffled(messages: list[Message], seed: int, share: float, most_s: float) -> list[Message]:
    """Some come late, some twice, some both; streams drift apart by up to a second."""
    rng = np.random.default_rng(seed)
    lag = {stream: rng.uniform(0.0, 1.0) for stream in ("accel", "gnss", "location", "info")}
    arrivals = []
    for message in messages:
        time_s = message.log_time_ns * 1e-9 - START_S + lag[message.key.stream]
        late_s = rng.uniform(0.0, most_s) * (rng.random() < share)
        arrivals.append((time_s + late_s, message))
        if rng.random() < share:
            arrivals.append((time_s + rng.uniform(0.0, most_s), message))
    return [message for _, message in sorted(arrivals, key=lambda item: item[0])]


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    share=st.sampled_from([0.0, 0.05, 0.5]),
    most_s=st.sampled_from([0.3, 4.0]),
)
def test_late_and_double_messages_change_nothing(
    crossing_messages: list[Message],
    hasty_outputs: list[Output],
    seed: int,
    share: float,
    most_s: float,
) -> None:
    found = fed(shuffled(crossing_messages, seed, share, most_s))
    assert [(o.key, o.payload) for o in found] == [(o.key, o.payload) for o in hasty_outputs]


@pytest.mark.parametrize("first", ["accel", "gnss"])
def test_stream_after_stream_gives_the_same(
    crossing_messages: list[Message], hasty_outputs: list[Output], first: str
) -> None:
    ordered = sorted(crossing_messages, key=lambda message: message.key.stream != first)
    found = fed(ordered)
    assert [(o.key, o.payload) for o in found] == [(o.key, o.payload) for o in hasty_outputs]


def test_what_is_fetched_after_an_outage_is_waited_for() -> None:
    """All positions of half a minute come first, then the accelerations: nothing is missing."""
    run = drive(lambda t: 10.0 * t - 50.0, 40.0, accel_kept=lambda t: t < 12.0)
    one = engine()
    gnss = [m for m in messages_of(run) if m.key.stream == "gnss"]
    accel = [m for m in messages_of(run) if m.key.stream == "accel"]
    sent = [o for m in gnss[:400] + accel for o in one.feed(m.key, m.payload)]
    assert [state.state for state in states_in(sent)] == [pb.DETECTED]
    sent += list(one.feed(gnss[400].key, gnss[400].payload))
    (crossing,) = results_in(sent)
    assert "gap_on_bridge" not in crossing.reasons
    assert "channel_missing" not in crossing.reasons


def test_a_lost_batch_is_waited_for_and_then_given_up() -> None:
    run = drive(lambda t: 10.0 * t - 50.0, 60.0)
    lost = 130  # at 6.5 s, on the bridge
    one = engine()
    times = []
    for message in messages_of(run):
        if message.key.stream == "accel" and message.sequence == lost:
            continue
        for output in one.feed(message.key, message.payload):
            if output.result is not None:
                times.append(message.log_time_ns * 1e-9 - START_S)
                assert output.result.reasons == ("gap_on_bridge",)
    assert times == [pytest.approx(8.44 + 1.0 + 10.0, abs=0.2)]


def test_truck_without_accelerations_is_reported_at_the_end() -> None:
    run = drive(lambda t: 10.0 * t - 50.0, 200.0)
    one = engine()
    found = []
    for message in messages_of(run):
        if message.key.stream == "gnss":
            found += results_in(list(one.feed(message.key, message.payload)))
    assert [crossing.reasons for crossing in found] == [("channel_missing",)]


@pytest.mark.parametrize("stream", ["accel", "gnss"])
def test_a_malformed_message_is_a_value_error_and_nothing_else(
    stream: str, crossing_messages: list[Message], hasty_outputs: list[Output]
) -> None:
    one = engine()
    key = Key("sim-test", "vehicle", "truck-1", stream)
    bad = [b"", b"\xff\xff\xff", b"\x08\x02", b"\x00" * 100, bytes(range(256))]
    found: list[Output] = []
    for n, message in enumerate(crossing_messages):
        if n % 60 == 50 and bad:
            with pytest.raises(ValueError, match=r".+"):
                list(one.feed(key, bad.pop()))
        found += one.feed(message.key, message.payload)
    assert bad == []
    found += one.finish()
    assert [o.payload for o in found] == [o.payload for o in hasty_outputs]


@settings(max_examples=200, deadline=None)
@given(payload=st.binary(max_size=60), stream=st.sampled_from(["accel", "gnss", "info", "alive"]))
def test_no_bytes_do_more_than_raise_a_value_error(payload: bytes, stream: str) -> None:
    one = engine()
    with contextlib.suppress(ValueError):
        list(one.feed(Key("live", "vehicle", "truck-1", stream), payload))
    assert list(one.finish()) == []


@pytest.mark.parametrize("absent", CHANNELS)
def test_a_channel_is_missing(absent: str) -> None:
    channels = tuple(name for name in CHANNELS if name != absent)
    crossing = rejected(drive(lambda t: 10.0 * t - 50.0, 15.0, channels=channels))
    assert crossing.reasons == ("channel_missing",)
    assert crossing.speed_m_per_s == pytest.approx(10.0, rel=1e-3)


@pytest.mark.parametrize(("begin_s", "stop_s"), [(6.0, 6.4), (4.9, 5.1), (8.3, 8.6), (5.0, 8.44)])
def test_a_gap_on_the_bridge(begin_s: float, stop_s: float) -> None:
    run = drive(lambda t: 10.0 * t - 50.0, 15.0, accel_kept=lambda t: (t < begin_s) | (t > stop_s))
    assert rejected(run).reasons == ("gap_on_bridge",)


def test_samples_that_are_missing_all_over_the_bridge_are_a_gap() -> None:
    """The truck has its channels: it is not that one is missing."""
    run = drive(lambda t: 10.0 * t - 100.0, 40.0, accel_kept=lambda t: (t < 6.0) | (t > 20.0))
    assert rejected(run).reasons == ("gap_on_bridge",)


@pytest.mark.parametrize(("begin_s", "stop_s"), [(4.5, 4.85), (8.7, 9.0)])
def test_a_gap_beside_the_bridge_does_no_harm(
    scenario_6: SimulatedDrive, begin_s: float, stop_s: float
) -> None:
    """The crossing is from 3 to 6.44 s: 2 s earlier, gaps lie in front of it and behind it."""
    run = scenario_6.run
    time = run.accel_time_s - START_S + 2.0
    kept = (time < begin_s) | (time > stop_s)
    cut = run._replace(
        accel_time_s=run.accel_time_s[kept],
        channels={name: values[kept] for name, values in run.channels.items()},
    )
    (crossing,) = results_in(fed(messages_of(cut), chosen=REAL))
    assert crossing.reasons == ("no_noise_model",)
    assert crossing.parameters is not None
    assert crossing.parameters["EI_4"].mean == pytest.approx(0.4 * 1.56e10, rel=0.01)


@pytest.mark.parametrize("seconds", [2.0, 5.0])
def test_a_receiver_that_is_out_on_the_bridge(seconds: float) -> None:
    middle = 6.7
    run = drive(
        lambda t: 10.0 * t - 50.0, 18.0, gnss_kept=lambda t: np.abs(t - middle) > seconds / 2
    )
    assert rejected(run).reasons == ("position_outage",)


def test_too_slow() -> None:
    crossing = rejected(drive(lambda t: 2.0 * t - 20.0, 40.0))
    assert crossing.reasons == ("speed_too_low",)
    assert crossing.speed_m_per_s == pytest.approx(2.0, rel=0.01)


def test_a_stop_on_the_bridge() -> None:
    run = drive(legs((0, -60), (8, 20), (14, 20), (22, 100)), 22.0)
    assert rejected(run).reasons == ("stopped_on_bridge",)


def test_turning_back_on_the_bridge() -> None:
    run = drive(legs((0, -60), (8, 20), (10, 20), (20, -80)), 20.0)
    crossing = rejected(run)
    assert crossing.reasons == ("stopped_on_bridge",)
    assert crossing.direction == "start_to_end"


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("begins", [True, False])
def test_half_a_crossing_is_published_at_the_recordings_end(
    *, direction: int, begins: bool
) -> None:
    shift = 0.0 if begins else -80.0
    crossing = rejected(drive(lambda t: 15.0 + direction * (8.0 * t + shift), 10.0))
    assert crossing.reasons == ("incomplete_crossing",)
    assert crossing.direction == ("start_to_end" if direction > 0 else "end_to_start")
    assert crossing.speed_m_per_s == pytest.approx(8.0, rel=0.01)


def test_a_truck_that_parks_on_the_bridge_is_one_crossing_for_ever() -> None:
    """Longer than samples are kept. Then it drives on, and comes back at once."""
    run = drive(
        legs((0, -60), (8, 20), (348, 20), (358, 120), (368, 120), (392, -120)),
        392.0,
        rate_hz=20.0,
    )
    outputs = fed(messages_of(run))
    found = results_in(outputs)
    assert [crossing.reasons for crossing in found][:1] == [("stopped_on_bridge",)]
    assert len(found) == 2
    assert found[1].direction == "end_to_start"
    assert len({state.crossing_id for state in states_in(outputs)}) == 2
    assert len(states_in(outputs)) == 8


def test_a_truck_that_parks_elsewhere_is_no_crossing() -> None:
    run = drive(legs((0, -200), (10, -100), (400, -100)), 400.0, rate_hz=20.0)
    assert fed(messages_of(run)) == []


def test_what_begins_on_the_bridge_after_a_long_drive_is_not_forgotten() -> None:
    """330 s elsewhere, the receiver out for 320 s, and back in the middle of the bridge."""
    run = drive(
        legs((0, -9000), (330, -5000), (650, 15), (670, 215)),
        670.0,
        rate_hz=20.0,
        gnss_kept=lambda t: (t < 330.0) | (t >= 650.0),
    )
    (crossing,) = results_in(fed(messages_of(run)))
    assert crossing.reasons == ("incomplete_crossing",)


def test_no_crossing_no_output() -> None:
    assert fed(messages_of(drive(lambda t: 10.0 * t - 500.0, 30.0))) == []
    assert fed(messages_of(drive(lambda t: 10.0 * t - 100.0, 30.0, lateral_m=45.0))) == []


def test_an_unknown_vehicle_is_noted_and_nothing_else() -> None:
    stranger = SITE.vehicles[0].model_copy(update={"id": "stranger"})
    site = SITE.model_copy(update={"vehicles": (stranger,)})
    messages = messages_of(drive(lambda t: 10.0 * t - 50.0, 15.0), site=site, vehicle="stranger")
    one = engine()
    assert [o for m in messages for o in one.feed(m.key, m.payload)] == []
    assert one.unknown_vehicles == {"stranger"}


def test_several_crossings_of_one_drive() -> None:
    run = drive(legs((0, -60), (20, 140), (30, 140), (50, -60), (60, -60), (80, 140)), 80.0)
    outputs = fed(messages_of(run))
    found = results_in(outputs)
    assert [crossing.direction for crossing in found] == [
        "start_to_end",
        "end_to_start",
        "start_to_end",
    ]
    assert len({crossing.crossing_id for crossing in found}) == 3
    assert all(a.exit_time < b.entry_time for a, b in pairwise(found))


def later(run: Run, seconds: float) -> Run:
    gnss = run.gnss._replace(time_s=run.gnss.time_s + seconds)
    return run._replace(accel_time_s=run.accel_time_s + seconds, gnss=gnss)


def with_second_truck() -> Site:
    other = SITE.vehicles[0].model_copy(update={"id": "truck-2"})
    return SITE.model_copy(update={"vehicles": (*SITE.vehicles, other)})


def test_two_trucks_and_two_realms_do_not_mix(
    crossing_messages: list[Message], scenario_6: SimulatedDrive
) -> None:
    site = with_second_truck()
    second = messages_of(later(scenario_6.run, 60.0), site=site, vehicle="truck-2")
    third = [m._replace(key=m.key._replace(realm="live")) for m in crossing_messages]
    mixed = [m for three in zip(crossing_messages, second, third, strict=True) for m in three]
    found = results_in(fed(mixed, site))
    assert {(c.realm, c.vehicle) for c in found} == {
        ("sim-test", "truck-1"),
        ("sim-test", "truck-2"),
        ("live", "truck-1"),
    }
    assert len(found) == 3
    values = [c.parameters["EI_4"].mean for c in found if c.parameters is not None]
    assert values == [values[0]] * 3


ACROSS = legs((0.0, -60.0), (15.0, 90.0))
"""On the bridge from 6 s to 9.4 s, with both axles."""


def reasons_of_two(
    other: Run, *, name: str = "truck-2", known: bool = True, realm: str = "sim-test"
) -> dict[str, tuple[str, ...]]:
    """The reasons of every crossing where a truck crosses and another one does something else."""
    site = with_second_truck() if known else SITE
    first = messages_of(drive(ACROSS, 15.0), site=site)
    second = list(run_to_messages([other], with_second_truck(), realm, "truck-2"))
    second = [m._replace(key=m.key._replace(identifier=name)) for m in second]
    together = sorted([*first, *second], key=lambda m: m.log_time_ns)
    return {c.vehicle: c.reasons for c in results_in(fed(together, site)) if c.realm == "sim-test"}


@pytest.mark.parametrize(
    "other",
    [
        drive(ACROSS, 15.0),
        drive(legs((0.0, 90.0), (15.0, -60.0)), 15.0),  # they meet
        drive(legs((0.0, -80.0), (17.0, 90.0)), 17.0),  # follows 20 m behind
        later(drive(legs((0.0, 60.0), (9.0, -30.0)), 9.0), 2.5),
    ],
)
def test_two_trucks_on_one_bridge_are_both_rejected_by_name(other: Run) -> None:
    found = reasons_of_two(other)
    assert found.keys() == {"truck-1", "truck-2"}
    for reasons in found.values():
        assert "other_truck_on_bridge" in reasons


def test_a_truck_that_the_site_does_not_know_counts() -> None:
    found = reasons_of_two(drive(ACROSS, 15.0), name="stranger", known=False)
    assert "other_truck_on_bridge" in found["truck-1"]


def test_a_truck_that_stands_on_the_bridge_counts() -> None:
    standing = drive(legs((0.0, 15.0), (20.0, 15.0)), 20.0)
    assert "other_truck_on_bridge" in reasons_of_two(standing)["truck-1"]


@pytest.mark.parametrize(
    ("other", "realm"),
    [
        (later(drive(ACROSS, 15.0), 10.0), "sim-test"),  # comes when the first one has left
        (later(drive(ACROSS, 15.0), -10.0), "sim-test"),
        (drive(ACROSS, 15.0, lateral_m=60.0), "sim-test"),  # on the road beside
        (drive(legs((0.0, -60.0), (15.0, -20.0)), 15.0), "sim-test"),  # waits before the bridge
        (drive(ACROSS, 15.0), "live"),
        # Has gone round and comes again from where it was half a minute before.
        (
            drive(
                legs((0.0, 40.0), (2.0, 240.0), (60.0, 240.0), (60.1, -300.0), (70.0, -200.0)),
                70.0,
                gnss_kept=lambda t: (t <= 2.0) | (t >= 60.5),
            ),
            "sim-test",
        ),
    ],
)
def test_a_truck_that_was_not_there_at_the_same_time_does_not_count(other: Run, realm: str) -> None:
    found = reasons_of_two(other, realm=realm)
    for reasons in found.values():
        assert "other_truck_on_bridge" not in reasons
    assert "truck-1" in found


def test_a_recording_is_fed_truck_by_truck_and_counts_both_all_the_same() -> None:
    """The first is decided before a position of the second is fed: it is announced beforehand."""
    site = with_second_truck()
    first = messages_of(drive(ACROSS, 15.0), site=site)
    second = messages_of(drive(ACROSS, 15.0), site=site, vehicle="truck-2")
    one = engine(site)
    for message in [*first, *second]:
        one.expect(message.key, message.payload)
    outputs = [o for m in [*first, *second] for o in one.feed(m.key, m.payload)]
    found = results_in([*outputs, *one.finish()])
    assert ["other_truck_on_bridge" in c.reasons for c in found] == [True, True]


def test_a_position_that_was_forgotten_does_not_come_back_at_its_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It would push out newer ones, which say that the other truck is on the bridge now."""
    monkeypatch.setattr(traffic, "_MAX_FIXES", 80)
    site = with_second_truck()
    turns_back = legs((0.0, -60.0), (6.0, -10.0), (8.0, 15.0), (10.0, -10.0), (15.0, -60.0))
    first = messages_of(drive(ACROSS, 15.0), site=site)
    second = messages_of(drive(turns_back, 15.0), site=site, vehicle="truck-2")
    began_ns = second[0].log_time_ns
    old = [m for m in second if m.log_time_ns - began_ns < 5_900_000_000]
    one = engine(site)
    for message in sorted([*first, *second], key=lambda m: m.log_time_ns):
        one.expect(message.key, message.payload)
    outputs = [o for m in [*old, *first] for o in one.feed(m.key, m.payload)]
    (crossing,) = results_in(outputs)
    assert crossing.vehicle == "truck-1"
    assert "other_truck_on_bridge" in crossing.reasons


def test_in_a_recording_no_position_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traffic, "_MAX_FIXES", 80)
    site = with_second_truck()
    then_waits = legs((0.0, -60.0), (6.0, -10.0), (8.0, 15.0), (10.0, -10.0), (15.0, -60.0))
    first = messages_of(drive(ACROSS, 15.0), site=site)
    second = messages_of(drive(then_waits, 30.0), site=site, vehicle="truck-2")
    one = engine(site)
    for message in [*first, *second]:
        one.expect(message.key, message.payload, for_ever=True)
    outputs = [o for m in [*second, *first] for o in one.feed(m.key, m.payload)]
    (crossing,) = (c for c in results_in(outputs) if c.vehicle == "truck-1")
    assert "other_truck_on_bridge" in crossing.reasons


def info_of(text: str, message: Message) -> Message:
    info = VehicleInfo(message.boot_id, 0, 0, message.log_time_ns, "truck-1", text)
    return message._replace(key=message.key._replace(stream="info"), payload=encode_info(info))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('[vehicle]\nid = "truck-1"\ntotal_mass_kg = 30000\nwheelbase_m = 7.0\n', True),
        ('[vehicle]\nid = "truck-1"\nwheelbase_m = 7.0\n', True),
        (vehicle_toml(SITE, "truck-1"), False),
        ('[vehicle]\nid = "truck-1"\n', False),
        ("a." * 5000 + "a = 1", False),
    ],
)
def test_a_truck_that_says_it_is_another_is_rejected_by_name(text: str, named: bool) -> None:
    messages = messages_of(drive(ACROSS, 15.0))
    others = [m for m in messages if m.key.stream != "info"]
    (crossing,) = results_in(fed([info_of(text, others[0]), *others]))
    assert ("vehicle_differs_from_site" in crossing.reasons) == named
    assert not named or (crossing.verdict, crossing.parameters) == ("rejected", None)
    # What another boot of it says is of no concern.
    earlier = info_of(text, others[0]._replace(boot_id=others[0].boot_id - 1))
    (crossing,) = results_in(fed([earlier, *others]))
    assert "vehicle_differs_from_site" not in crossing.reasons


def test_a_restart_of_the_truck_decides_what_was_before() -> None:
    """A new boot: the drive before ended on the bridge, and nothing more will come of it."""
    first = drive(lambda t: 10.0 * t - 50.0, 6.0)
    second = drive(lambda t: 10.0 * t - 50.0, 15.0)
    later = second._replace(
        accel_time_s=second.accel_time_s + 3600.0,
        gnss=second.gnss._replace(time_s=second.gnss.time_s + 3600.0),
    )
    messages = messages_of(first, later)
    outputs = fed(messages)
    found = results_in(outputs)
    assert [crossing.reasons for crossing in found][:1] == [("incomplete_crossing",)]
    assert len(found) == 2
    # Copies of the first drive that come again change nothing.
    again = fed([*messages, *messages_of(first)])
    assert [o.payload for o in again] == [o.payload for o in outputs]


def test_a_truck_that_leaves_the_bus_gets_its_finished_crossing_decided() -> None:
    """Its recording ends half a second after the exit: no more will come."""
    run = drive(lambda t: 10.0 * t - 50.0, 8.9)
    one = engine()
    assert not results_in([o for m in messages_of(run) for o in one.feed(m.key, m.payload)])
    assert list(one.gone("sim-test", "truck-2")) == []
    (crossing,) = results_in(list(one.gone("sim-test", "truck-1")))
    assert crossing.direction == "start_to_end"
    assert list(one.gone("sim-test", "truck-1")) == []
    assert list(one.finish()) == []


def test_a_truck_that_leaves_the_bus_on_the_bridge_may_come_back() -> None:
    messages = messages_of(drive(lambda t: 10.0 * t - 50.0, 15.0))
    one = engine()
    on_it = [m for m in messages if m.log_time_ns * 1e-9 - START_S < 6.5]
    outputs = [o for m in on_it for o in one.feed(m.key, m.payload)]
    assert list(one.gone("sim-test", "truck-1")) == []
    outputs += [o for m in messages[len(on_it) :] for o in one.feed(m.key, m.payload)]
    assert len(results_in(outputs)) == 1


@pytest.mark.parametrize(
    ("value", "reasons"),
    [(0.0, ("channel_stuck",)), (1e4, ("channels_alike",))],
)
def test_absurd_accelerations_get_a_verdict(
    scenario_6: SimulatedDrive, value: float, reasons: tuple[str, ...]
) -> None:
    run = scenario_6.run
    noise = np.random.default_rng(0).uniform(0.5, 1.0, run.accel_time_s.size)
    crossing = rejected(
        run._replace(channels=dict.fromkeys(CHANNELS, value * noise))  # all the same
    )
    assert crossing.reasons == reasons


def test_what_fails_inside_is_a_verdict(
    crossing_messages: list[Message], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr("services.identification.paper_method.build_window", fail)
    (crossing,) = results_in(fed(crossing_messages))
    assert (crossing.verdict, crossing.reasons) == ("rejected", ("failed",))


def test_channels_of_different_rates_are_identified(scenario_6: SimulatedDrive) -> None:
    """Body sensors at half the rate of the axles'; the body moves slowly."""
    messages = []
    for message in messages_of(scenario_6.run):
        if message.key.stream == "accel":
            batch = decode_accel(message.payload)
            halved = {
                name: (channel._replace(rate_hz=500.0, samples=channel.samples[::2]))
                if name.startswith("sprung")
                else channel
                for name, channel in batch.channels.items()
            }
            message = message._replace(payload=encode_accel(batch._replace(channels=halved)))
        messages.append(message)
    (crossing,) = results_in(fed(messages, chosen=REAL))
    assert crossing.parameters is not None
    assert crossing.parameters["EI_4"].mean == pytest.approx(0.4 * 1.56e10, rel=0.02)


def test_the_random_walk_says_what_it_is(crossing_messages: list[Message]) -> None:
    chosen = IdentificationSettings(method="random_walk", particles=16, steps=10, seed=4)
    (crossing,) = results_in(fed(crossing_messages, chosen=chosen))
    assert crossing.method == "random_walk"
    assert "no_noise_model" in crossing.reasons
    assert crossing.diagnostics["iterations"] == 10
    assert crossing.parameters is not None
    prior = crossing.parameters["EI_1"].prior
    assert prior is not None
    assert (prior.distribution, prior.scale) == ("uniform", pytest.approx(0.2 * 1.56e10))
