"""`driveby watch`: what it knows of a realm, and the page that it makes of it."""

import io
import threading
import time
from pathlib import Path

import pytest
from rich.console import Console

from schemas.proto import driveby_pb2 as pb
from schemas.reasons import BridgeReason
from schemas.results import BridgeResult
from schemas.results_on_the_wire import bridge_to_protobuf
from schemas.signals import Identity
from schemas.site import Site
from services.bus.realm_listener import BusMessage, sees_trucks
from services.cli import main as cli
from services.cli import realm_model
from services.cli.commands import watch
from services.cli.presence_lines import NOTHING_ABSENT, presence_lines
from services.cli.realm_model import RealmModel
from services.cli.watch_page import NO_ALARM, bars, page, silent_trucks
from tests.unit.cli.watching import (
    NOW_NS,
    NOW_S,
    Listened,
    a_fleet,
    a_morning,
    alarm,
    bridge_state,
    deliver,
    drives,
    estimate,
    health,
    heard,
    progress,
    result,
    state,
)


def drawn(
    watched: RealmModel, width: int = 120, height: int = 40, listened: Listened | None = None
) -> list[str]:
    """The lines of the page, without colours."""
    file = io.StringIO()
    console = Console(file=file, width=width, height=height, color_system=None)
    listening = listened or Listened(alive={"truck-1", "truck-2"})
    console.print(
        page(
            watched, f"realm {listening.realm}", listening,
            now_s=NOW_S, now_ns=NOW_NS, width=width, height=height,
        )
    )  # fmt: skip
    return file.getvalue().splitlines()


def line(lines: list[str], begins: str) -> str:
    (found,) = [one for one in lines if one.startswith(begins)]
    return " ".join(found.split())


def test_a_morning_on_a_wide_terminal(site: Site) -> None:
    lines = drawn(a_morning(site))
    assert line(lines, "truck-1") == "truck-1 drives 4 × 1000 Hz 20 10 9.8 0.1 s"
    assert line(lines, "truck-3") == "truck-3 silent 300 s, left 4 × 1000 Hz 0 0 9.8 0.1 s"
    assert (
        line(lines, "14:13:20") == "14:13:20 truck-1 → bridge-1 good ▆▆▆▃▆▆▆ EI_4 0.40 (0.38–0.42)"
    )
    assert line(lines, "14:17:20").endswith("EI_4 0.40 (0.38–0.42) model_misfit")
    assert line(lines, "14:18:20").endswith("rejected channel_missing")
    assert line(lines, "14:22:30").endswith("truck-1 → bridge-1 identifying 45 %")
    assert line(lines, "14:23:16").endswith("truck-2 → bridge-1 on the bridge")
    assert "60 % less stiff than the other elements" in line(lines, "bridge-1")
    assert line(lines, "logger") == "logger well 120 messages/s, queue 3, lost 0, dropped 0"
    assert line(lines, "worker") == "worker well identifying for 20 s, queue 14"
    assert lines[0].endswith("UTC  5 done, 1 waiting")


@pytest.mark.parametrize("width", [40, 80, 120])
@pytest.mark.parametrize("height", [10, 24, 60])
def test_no_line_is_longer_than_the_terminal(site: Site, width: int, height: int) -> None:
    watched = a_morning(site)
    for number in range(100):
        drives(watched, f"truck-{number}")
        watched.crossings[str(number)] = watched.rows()[0]._replace(entry_ns=NOW_NS - number)
    lines = drawn(watched, width, height)
    assert max(map(len, lines)) <= width
    if height >= 24 and width >= 80:  # on fewer columns findings take many lines
        assert len(lines) <= height + 2
        assert any(one.strip().startswith("and ") for one in lines)


def test_on_80_columns_the_lowest_element_is_whole(site: Site) -> None:
    lines = drawn(a_morning(site), 80, 40)
    assert line(lines, "14:13:20").endswith("EI_4 0.40 (0.38–0.42)")
    assert line(lines, "14:18:20").endswith("rejected channel_missing")


