"""What the logger lets in when clocks step, numbers run wild and strangers flood it."""

import contextlib
import shutil
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.events import Event, EventKind
from schemas.signals import GnssFix, Identity, encode_gnss, encode_identity
from schemas.topics import Key, Message
from services.bus.subscription import RawSample
from services.logger import completeness, known_streams
from services.logger import intake as module
from services.logger.clocks import TruckClock
from services.logger.completeness import KNOWN_AGE_S, known_on_disk
from services.logger.intake import GAP_PATIENCE_S, Intake
from services.logger.known_streams import MAX_BOOTS, MAX_STREAMS_OF_ONE
from services.recordings.writer import write_recording

NOW_NS = 1_700_000_000_000_000_000
S = 1_000_000_000
HOUR_NS, DAY_NS = 3600 * S, 86_400 * S
GNSS = Key("live", "vehicle", "truck-1", "gnss")


def message(
    sequence: int,
    *,
    boot_id: int = 1,
    vehicle: str = "truck-1",
    wall_ns: int | None = None,
    device_ns: int | None = None,
    speed: float = 10.0,
    realm: str = "live",
    **flags: bool,
) -> RawSample:
    device_ns = sequence * S // 10 if device_ns is None else device_ns
    wall_ns = NOW_NS + device_ns if wall_ns is None else wall_ns
    fix = GnssFix(boot_id, sequence, device_ns, wall_ns, 50.0, 8.0, 100.0, speed)
    return RawSample(
        f"driveby/v1/{realm}/vehicle/{vehicle}/gnss",
        encode_gnss(fix),
        encode_identity(boot_id, sequence),
        flags.get("recovered", False),
        flags.get("spooled", False),
    )


def make() -> Intake:
    return Intake(None, "logger", 99)


def at(now_s: float) -> tuple[int, float]:
    return NOW_NS + round(now_s * S), now_s


def kinds(events: list[tuple[Key, Event]]) -> list[EventKind]:
    return [event.kind for _, event in events]


@pytest.mark.parametrize("step_ns", [-HOUR_NS, DAY_NS])
def test_truck_clock_step_is_reported_and_loses_nothing(step_ns: int) -> None:
    intake = make()
    written = []
    for sequence in range(100):
        device_ns = sequence * S // 10
        wall_ns = NOW_NS + device_ns + (step_ns if sequence >= 60 else 0)
        one = message(sequence, device_ns=device_ns, wall_ns=wall_ns)
        written.append(intake.accept(one, NOW_NS + device_ns))
    assert [one.sequence for one in written if one is not None] == list(range(100))
    [(where, event)] = intake.report(*at(10.0))
    assert where.identifier == event.vehicle == "truck-1"
    assert event.kind == EventKind.CLOCK_STEP
    assert (event.first_sequence, event.boot_id) == (60, 1)
    assert f"{step_ns / S:+.3f} s" in event.text


@pytest.mark.parametrize("step_ns", [-HOUR_NS, DAY_NS])
def test_logger_clock_step_is_reported_once_and_loses_nothing(step_ns: int) -> None:
    intake = make()
    events = []
    for sequence in range(100):
        now_s = sequence / 10
        now_ns = NOW_NS + round(now_s * S) + (step_ns if sequence >= 60 else 0)
        assert intake.accept(message(sequence), now_ns) is not None
        events += intake.report(now_ns, now_s)
    [(_, event)] = events
    assert (event.kind, event.vehicle) == (EventKind.CLOCK_STEP, "")
    assert "the logger's wall clock jumped" in event.text


