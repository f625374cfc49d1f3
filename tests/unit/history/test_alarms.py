"""Alarms of a history: raised, kept over restarts, reported, acknowledged by somebody only."""

import json
import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from schemas.alarms import Alarm, alarm_of, encode_alarm
from schemas.proto import driveby_pb2 as pb
from services.cli import main as cli
from services.cli.alarm_service import AlarmPublisher
from services.common.errors import InputError
from services.common.language import language_of
from services.history import alarms
from services.history.alarm_files import acknowledge, active_alarms, alarms_of
from services.history.alarms import AlarmSettings, check, monitoring_states
from services.history.history_store import add_results
from services.history.watch_files import MonitoringState, WatchRecord, record_path
from tests.fleet import WEEK_S, losses_of

BEGIN_S = datetime(2025, 1, 6, tzinfo=UTC).timestamp()  # a Monday
WEEKS = 24
LOSES_AT = 14
AFTER_S = BEGIN_S + WEEKS * WEEK_S


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One bridge that is sound, one that loses a fifth of element 4 in week 14."""
    folder = tmp_path_factory.mktemp("history")
    found = losses_of({"bridge-1": None, "bridge-2": LOSES_AT}, BEGIN_S, WEEKS)
    add_results(folder, found, {one.crossing_id: 10.0 for one in found.crossings})
    return folder


@pytest.fixture
def history(made: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "history"
    folder.mkdir()
    (folder / "crossings").symlink_to(made / "crossings")
    return folder


def test_the_right_alarm_and_no_other(history: Path) -> None:
    found = check(history, AlarmSettings(), AFTER_S)
    (alarm,) = found.raised
    assert found.active == (alarm,)
    assert (found.bridges, found.problems) == (2, ())
    assert (alarm.bridge, alarm.element, alarm.direction) == ("bridge-2", 4, "weaker")
    assert alarm.since == pytest.approx(BEGIN_S + LOSES_AT * WEEK_S, abs=WEEK_S)
    assert alarm.raised <= BEGIN_S + (LOSES_AT + 4) * WEEK_S
    assert alarm.ratio_q025 < 0.8 < alarm.ratio_q975
    assert alarm.sentence().startswith("element 4 is ")


def test_an_alarm_is_raised_once_and_stands_over_any_restart(history: Path) -> None:
    first = check(history, AlarmSettings(), AFTER_S)
    again = check(history, AlarmSettings(), AFTER_S)
    assert (again.raised, again.active, again.bridges) == ((), first.active, 0)
    everything = check(history, AlarmSettings(), AFTER_S, everything=True)
    assert (everything.raised, everything.active) == ((), first.active)
    # Whatever would be found now: it stands until somebody acknowledges it.
    sleepy = AlarmSettings(training=500)
    assert check(history, sleepy, AFTER_S, everything=True).active == first.active


def test_two_processes_find_what_one_finds(history: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = check(history, AlarmSettings(), AFTER_S)
    for path in (history / "alarms").rglob("*.json"):
        path.unlink()
    monkeypatch.setattr(alarms, "_BATCH", 1)
    assert check(history, AlarmSettings(), AFTER_S, processes=2) == one


def test_a_period_that_is_not_over_does_not_count(history: Path) -> None:
    before_s = BEGIN_S + (LOSES_AT + 0.9) * WEEK_S
    assert check(history, AlarmSettings(), before_s).raised == ()
    # Later the same crossings are looked at again, though nothing was added.
    assert check(history, AlarmSettings(), AFTER_S).bridges == 2


def test_after_it_is_acknowledged_what_is_then_is_the_baseline(history: Path) -> None:
    (alarm,) = check(history, AlarmSettings(), AFTER_S).active
    noted = acknowledge(history, alarm, "owner", "props were put in", alarm.raised + WEEK_S)
    assert noted.acknowledged is not None
    after = check(history, AlarmSettings(), AFTER_S, everything=True)
    assert (after.raised, after.active) == ((), ())
    assert alarms_of(history, "sim-fleet", "bridge-2") == ([noted], [])
    with pytest.raises(InputError, match="is acknowledged already"):
        acknowledge(history, alarm, "somebody else", "", AFTER_S)


def watch_now(history: Path, bridge: str = "bridge-1", now_s: float = AFTER_S) -> MonitoringState:
    found, problems = monitoring_states(history, now_s)
    assert problems == []
    return found[("sim-fleet", bridge)]


def test_only_a_watch_that_judged_says_that_nothing_has_changed(history: Path) -> None:
    assert watch_now(history).state == "never_checked"
    check(history, AlarmSettings(training=40), AFTER_S)
    training = watch_now(history)
    assert (training.state, training.found_nothing) == ("training", False)
    assert training.sentence == (
        "Not monitored yet: 24 of 40 training weeks are complete as of 2025-06-23."
    )
    check(history, AlarmSettings(), AFTER_S)
    assert watch_now(history).found_nothing
    assert watch_now(history).sentence == (
        "No alarm: 16 weeks judged, 2025-03-03 to 2025-06-23; none shows a change that is clearly "
        "larger than 5 %."
    )
    assert watch_now(history, "bridge-2").state == "alarm"
    (alarm,) = active_alarms(history)[0]
    acknowledge(history, alarm, "owner", "", AFTER_S)
    assert watch_now(history, "bridge-2").state == "acknowledged"
    where = record_path(history, "sim-fleet", "bridge-1")
    where.write_text("{")
    found, problems = monitoring_states(history, AFTER_S)
    assert found[("sim-fleet", "bridge-1")].state == "never_checked"
    assert problems[0].startswith(f"{where}: not a record of a check: ")
    # A record that is lost or damaged beyond reading is made again.
    where.unlink()
    assert check(history, AlarmSettings(), AFTER_S).bridges >= 1
    assert watch_now(history).found_nothing


def test_crossings_that_came_after_the_check_are_not_vouched_for(tmp_path: Path) -> None:
    found = losses_of({"bridge-1": None}, BEGIN_S, WEEKS)
    warm = {one.crossing_id: 10.0 for one in found.crossings}
    first = found.model_copy(update={"crossings": found.crossings[:-4]})
    add_results(tmp_path, first, warm)
    check(tmp_path, AlarmSettings(), AFTER_S - 2 * WEEK_S)
    assert watch_now(tmp_path, now_s=AFTER_S - 2 * WEEK_S).found_nothing
    # Two weeks later nothing has come: nothing is missing either.
    assert watch_now(tmp_path).found_nothing
    add_results(tmp_path, found, warm)
    later = watch_now(tmp_path)
    assert (later.state, later.sentence) == (
        "out_of_date",
        "Not monitored since 2025-06-09: crossings were added after driveby alarm check was run.",
    )
    check(tmp_path, AlarmSettings(), AFTER_S)
    assert watch_now(tmp_path).found_nothing


def test_crossings_dated_in_the_future_are_named(history: Path) -> None:
    """A rehearsal dates its second survey a year ahead."""
    now_s = BEGIN_S + 3.0 * WEEK_S
    check(history, AlarmSettings(), now_s)
    found = watch_now(history, now_s=now_s)
    assert found.sentence == (
        "Not monitored yet: 3 of 8 training weeks are complete as of 2025-01-27. Crossings dated "
        f"after the check, up to {newest_day(history)}, do not count yet."
    )
    assert "nach der Prüfung" in found.words(language_of("de"))
    check(history, AlarmSettings(), AFTER_S)
    assert "dated after" not in watch_now(history).sentence


def test_an_unchanged_bridge_is_not_read_to_say_that_it_is_watched(
    history: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check(history, AlarmSettings(), AFTER_S)
    record = record_path(history, "sim-fleet", "bridge-1")
    added_s = (history / "crossings/realm=sim-fleet/bridge=bridge-1").stat().st_mtime
    monkeypatch.setattr(alarms, "read_partition", lambda where: 1 / 0)
    for bridge in ("bridge-1", "bridge-2"):
        path = record_path(history, "sim-fleet", bridge)
        os.utime(path, (added_s + 120.0, added_s + 120.0))
    assert watch_now(history).found_nothing
    # A week that was not over at the check, and is now, has crossings that nobody judged.
    unfinished = record.read_text().replace(
        f'"newest": {load_newest(record)}', f'"newest": {AFTER_S + 3600.0}'
    )
    record.write_text(unfinished)
    os.utime(record, (added_s + 120.0, added_s + 120.0))
    assert watch_now(history).found_nothing
    assert watch_now(history, now_s=AFTER_S + WEEK_S).state == "out_of_date"


def newest_day(history: Path) -> str:
    newest_s = float(load_newest(record_path(history, "sim-fleet", "bridge-1")))
    return f"{datetime.fromtimestamp(newest_s, UTC):%Y-%m-%d}"


def load_newest(record: Path) -> float:
    return float(json.loads(record.read_text())["newest"])


def test_a_year_passes_before_an_unknown_season_is_judged(tmp_path: Path) -> None:
    add_results(tmp_path, losses_of({"bridge-1": None}, BEGIN_S, 20))
    check(tmp_path, AlarmSettings(), BEGIN_S + 20 * WEEK_S)
    found = watch_now(tmp_path, now_s=BEGIN_S + 20 * WEEK_S)
    assert (found.state, found.sentence) == (
        "season",
        (
            "Not monitored yet: temperatures are unknown, so the first year, until 2026-01-05, "
            "only serves to estimate the seasonal effect."
        ),
    )


def test_alarms_of_earlier_versions_are_read_and_their_acknowledgement_counts(
    history: Path,
) -> None:
    """One that a CUSUM raised in the week in which the loss began, and that somebody noted: the
    baseline is what the bridge was then, and nothing is raised again."""
    since_s = BEGIN_S + LOSES_AT * WEEK_S
    where = history / "alarms/realm=sim-fleet/bridge=bridge-2"
    where.mkdir(parents=True)
    (where / "20250421-4-weaker.json").write_text(
        '{"edition": 1, "alarm_id": "20250421-4-weaker", "realm": "sim-fleet", '
        '"bridge": "bridge-2", "element": 4, "direction": "weaker", '
        f'"since": {since_s}, "raised": {since_s + WEEK_S}, "sum": 9.6, "threshold": 9.3, '
        '"ratio": 0.8, "ratio_q025": 0.77, "ratio_q975": 0.83, "acknowledged": null}'
    )
    noted = f'{{"edition": 1, "by": "owner", "time": {since_s + WEEK_S + 60.0}, "note": ""}}'
    (where / "20250421-4-weaker.ack.json").write_text(noted)
    (history / "alarms/checked.json").write_text('{"sim-fleet/bridge-1": [1, "week", 2, 0.01, 8]}')
    found = check(history, AlarmSettings(), AFTER_S)
    assert (found.bridges, found.raised, found.active, found.problems) == (2, (), (), ())
    assert watch_now(history, "bridge-2").found_nothing


def test_the_smallest_change_of_interest_is_an_option(
    history: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["alarm", "check", "--history", str(history)]
    assert cli.main([*words, "--at-least", "30"]) == 0
    assert "0 new alarms" in capsys.readouterr().out
    assert cli.main([*words, "--at-least", "5"]) == 0
    assert "1 new alarm\n" in capsys.readouterr().out
    assert cli.main([*words, "--at-least", "60"]) == 2
    assert "a change in per cent from 0 to 50" in capsys.readouterr().err


def test_damaged_files_of_alarms_get_a_line_and_what_stands_stands(history: Path) -> None:
    (alarm,) = check(history, AlarmSettings(), AFTER_S).active
    where = history / "alarms/realm=sim-fleet/bridge=bridge-2"
    (where / "noise.json").write_text("{")
    (where / f"{alarm.alarm_id}.ack.json").write_text('{"by": ""}')
    (history / "alarms/checked.json").write_text("[]")
    found, problems = active_alarms(history)
    assert found == [alarm]
    assert len(problems) == 2
    assert any("noise.json: not an alarm: " in line for line in problems)
    assert any(f"{alarm.alarm_id}.ack.json: by: " in line for line in problems)
    assert check(history, AlarmSettings(), AFTER_S).active == (alarm,)
    newer = (where / f"{alarm.alarm_id}.json").read_text().replace('"edition": 1', '"edition": 2')
    (where / "20250101-1-weaker.json").write_text(newer)
    assert any("20250101-1-weaker.json: edition: " in line for line in active_alarms(history)[1])


def test_alarms_on_the_wire(history: Path) -> None:
    (alarm,) = check(history, AlarmSettings(), AFTER_S).active
    for one in (alarm, acknowledge(history, alarm, "owner", "looked at", AFTER_S)):
        message = pb.Alarm.FromString(encode_alarm(one, 5))
        assert alarm_of(message, "sim-fleet") == one
        assert (message.time_ns, message.text) == (5, one.sentence())
    message.schema_version = 2
    with pytest.raises(ValueError, match="schema version 2, not 1"):
        alarm_of(message, "sim-fleet")


def test_alarm_is_published_when_raised_noted_and_restarted(
    history: Path,
) -> None:
    reported: list[tuple[str, bool]] = []

    def put(alarm: Alarm, payload: bytes) -> None:
        assert pb.Alarm.FromString(payload).alarm_id == alarm.alarm_id
        reported.append((alarm.bridge, alarm.acknowledged is not None))

    teller = AlarmPublisher(put)
    teller.publish_changes(history, 1)
    assert reported == []
    (alarm,) = check(history, AlarmSettings(), AFTER_S).active
    teller.publish_changes(history, 2)
    teller.publish_changes(history, 3)
    assert reported == [("bridge-2", False)]
    AlarmPublisher(put).publish_changes(history, 4)
    assert reported == [("bridge-2", False)] * 2
    acknowledge(history, alarm, "owner", "", AFTER_S)
    teller.publish_changes(history, 5)
    teller.publish_changes(history, 6)
    assert reported == [("bridge-2", False), ("bridge-2", False), ("bridge-2", True)]


def test_the_commands(history: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    there = ["--history", str(history)]
    assert cli.main(["alarm", "list", *there]) == 0
    never = "driveby alarm check has not been run on this bridge."
    assert capsys.readouterr().out.splitlines() == [
        "no alarms",
        "0 of 2 bridges are monitored",
        f"bridge-1 in realm sim-fleet: Not monitored: {never}",
        f"bridge-2 in realm sim-fleet: Not monitored: {never}",
    ]
    assert cli.main(["alarm", "check", *there]) == 0
    output = capsys.readouterr().out
    assert output.startswith("2 bridges checked, 1 new alarm\nalarm 2025")
    assert "-4-weaker of bridge-2, raised 2025-" in output
    how = "then acknowledge the alarm with driveby alarm ack BRIDGE --by NAME --note TEXT\n"
    assert output.endswith(how)
    assert "\nan alarm compares periods; identify and fuse combine all crossings" in output
    assert "\n2 of 2 bridges are monitored\n" in output
    assert cli.main(["alarm", "list", *there]) == 0
    assert capsys.readouterr().out.endswith(how)
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", "--note", "props", *there]) == 0
    assert "acknowledged by owner on" in capsys.readouterr().out
    assert cli.main(["alarm", "list", *there]) == 0
    assert how not in capsys.readouterr().out
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", *there]) == 2
    assert capsys.readouterr().err == f"driveby: {history}: bridge-2 has no active alarm\n"
    assert cli.main(["alarm", "ack", "bridge-2", *there]) == 2
    assert "--by NAME" in capsys.readouterr().err
    assert cli.main(["alarm", "check", "bridge-2", *there]) == 2
    assert cli.main(["history", "bridge-2", "--figures", str(tmp_path / "f"), *there]) == 0
    assert "(props)" in capsys.readouterr().out


def test_exit_code_reports_alarms_and_failures_on_request(
    history: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = ["--history", str(history)]
    asked = [*there, "--exit-code"]
    assert cli.main(["alarm", "list", *asked]) == 0
    assert cli.main(["alarm", "check", *asked]) == 4
    assert cli.main(["alarm", "list", *asked]) == 4
    assert cli.main(["alarm", "list", *there]) == 0
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", *there]) == 0
    assert cli.main(["alarm", "list", *asked]) == cli.main(["alarm", "check", *asked]) == 0
    (history / "alarms/realm=sim-fleet/bridge=bridge-2/noise.json").write_text("{")
    assert cli.main(["alarm", "list", *asked]) == cli.main(["alarm", "check", *asked]) == 3
    assert cli.main(["alarm", "check", *there]) == 0
    capsys.readouterr()
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", *asked]) == 2
    assert capsys.readouterr().err == "driveby: --exit-code: needs check or list\n"


def test_unpublished_notes_are_published_at_the_start(history: Path) -> None:
    """Who heard the alarm stand shows it until it hears that somebody took note of it."""
    (alarm,) = check(history, AlarmSettings(), AFTER_S).active
    acknowledge(history, alarm, "owner", "", AFTER_S)
    reported: list[tuple[str, bool]] = []

    def put(alarm: Alarm, payload: bytes) -> None:
        reported.append((alarm.bridge, alarm.acknowledged is not None))

    month_s = 30 * 86_400.0
    AlarmPublisher(put).publish_changes(history, round((AFTER_S + month_s - 60.0) * 1e9))
    assert reported == [("bridge-2", True)]
    AlarmPublisher(put).publish_changes(history, round((AFTER_S + month_s + 60.0) * 1e9))
    assert reported == [("bridge-2", True)]


def test_an_acknowledgement_that_is_damaged_can_be_given_again(
    history: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (alarm,) = check(history, AlarmSettings(), AFTER_S).active
    damaged = history / f"alarms/realm=sim-fleet/bridge=bridge-2/{alarm.alarm_id}.ack.json"
    damaged.write_text("{")
    words = ["alarm", "ack", "bridge-2", "--by", "owner", "--history", str(history)]
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{damaged}: not an acknowledgement: " in line
    assert line.endswith("; move that file away and acknowledge again")
    damaged.rename(damaged.with_suffix(".damaged"))
    assert cli.main(words) == 0
    assert active_alarms(history) == ([], [])


@pytest.mark.parametrize(
    ("output", "line"),
    [
        (["--by", "x" * 201], "--by: String should have at most 200 characters"),
        (["--by", "owner", "--note", "x" * 1001], "--note: String should have at most 1000"),
        (["--by", "\n"], "--by: String should have at least 1 character"),
    ],
)
def test_invalid_acknowledgement_gives_one_line(
    history: Path, capsys: pytest.CaptureFixture[str], output: list[str], line: str
) -> None:
    check(history, AlarmSettings(), AFTER_S)
    assert cli.main(["alarm", "ack", "bridge-2", *output, "--history", str(history)]) == 2
    assert capsys.readouterr().err.startswith(f"driveby: {line}")
    assert len(active_alarms(history)[0]) == 1


def test_a_note_is_one_line_and_nothing_that_a_terminal_obeys(
    history: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check(history, AlarmSettings(), AFTER_S)
    words = ["alarm", "ack", "bridge-2", "--by", "an\nowner", "--note", "one\x1b[2J\ntwo"]
    assert cli.main([*words, "--history", str(history)]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "acknowledged by an owner on" in line
    assert "(one\\x1b[2J two)" in line


def test_an_alarm_in_another_place_than_its_own_gets_a_line(history: Path) -> None:
    (alarm,) = check(history, AlarmSettings(), AFTER_S).active
    path = history / f"alarms/realm=sim-fleet/bridge=bridge-2/{alarm.alarm_id}.json"
    copy = path.with_name("copy.json")
    copy.write_bytes(path.read_bytes())
    elsewhere = history / f"alarms/realm=live/bridge=bridge-2/{alarm.alarm_id}.json"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.write_bytes(path.read_bytes())
    found, problems = active_alarms(history)
    assert found == [alarm]
    for wrong in (copy, elsewhere):
        output = f"{wrong}: is alarm {alarm.alarm_id} of bridge-2 in realm sim-fleet, which"
        assert any(line.startswith(output) for line in problems)


def test_an_alarm_stands_though_its_crossings_are_gone(
    history: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check(history, AlarmSettings(), AFTER_S)
    (history / "crossings").unlink()
    there = ["--history", str(history)]
    assert cli.main(["alarm", "list", *there]) == 0
    assert "of bridge-2, raised" in capsys.readouterr().out
    assert cli.main(["alarm", "check", "--all", *there]) == 0
    assert "active: element 4" in capsys.readouterr().out
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", *there]) == 0
    assert active_alarms(history) == ([], [])


def test_running_week_is_named_as_not_yet_complete() -> None:
    """Good crossings of this week are there, so a sentence without this word is wrong."""
    record = WatchRecord.model_construct(
        period="week", judged=0, problem="", periods=0, training=8, at_least=0.05,
        checked=0.0, until=0.0, year_ends=0.0, judged_from=0.0, judged_to=0.0,
    )  # fmt: skip
    state = MonitoringState("no_crossings", record)
    assert "no complete week has good crossings" in state.sentence
    assert "Kein vollständiger Zeitraum" in state.words(language_of("de"))