def test_bars_say_which_element_is_weak() -> None:
    text = bars((1.0, 0.96, 1.07, 0.4, 0.0, 9.0), frozenset({4}))
    assert text.plain == "▆▆▆▃▁█"
    styles = {str(span.style) for span in text.spans if span.start == 3}
    assert styles == {"bold yellow"}
    assert {str(span.style) for span in bars((1.0, 0.4), frozenset(), doubtful=True).spans} == {
        "bright_black"
    }


def test_crossing_found_in_a_recording_is_not_on_the_bridge() -> None:
    """A worker that identifies yesterday's crossing announces it after the truck has left."""
    watched = RealmModel()
    old = deliver(watched, state("a", pb.DETECTED, "truck-1", 0.0), ago_s=500.0)
    assert old is not None
    assert old.endswith(": from a recording")
    assert (watched.rows()[0].state, watched.waiting) == ("from a recording", 1)
    new = deliver(watched, state("b", pb.DETECTED, "truck-1", 595.0))
    assert new is not None
    assert new.endswith(": on the bridge")
    drives(watched, "truck-2", lag_s=400.0)  # as in a replay: all of it is late
    late = deliver(watched, state("c", pb.DETECTED, "truck-2", 190.0))
    assert late is not None
    assert late.endswith(": on the bridge")


def test_without_trucks_data_no_crossing_is_from_a_recording() -> None:
    """The credentials of a viewer do not show when the truck's samples were taken."""
    watched = RealmModel(sees_trucks=False)
    for entry, words in ((0.0, "detected"), (595.0, "on the bridge")):
        found = deliver(watched, state(f"c-{entry}", pb.DETECTED, "truck-1", entry))
        assert found is not None
        assert found.endswith(f": {words}")


def test_page_and_line_of_a_viewer_name_a_state_alike() -> None:
    """Without trucks' data it is unknown whether a truck sends samples."""
    watched = RealmModel(sees_trucks=False)
    for name, entry, words in (("a", 0.0, "detected"), ("b", 595.0, "on the bridge")):
        printed = deliver(watched, state(name, pb.DETECTED, "truck-1", entry))
        assert printed is not None
        assert printed.endswith(f": {words}")
    rows = [one.rstrip() for one in drawn(watched) if "→ bridge-1" in one]
    assert [one.split("bridge-1")[1].strip() for one in rows] == ["on the bridge", "detected"]


def test_credentials_that_show_trucks(credentials: Path) -> None:
    assert sees_trucks(None, "live")
    assert sees_trucks(credentials / "worker", "live")
    assert not sees_trucks(credentials / "viewer", "live")


def test_entry_of_a_result_is_that_of_its_states(site: Site) -> None:
    """The estimated entry differs from the detected one, by which the crossing is named."""
    watched = RealmModel()
    name = "truck-1.bridge-1.20260921T141320.900Z"
    crossing = result(site, name).model_copy(update={"entry_time": 1_790_000_001.2})
    for message in (state(name, pb.DETECTED, "truck-1", 0.9), estimate(crossing)):
        line = deliver(watched, message, ago_s=598.0)
        assert line is not None
        assert "entry 2026-09-21 14:13:20: " in line


def test_lines_for_a_pipe(site: Site) -> None:
    watched = RealmModel()
    output = [one for one in drives(watched, "truck-1") if one is not None]
    output += [
        one
        for message in (
            state("a", pb.DETECTED, "truck-1", 590.0),
            state("a", pb.DETECTED, "truck-1", 590.0),
            state("a", pb.COMPLETE, "truck-1", 590.0),
            state("a", pb.IDENTIFYING, "truck-1", 590.0),
            progress("worker", "a", "sampling", 0.5),
            estimate(result(site, "a")),
            state("a", pb.DONE, "truck-1", 0.0),
            state("a", pb.IDENTIFYING, "truck-1", 0.0),  # late
            health("logger", ok=False, note="disk full", rate_per_s=3.0),
        )
        if (one := deliver(watched, message)) is not None
    ]
    assert output == [
        "truck-1 drives",
        "truck-1 → bridge-1, entry 2026-09-21 14:23:10: on the bridge",
        "truck-1 → bridge-1, entry 2026-09-21 14:23:10: complete",
        "truck-1 → bridge-1, entry 2026-09-21 14:23:10: identifying",
        (
            "truck-1 → bridge-1, entry 2026-09-21 14:13:20: "
            "good, lowest EI_4 0.400 of nominal (95 % interval 0.377 to 0.424)"
        ),
        "logger is NOT WELL: 3 messages/s, disk full",
    ]