def test_late_and_repeated_messages_are_no_clock_steps() -> None:
    intake = make()
    for sequence in (0, 1, 5, 3, 4, 2, 5, 6):
        intake.accept(message(sequence), NOW_NS + sequence * S // 10)
    intake.accept(message(0, boot_id=2, wall_ns=NOW_NS + DAY_NS), NOW_NS + DAY_NS)
    assert EventKind.CLOCK_STEP not in kinds(intake.report(*at(86_400.0)))


def test_small_steps_and_drift_are_no_steps() -> None:
    clock = TruckClock(1)
    for second in range(3600):
        drift_ns = second * 100_000  # 100 ppm
        assert clock.wall_against_device(NOW_NS + second * S + drift_ns, second * S) == 0


def envelope(drift_ppm: float, offset_s: float, minutes: int) -> TruckClock:
    """A truck whose clock is slow by so much; its messages take 5 to 205 ms, some 3 s."""
    clock = TruckClock(1)
    for number in range(minutes * 600 + 1):
        now_ns = NOW_NS + number * S // 10
        delay_ns = (
            5_000_000 + (number * 7919 % 200) * 1_000_000 + (3 * S if number % 50 == 0 else 0)
        )
        behind_ns = round(offset_s * S + drift_ppm * 1e-6 * number * S / 10)
        clock.arrived(now_ns - delay_ns - behind_ns, now_ns)
    return clock


@pytest.mark.parametrize(("drift_ppm", "offset_s"), [(0.0, 0.0), (50.0, 2.0), (-20.0, -100.0)])
def test_drift_and_offset_are_found_under_delays(drift_ppm: float, offset_s: float) -> None:
    found = envelope(drift_ppm, offset_s, 20).drift()
    assert found is not None
    assert found.drift_ppm == pytest.approx(drift_ppm, abs=1.0)
    expected_s = offset_s + drift_ppm * 1e-6 * 1050  # in the middle of the last five minutes
    assert found.offset_s == pytest.approx(expected_s + 0.005, abs=0.005)


def test_a_minute_in_which_all_came_late_changes_neither() -> None:
    clock = envelope(0.0, 1.0, 10)
    for number in range(600):
        now_ns = NOW_NS + 600 * S + number * S // 10
        clock.arrived(now_ns - 31 * S, now_ns)
    clock.arrived(NOW_NS + 659 * S, NOW_NS + 660 * S)
    found = clock.drift()
    assert found is not None
    assert found.drift_ppm == pytest.approx(0.0, abs=1.0)
    assert found.offset_s == pytest.approx(1.005, abs=0.005)


def test_drift_is_reported_when_known_and_when_changed() -> None:
    intake = make()
    reported = []
    for number in range(40 * 600):
        now_s = number / 10
        behind_ns = round(2 * S + 100e-6 * now_s * S)
        one = message(number, device_ns=number * S // 10, wall_ns=at(now_s)[0] - behind_ns)
        intake.accept(one, at(now_s)[0])
        if number % 10 == 0:
            reported += intake.report(*at(now_s))
    assert set(kinds(reported)) == {EventKind.CLOCK_DRIFT}
    assert 3 <= len(reported) <= 5  # 60 ms in ten minutes
    assert reported[0][1].text == "the truck's clock is 2.000 s behind the logger's"
    assert "+100.0 ppm" in reported[-1][1].text
    figures = intake.clock_figures()
    assert figures["clock_drift_ppm/truck-1"] == pytest.approx(100.0, abs=1.0)


def test_clock_that_is_ahead_is_reported_at_the_first_message() -> None:
    intake = make()
    intake.accept(message(0, device_ns=0, wall_ns=NOW_NS + HOUR_NS - S), NOW_NS)
    [(where, event)] = intake.report(*at(0.1))
    assert where.identifier == event.vehicle == "truck-1"
    assert event.kind == EventKind.CLOCK_DRIFT
    assert event.text == "the truck's clock is 3599.000 s ahead of the logger's"
    assert intake.clock_figures() == {"clock_offset_s/truck-1": -3599.0}
    intake.accept(message(1, device_ns=S // 10, wall_ns=NOW_NS + HOUR_NS - 9 * S // 10), NOW_NS)
    assert intake.report(*at(0.2)) == []


def test_late_message_reports_no_clock_at_once() -> None:
    """It may have waited, for instance in a drive that is played faster than real."""
    intake = make()
    intake.accept(message(0, device_ns=0, wall_ns=NOW_NS - HOUR_NS), NOW_NS)
    assert intake.report(*at(0.1)) == []
    assert intake.clock_figures() == {}


def test_clock_that_is_years_behind_is_reported_at_the_first_message() -> None:
    intake = make()
    intake.accept(message(0, device_ns=0, wall_ns=NOW_NS - 2200 * DAY_NS), NOW_NS)
    [(_, event)] = intake.report(*at(0.1))
    assert event.kind == EventKind.CLOCK_DRIFT
    assert event.text == "the truck's clock is 2200.0 days behind the logger's"


def test_a_replays_old_times_say_nothing_of_clocks() -> None:
    intake = make()
    for number in range(1000):
        intake.accept(message(number, realm="replay-x"), NOW_NS + DAY_NS + number * S)
    assert intake.clock_figures() == {}


@pytest.mark.parametrize(("realm", "is_reported"), [("live", True), ("sim-slow", False)])
@pytest.mark.parametrize("speed", [0.5, 4.0])
def test_a_simulated_drive_at_another_speed_is_no_drift(
    realm: str, is_reported: bool, speed: float
) -> None:
    """Both are published by `driveby truck`; in realm live only a real clock can be meant."""
    intake = make()
    seconds = 400
    # Faster than real, the drive ends now; slower, it begins now.
    ahead_s = max(0.0, seconds - seconds / speed)
    events = []
    for number in range(seconds):
        wall_ns = NOW_NS + round((number - ahead_s) * S)
        now = at(number / speed)
        sample = message(number, device_ns=number * S, wall_ns=wall_ns, realm=realm)
        assert intake.accept(sample, now[0]) is not None
        events += intake.report(*now)
    assert (EventKind.CLOCK_DRIFT in kinds(events)) == is_reported
    assert ("clock_offset_s/truck-1" in intake.clock_figures()) == is_reported
    assert intake.lag_s() > 100.0


def test_payload_and_attachment_must_agree() -> None:
    intake = make()
    forged = message(7)._replace(attachment=encode_identity(1, 8))
    assert intake.accept(forged, NOW_NS) is None
    [(_, event)] = intake.report(*at(0.0))
    assert event.kind == EventKind.REFUSED
    assert "the payload has 1, 7 where its attachment has 1, 8" in event.text
    assert intake.accept(message(8), NOW_NS) is not None


def test_a_sequence_that_begins_again_with_other_content_is_refused_not_dropped() -> None:
    intake = make()
    assert intake.accept(message(3), NOW_NS) is not None
    assert intake.accept(message(3), NOW_NS) is None
    assert intake.counts == {"received": 2, "accepted": 1, "duplicates": 1}
    assert intake.accept(message(3, speed=11.0), NOW_NS) is None
    [(_, event)] = intake.report(*at(0.0))
    assert "sequence 3 received again with other content" in event.text


def test_an_impossible_rate_is_refused_but_no_replay_and_no_clock_that_stands_still() -> None:
    intake = make()
    flood = [intake.accept(message(n, wall_ns=NOW_NS), NOW_NS + n) for n in range(7000)]
    assert sum(one is not None for one in flood) == 6000
    [(_, event)] = intake.report(*at(0.0))
    assert "more than 500 messages a second" in event.text
    # What we asked a truck for comes as fast as it can.
    assert intake.accept(message(9000, wall_ns=NOW_NS, recovered=True), NOW_NS + 7000) is not None
    fast = [intake.accept(message(n, vehicle="fast"), NOW_NS + n) for n in range(20_000)]
    assert None not in fast
    for n in range(20_000):
        now_ns = NOW_NS + n * S // 10
        assert intake.accept(message(n, vehicle="frozen", wall_ns=NOW_NS), now_ns) is not None


def test_a_flood_of_boots_takes_bounded_memory_and_harms_its_own_stream_only() -> None:
    intake = make()
    intake.accept(message(0, boot_id=1), NOW_NS)
    for boot_id in range(2, 500):
        intake.accept(message(0, boot_id=boot_id), NOW_NS)
    assert len(intake.seen.streams) == MAX_BOOTS
    assert intake.accept(message(1, boot_id=1), NOW_NS) is not None
    assert intake.accept(message(0, boot_id=7, vehicle="truck-2"), NOW_NS) is not None
    # An hour later the boot that was silent longest makes room for a new one.
    intake.accept(message(1, boot_id=3), NOW_NS)
    later = NOW_NS + HOUR_NS + 1
    assert intake.accept(message(2, boot_id=1), later) is not None
    assert intake.accept(message(0, boot_id=1000), later) is not None
    assert intake.forgotten == [(GNSS, 2)]
    assert len(intake.seen.streams) == MAX_BOOTS + 1


def test_a_flood_of_vehicles_takes_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_streams, "MAX_STREAMS", 20)
    intake = make()
    for number in range(100):
        intake.accept(message(0, vehicle=f"truck-{number}"), NOW_NS)
    assert len(intake.seen.streams) == len(intake._streams) == 20
    assert intake.counts["refused"] == 80
    for second in range(5):
        assert len(intake.report(*at(second))) <= module._MAX_REFUSED_SOURCES
        for number in range(10_000):
            intake.accept(message(0, vehicle=f"v-{number}"), NOW_NS)
    assert len(intake._refused) <= module._MAX_REFUSED_SOURCES
    assert len(intake._refused_reported_s) <= module._MAX_REFUSED_SOURCES


def test_a_vehicle_that_shows_itself_in_8400_realms_locks_out_no_other() -> None:
    """Its certificate gives it its own name in every realm."""
    intake = make()
    assert intake.accept(message(0, vehicle="truck-2"), NOW_NS) is not None
    for number in range(8400):
        intake.accept(message(0, vehicle="truck-evil", realm=f"sim-{number}"), NOW_NS)
    assert len(intake.seen.streams) == MAX_STREAMS_OF_ONE + 1
    later = NOW_NS + S
    assert intake.accept(message(1, vehicle="truck-2"), later) is not None
    assert intake.accept(message(0, vehicle="truck-3"), later) is not None
    for number in range(200):  # as many sources of refusals as are distinguished
        intake.accept(message(0, vehicle="truck-evil", realm=f"sim-{number + 9000}"), later)
    intake.accept(message(5, vehicle="truck-3")._replace(attachment=None), later)
    evil, honest = intake.report(*at(1.0))
    assert (evil[1].vehicle, evil[1].messages) == ("truck-evil", 8400 - MAX_STREAMS_OF_ONE + 200)
    assert f"more than {MAX_STREAMS_OF_ONE} streams of vehicle truck-evil" in evil[1].text
    assert (honest[1].vehicle, honest[1].messages) == ("truck-3", 1)


def test_streams_age_out_where_room_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_streams, "MAX_STREAMS", 20)
    intake = make()
    for number in range(21):
        intake.accept(message(0, vehicle=f"truck-{number}"), NOW_NS)
    assert intake.counts["refused"] == 1
    [(_, event)] = intake.report(*at(0.0))
    assert "more than 20 streams of all vehicles" in event.text
    later = NOW_NS + HOUR_NS + S
    for number in range(1, 20):  # all but truck-0 go on
        assert intake.accept(message(1, vehicle=f"truck-{number}"), later) is not None
    assert intake.accept(message(0, vehicle="truck-20"), later) is not None
    assert intake.forgotten == [(GNSS._replace(identifier="truck-0"), 1)]
    assert len(intake._streams) == 20
    assert intake.accept(message(0, vehicle="truck-21"), later) is None
    assert "clock_offset_s/truck-0" not in intake.clock_figures()
    # The same within one vehicle, where the newest realm counts.
    for number in range(MAX_STREAMS_OF_ONE + 1):
        realm = f"sim-{number}"
        then = NOW_NS + (2 if number == MAX_STREAMS_OF_ONE else 0) * HOUR_NS
        monkeypatch.setattr(known_streams, "MAX_STREAMS", 8000)
        assert intake.accept(message(0, vehicle="truck-x", realm=realm), then) is not None
    assert intake.forgotten[-1][0].realm == "sim-0"


def test_a_flood_of_bridges_locks_out_no_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_streams, "MAX_STREAMS", 20)
    intake = make()
    for number in range(100):
        where = Key("live", "bridge", f"bridge-{number}", "state")
        with contextlib.suppress(ValueError):
            intake._streams.of(where, Identity(1, 0), NOW_NS)
    assert len(intake._streams) == 20
    assert intake.accept(message(0), NOW_NS) is not None


def test_a_flood_of_holes_takes_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_RUNS", 10)
    intake = make()
    for sequence in range(0, 200, 2):
        intake.accept(message(sequence), NOW_NS)
    assert intake.seen.streams[(GNSS, 1)].runs == 10
    # What fills a hole or goes on is taken as before.
    assert intake.accept(message(3), NOW_NS) is not None
    assert intake.accept(message(19), NOW_NS) is not None


def test_refusals_are_logged_once_a_minute_and_all_counted() -> None:
    intake = make()
    reported = []
    for second in range(200):
        intake.accept(message(1)._replace(attachment=None), NOW_NS)
        reported += intake.report(*at(float(second)))
    reported += intake.report(*at(200.0), closing=True)
    assert [event.messages for _, event in reported] == [1, 60, 60, 60, 19]


def test_lost_messages_are_reported_and_no_longer_a_gap() -> None:
    intake = make()
    for sequence in (0, 1, 8, 9):
        intake.accept(message(sequence), NOW_NS)
    intake.report(*at(0.0))
    [(_, gap)] = intake.report(*at(GAP_PATIENCE_S))
    assert (gap.kind, gap.messages, intake.counts["missing"]) == (EventKind.GAP, 6, 6)
    intake.accept(message(2, recovered=True), NOW_NS)
    intake.accept(message(3, recovered=True), NOW_NS)
    intake.mark_lost(GNSS, 1, 2, 7, NOW_NS)
    events = intake.report(*at(20.0))
    assert sorted(kinds(events)) == [EventKind.LOST, EventKind.RECOVERED]
    [lost] = [event for _, event in events if event.kind == EventKind.LOST]
    assert (lost.first_sequence, lost.last_sequence, lost.messages) == (4, 7, 4)
    assert (intake.counts["missing"], intake.counts["lost"]) == (0, 4)
    assert intake.settled == [(GNSS, 1, 4, 7)]
    intake.mark_lost(GNSS, 1, 2, 7, NOW_NS)
    assert intake.report(*at(21.0)) == []


def test_message_that_arrives_after_it_was_given_up_is_written_once() -> None:
    """A truck with a full disk holds no message that it has just sent."""
    intake = make()
    assert intake.accept(message(0), NOW_NS)
    intake.mark_lost(GNSS, 1, 1, 2, NOW_NS)
    assert intake.accept(message(2), NOW_NS)
    assert intake.accept(message(2), NOW_NS) is None
    assert intake.counts["duplicates"] == 1
    # Given up again after it was written, as by a truck that does not list it.
    intake.mark_lost(GNSS, 1, 2, 2, NOW_NS)
    assert intake.accept(message(2), NOW_NS) is None


def test_messages_given_up_take_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second one of a range leaves as many ranges."""
    monkeypatch.setattr("services.logger.intake.MAX_RUNS", 3)
    intake = make()
    assert intake.accept(message(0), NOW_NS)
    intake.mark_lost(GNSS, 1, 1, 20, NOW_NS)
    late = [intake.accept(message(number), NOW_NS) for number in range(2, 20, 2)]
    assert [one is not None for one in late] == [True] * 3 + [False] * 6


def test_a_bad_message_from_a_spool_is_not_asked_for_for_ever() -> None:
    intake = make()
    intake.accept(message(0), NOW_NS)
    bad = message(1)._replace(payload=b"\xff")
    assert intake.accept(bad, NOW_NS) is None
    assert intake.settled == []  # the truck's own copy may be better
    assert intake.accept(bad._replace(recovered=True, spooled=True), NOW_NS) is None
    assert intake.settled == [(GNSS, 1, 1, 1)]
    assert intake.counts["refused"] == 2


def test_shrinking_gap_is_reported_once() -> None:
    intake = make()
    for sequence in (0, 100):
        intake.accept(message(sequence), NOW_NS)
    reported = intake.report(*at(0.0))
    for second in range(1, 30):
        intake.accept(message(second, recovered=True), NOW_NS)
        reported += intake.report(*at(float(second)))
    gaps = [event for _, event in reported if event.kind == EventKind.GAP]
    assert [(gap.first_sequence, gap.last_sequence) for gap in gaps] == [(6, 99)]


numbers = st.integers(0, 2**32 - 1)


@settings(max_examples=200)
@given(
    st.lists(
        st.tuples(
            st.text(max_size=300) | st.sampled_from(["driveby/v1/live/vehicle/truck-1/gnss"]),
            st.binary(max_size=60) | st.just(message(1).payload),
            st.none() | st.binary(max_size=20) | st.builds(encode_identity, numbers, numbers),
            st.booleans(),
        ),
        max_size=20,
    )
)
def test_anything_goes_in_and_only_what_is_right_comes_out(
    received: list[tuple[str, bytes, bytes | None, bool]],
) -> None:
    intake = make()
    for one in received:
        taken = intake.accept(RawSample(*one, one[3]), NOW_NS)
        if taken is not None:
            assert taken.key == GNSS
            assert Identity(taken.boot_id, taken.sequence) == (1, 1)
    intake.report(*at(0.0), closing=True)


def test_what_is_on_disk_is_known_and_not_written_again(tmp_path: Path) -> None:
    def recording(realm: str, name: str, sequences: range, boot_id: int = 1) -> Path:
        path = tmp_path / realm / "2023-11-14" / f"{name}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        where = GNSS._replace(realm=realm)
        made = [message(n, boot_id=boot_id) for n in sequences]
        messages = [Message(where, one.payload, *one.identity(), NOW_NS, NOW_NS) for one in made]
        write_recording(path, messages, site_toml=None, reason="test")
        return path

    recording("live", "truck-1-a", range(10))
    recording("live", "truck-1-b", range(15, 20))
    recording("replay-x", "truck-1-c", range(5))
    broken = recording("sim-a", "truck-1-d", range(5), boot_id=2)
    broken.write_bytes(broken.read_bytes()[:-100])
    (tmp_path / "live" / "2023-11-14" / "no.mcap").write_bytes(b"nonsense")
    now_s = time.time()
    found = sorted(known_on_disk(tmp_path, ["*"], now_s))
    assert found == [
        (GNSS, 1, 0, 9),
        (GNSS, 1, 15, 19),
        (GNSS._replace(realm="sim-a"), 2, 0, 4),
    ]
    assert list(known_on_disk(tmp_path, ["live"], now_s)) == found[:2]
    assert list(known_on_disk(tmp_path, ["*"], now_s + KNOWN_AGE_S + 60)) == []
    intake = make()
    for known in found:
        assert intake.adopt(*known, NOW_NS)
    assert intake.accept(message(9), NOW_NS) is None
    assert intake.accept(message(10), NOW_NS) is not None
    assert intake.counts["duplicates"] == 1


def test_what_is_recovered_while_it_is_about_to_be_read_is_known_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the child of a logger that was killed, or by hand."""
    day = tmp_path / "live" / "2023-11-14"
    day.mkdir(parents=True)
    for name, first in (("truck-1-a.mcap", 0), ("truck-1-b.mcap", 10)):
        made = [message(n) for n in range(first, first + 10)]
        messages = [Message(GNSS, one.payload, *one.identity(), NOW_NS, NOW_NS) for one in made]
        write_recording(day / name, messages, site_toml=None, reason="test")
    real = completeness.read_identities
    logged: list[str] = []

    def read(path: Path) -> object:
        cut_off = day / "truck-1-b.mcap"
        if cut_off.exists():
            (day / ".truck-1-b.recovered.0.part.mcap").write_bytes(b"another one, half written")
            shutil.copy(cut_off, day / "truck-1-b.recovered.mcap")
            cut_off.rename(day / "truck-1-b.mcap.crashed")
        return real(path)

    monkeypatch.setattr(completeness, "read_identities", read)
    monkeypatch.setattr(completeness._log, "warning", lambda *what: logged.append(str(what)))
    found = sorted(known_on_disk(tmp_path, ["*"], time.time()))
    assert found == [(GNSS, 1, 0, 9), (GNSS, 1, 10, 19)]
    assert logged == []


def test_second_truck_of_one_name_is_reported_and_kept() -> None:
    intake = make()
    written = [
        intake.accept(message(n, boot_id=boot_id, wall_ns=NOW_NS + n * S), NOW_NS + n * S)
        for n in range(30)
        for boot_id in (1, 2)
    ]
    assert None not in written
    [(sender, line)] = intake.shared_names.news()
    assert sender.identifier == "truck-1"
    assert "several trucks" in line


def test_messages_fetched_from_an_earlier_boot_share_no_name() -> None:
    intake = make()
    for n in range(30):
        intake.accept(message(n, boot_id=2, wall_ns=NOW_NS + n * S), NOW_NS + n * S)
        intake.accept(message(n, boot_id=1, recovered=True), NOW_NS + n * S)
    assert intake.shared_names.news() == []