def test_returning_truck_is_announced_again() -> None:
    watched = RealmModel()
    assert drives(watched, "truck-1", ago_s=60.0).count("truck-1 drives") == 1
    assert silent_trucks(watched, NOW_S) == {"truck-1"}
    assert drives(watched, "truck-1").count("truck-1 drives") == 1
    assert silent_trucks(watched, NOW_S) == set()


def test_old_samples_are_explained() -> None:
    watched = RealmModel()
    drives(watched, "truck-1", lag_s=1356.0)
    lines = drawn(watched)
    assert line(lines, "truck-1").endswith("23 min")
    (why,) = [one for one in lines if "samples are old on arrival" in one]
    assert "replayed faster than real time, sent late, or a clock is wrong" in why
    replayed = drawn(watched, listened=Listened("replay-monday"))
    assert line(replayed, "truck-1").endswith("replay")
    assert not any("samples are old" in one for one in replayed)


def test_samples_from_the_future_are_explained() -> None:
    watched = RealmModel()
    drives(watched, "truck-1", lag_s=-3599.0)
    lines = drawn(watched)
    assert line(lines, "truck-1").endswith("60 min ahead")
    assert any(
        "truck-1: samples are dated ahead: the clock of the truck or of this machine is wrong"
        in one
        for one in lines
    )
    assert not any("future" in one for one in drawn(watched, listened=Listened("replay-monday")))


def test_an_empty_realm_names_the_others() -> None:
    listened = Listened()
    assert any("No trucks yet." in one for one in drawn(RealmModel(), listened=listened))
    listened.elsewhere = {"sim-demo": {"truck-1"}}
    lines = drawn(RealmModel(), listened=listened)
    assert "nothing in realm live, but truck-1 in sim-demo; use --realm sim-demo" in lines


def test_a_service_that_is_silent_or_unwell_stands_out() -> None:
    watched = RealmModel()
    deliver(watched, health("logger", ok=False, note="disk full"))
    deliver(watched, health("worker"))
    deliver(watched, progress("worker", "", "validating truck-1 on bridge-1", 0.3))
    assert line(drawn(watched), "logger") == "logger not well disk full"
    assert line(drawn(watched), "worker") == "worker well validating truck-1 on bridge-1, 30 %"
    watched.services["worker"] = watched.services["worker"]._replace(time_ns=NOW_NS - 10**12)
    silent = line(drawn(watched), "worker")
    assert silent.startswith("worker silent 17 min")
    assert "validating" not in silent


def test_absent_worker_is_named_in_place_of_no_waiting(site: Site) -> None:
    watched, listened = a_morning(site), Listened()
    del watched.services["worker"]
    assert drawn(watched)[0].endswith("UTC  no worker answers; 5 done, 1 waiting")
    assert drawn(RealmModel())[0].endswith("UTC  no worker answers")
    assert drawn(RealmModel(began_s=NOW_S - 1.0))[0].endswith("UTC  0 done, 0 waiting")
    deliver(watched, health("worker", ended=True, identifying=0.0))
    assert "no worker answers" in drawn(watched)[0]
    deliver(watched, health("worker-b", identifying=0.0))
    assert "no worker answers" not in drawn(watched)[0]
    listened.gone_s = {"worker-b": NOW_S - 4.0}
    assert "no worker answers" in drawn(watched, listened=listened)[0]
    listened.lost_s = NOW_S - 4.0
    assert "no worker answers" not in drawn(watched, listened=listened)[0]


def test_time_of_an_identification_goes_on_between_messages() -> None:
    """Its health comes once a minute."""
    watched = RealmModel()
    for number, expected in (
        (1.0, "identifying for"),
        (3.0, "identifying 3 crossings, the longest for"),
    ):
        deliver(watched, health("worker", identifying=number, identifying_longest_s=8.0))
        row = watched.services["worker"]
        for age_s in (0.0, 40.0, -1.0):
            watched.services["worker"] = row._replace(time_ns=NOW_NS - round(age_s * 1e9))
            shown = line(drawn(watched), "worker")
            assert shown == f"worker well {expected} {8.0 + max(age_s, 0.0):.0f} s"
    watched.services["worker"] = row._replace(time_ns=NOW_NS - 95 * 10**9)
    assert line(drawn(watched), "worker") == "worker silent 95 s"


def test_overdue_service_is_silent() -> None:
    watched = RealmModel()
    deliver(watched, health("worker"))
    row = watched.services["worker"]
    for age_s, expected in ((89.0, "worker well"), (91.0, "worker silent 91 s")):
        watched.services["worker"] = row._replace(time_ns=NOW_NS - round(age_s * 1e9))
        assert line(drawn(watched), "worker") == expected


def test_service_that_left_without_an_end_is_silent_at_once() -> None:
    watched, listened = RealmModel(), Listened()
    deliver(watched, health("worker"))
    listened.gone_s = {"worker": NOW_S - 1.0}  # as long as the restart of a router takes
    assert line(drawn(watched, listened=listened), "worker") == "worker well"
    listened.gone_s = {"worker": NOW_S - 4.0}
    assert line(drawn(watched, listened=listened), "worker") == "worker silent 12 s"
    deliver(watched, health("worker", ended=True))
    assert line(drawn(watched, listened=listened), "worker") == "worker ended 12 s ago"


@pytest.mark.parametrize("height", [10, 40])
def test_lost_connection_is_on_the_page(site: Site, height: int) -> None:
    watched, listened = a_morning(site), Listened()
    listened.lost_s, listened.gone_s = NOW_S - 7.0, {"worker": NOW_S - 7.0}
    lines = drawn(watched, height=height, listened=listened)
    assert lines[1] == "connection to the router lost 7.0 s ago"
    if height == 40:
        assert line(lines, "worker") == "worker unknown for 12 s queue 14"
        assert line(lines, "truck-3").startswith("truck-3 silent 300 s 4 ×")
    listened.lost_s = None
    assert not any("lost 7" in one for one in drawn(watched, listened=listened))


def test_lines_on_silent_services_and_the_connection() -> None:
    watched, listened = RealmModel(), Listened()
    absent = NOTHING_ABSENT
    printed: list[str] = []

    def look(now_s: float = NOW_S) -> None:
        nonlocal absent
        absent, lines = presence_lines(absent, watched, listened, now_s, NOW_NS)
        printed.extend(lines)

    deliver(watched, health("worker"))
    look()
    listened.lost_s = NOW_S
    for _ in range(2):
        look()
    listened.lost_s, listened.gone_s = None, {"worker": NOW_S}
    look(NOW_S + 1.0)
    for _ in range(2):
        look(NOW_S + 4.0)
    listened.gone_s = {}
    look(NOW_S + 5.0)
    listened.gone_s = {"worker": NOW_S}
    look(NOW_S + 9.0)
    listened.gone_s = {}
    deliver(watched, health("worker", queue=1.0))  # which is a line itself
    look(NOW_S + 9.0)
    assert printed == [
        "connection to the router lost",
        "connected again",
        "worker is silent",
        "worker is back",
        "worker is silent",
    ]


def test_work_of_a_replaced_worker_is_not_shown() -> None:
    """It was killed while it validated, and the next one skips the validation."""
    watched = RealmModel()
    deliver(watched, health("worker"))
    deliver(watched, progress("worker", "", "validating truck-1 on bridge-1", 0.33))
    assert "33 %" in line(drawn(watched), "worker")
    deliver(watched, health("worker")._replace(identity=Identity(2, 0)))
    assert line(drawn(watched), "worker") == "worker well"


def test_crossing_of_a_silent_truck_waits_for_samples() -> None:
    watched = RealmModel()
    deliver(watched, state("a", pb.DETECTED, "truck-1", 580.0))
    drives(watched, "truck-1")
    assert line(drawn(watched), "14:23:00").endswith("on the bridge")
    watched = RealmModel()
    deliver(watched, state("a", pb.DETECTED, "truck-1", 580.0))
    drives(watched, "truck-1", ago_s=20.0)
    assert line(drawn(watched), "14:23:00").endswith("waits for samples")


def test_what_it_keeps_is_bounded(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_MAX_CROSSINGS", "_MAX_TRUCKS", "_MAX_BRIDGES", "_MAX_SERVICES"):
        monkeypatch.setattr(realm_model, name, 5)
    watched = RealmModel()
    for number in range(20):
        drives(watched, f"truck-{number}", ago_s=20.0 - number)
        deliver(watched, estimate(result(site, f"c-{number}", entry=float(number))))
        deliver(watched, health(f"logger-{number}"))
    assert len(watched.crossings) <= 6
    assert watched.rows()[0].crossing_id == "c-19"
    assert set(watched.trucks) == {f"truck-{number}" for number in range(15, 20)}
    assert len(watched.services) == 5


def test_what_cannot_be_read_is_left_out() -> None:
    watched = RealmModel()
    for owner, stream in (
        ("vehicle", "accel"), ("vehicle", "gnss"), ("bridge", "crossing"), ("bridge", "estimate"),
        ("bridge", "state"), ("bridge", "alarm"), ("service", "health"), ("service", "progress"),
    ):  # fmt: skip
        assert deliver(watched, heard(owner, "x", stream, b"\xff\x00nonsense")) is None
    assert not watched.crossings
    assert not watched.alarms
    assert not watched.services


SENTENCE = "element 4 is 10 % less stiff than before 2026-08-27 (95 % interval 8 to 12 %)"


def test_an_alarm_is_a_line_until_it_is_another(site: Site) -> None:
    watched = RealmModel()
    output = [
        deliver(watched, one) for one in (alarm(), alarm(), alarm(by="owner"), alarm(by="owner"))
    ]
    assert output == [
        f"alarm of bridge-1, active: {SENTENCE}",
        None,
        f"alarm of bridge-1, acknowledged by owner: {SENTENCE}",
        None,
    ]


def test_alarms_that_stand_come_first_on_the_page(site: Site) -> None:
    watched = a_morning(site)
    for number in range(5):
        deliver(watched, alarm(f"old-{number}", by="owner", raised=1.7899e9 + number))
    deliver(watched, alarm())
    lines = drawn(watched)
    assert lines[1] == f"alarm of bridge-1, active: {SENTENCE}"
    assert lines[2] == f"alarm of old-4, acknowledged by owner: {SENTENCE}"
    assert "  and 2 more alarms, 0 active" in lines
    for number in range(5):
        deliver(watched, alarm(f"new-{number}"))
    assert "  and 7 more alarms, 2 active" in drawn(watched)
    assert len(drawn(watched, 80, 24)) <= 26


def test_a_bridge_with_an_alarm_is_among_those_that_are_shown(site: Site) -> None:
    watched = a_fleet(site)
    for number in range(6):
        deliver(watched, bridge_state(site, f"later-{number}"))
    lines = drawn(watched)
    (head,) = [n for n, line in enumerate(lines) if line.startswith("bridge ")]
    shown = [
        line.split()[0] for line in lines[head + 1 :] if line.startswith(("bridge-", "later-"))
    ]
    assert shown == ["bridge-07", "later-3", "later-4", "later-5"]


def test_where_there_is_no_room_an_alarm_that_stands_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(realm_model, "_MAX_BRIDGES", 2)
    watched = RealmModel()
    deliver(watched, alarm("stands", raised=1.0))
    for number in range(4):
        deliver(watched, alarm(f"old-{number}", by="owner", raised=2.0 + number))
    assert set(watched.alarms) == {"stands", "old-3"}


def test_bad_options_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["watch", "--realm", "monday"]) == 2
    assert cli.main(["watch", "--endpoint", "nowhere"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 2
    assert "realm 'monday' must be live" in err


def test_absent_alarms_are_no_reassurance_on_the_page(site: Site) -> None:
    """The page cannot know whether bridges are watched, and says so until an alarm comes."""
    output = "No alarm was received; it is not known here whether driveby alarm serve monitors"
    watched = RealmModel()
    assert not any(one.startswith(output) for one in drawn(watched))
    deliver(watched, bridge_state(site))
    assert line(drawn(watched), output).endswith("any bridge.")
    deliver(watched, alarm())
    assert not any(one.startswith(output) for one in drawn(watched))


def test_clock_that_is_behind_is_explained() -> None:
    watched = RealmModel()
    drives(watched, "truck-1", lag_s=9.0)
    drives(watched, "truck-2", lag_s=1.0)
    drives(watched, "truck-3", lag_s=30.0)
    watched.trucks["truck-3"].lags_s.extend([9.0] * 50)  # it catches up
    output = "truck-1 by 9.0 s: all samples are equally old: the truck's clock is behind"
    lines = [one.strip() for one in drawn(watched)]
    assert [one for one in lines if "equally old" in one] == [
        f"{output}, or this machine's is ahead"
    ]
    replayed = drawn(watched, listened=Listened("replay-monday"))
    assert not any("equally old" in one for one in replayed)


def test_service_that_ended_is_not_well(site: Site) -> None:
    watched = a_morning(site)
    deliver(watched, progress("worker", "", "validating truck-1 on bridge-1", 0.58))
    assert "58 %" in line(drawn(watched), "worker")
    assert deliver(watched, health("worker", ended=True)) == "worker has ended"
    assert line(drawn(watched), "worker") == "worker ended 12 s ago"
    failed = deliver(watched, health("worker", ok=False, ended=True, note="disk full"))
    assert failed == "worker has ended, NOT WELL: disk full"
    assert line(drawn(watched), "worker") == "worker ended 12 s ago disk full"
    deliver(watched, health("worker", queue=0.0))  # started again
    assert line(drawn(watched), "worker") == "worker well queue 0"


def test_progress_of_a_killed_service_is_not_kept(site: Site) -> None:
    watched = a_morning(site)
    deliver(watched, progress("worker", "", "validating truck-1 on bridge-1", 0.58))
    row = watched.services["worker"]
    watched.services["worker"] = row._replace(time_ns=NOW_NS - 100_000_000_000)
    assert "58 %" not in line(drawn(watched), "worker")


def test_bridge_without_a_good_crossing_has_its_reason(site: Site) -> None:
    watched = RealmModel()
    deliver(watched, estimate(result(site, "a", verdict="suspect", reasons=("model_misfit",))))
    rejected = BridgeResult(verdict="rejected", reasons=(BridgeReason.NO_GOOD_CROSSING,))  # type: ignore[call-arg]
    payload = bridge_to_protobuf("bridge-1", NOW_NS, rejected).SerializeToString()
    words = "No crossing of the bridge is good."
    printed = deliver(watched, heard("bridge", "bridge-1", "state", payload))
    assert printed == f"bridge-1, 0 crossings fused: {words}"
    assert line(drawn(watched), "bridge-1").endswith(f"rejected: {words}")


class Batches(Listened):
    """A listener that stops with its last batch."""

    def __init__(self, batches: list[list[BusMessage]]) -> None:
        super().__init__()
        self._batches = batches
        self.stop = threading.Event()

    def heard(self) -> list[BusMessage]:
        if len(self._batches) == 1:
            self.stop.set()
        return self._batches.pop(0)


def test_absent_worker_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "_HINT_AFTER_S", 0.0)
    monkeypatch.setattr(watch, "_PERIOD_S", 0.0)
    fresh = pb.Health(service="worker", time_ns=time.time_ns(), ok=True, figures={"identifying": 0})
    worker = heard("service", "worker", "health", fresh.SerializeToString())
    crossing = state("d", pb.DETECTED, "truck-1", 550.0)
    for messages, expected in (([], 0), ([crossing], 1), ([crossing, worker], 0)):
        printed: list[str] = []
        listened = Batches([messages, [], []])
        watch._print_lines(RealmModel(), listened, listened.stop, printed.append)  # type: ignore[arg-type]
        assert sum(one.endswith(" no worker answers") for one in printed) == expected


def test_lines_without_an_alarm_are_no_reassurance(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watch, "_HINT_AFTER_S", 0.0)
    monkeypatch.setattr(watch, "_PERIOD_S", 0.0)
    of_bridge = bridge_state(site)
    for messages, expected in (([of_bridge], 1), ([of_bridge, alarm()], 0), ([], 0)):
        printed: list[str] = []
        listened = Batches([messages, []])
        watch._print_lines(RealmModel(), listened, listened.stop, printed.append)  # type: ignore[arg-type]
        assert sum(one.endswith(NO_ALARM) for one in printed) == expected
