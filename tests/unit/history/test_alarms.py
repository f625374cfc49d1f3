"""Alarms of a history: raised, kept over restarts, told, acknowledged by somebody only."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from schemas.alarms import Alarm, alarm_of, encode_alarm
from schemas.proto import driveby_pb2 as pb
from services.cli import main as cli
from services.cli.alarm_service import Teller
from services.common.errors import InputError
from services.history import alarms
from services.history.alarm_files import acknowledge, alarms_of, standing
from services.history.alarms import Settings, check
from services.history.archive import add_results
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
    found = check(history, Settings(), AFTER_S)
    (alarm,) = found.raised
    assert found.standing == (alarm,)
    assert (found.bridges, found.problems) == (2, ())
    assert (alarm.bridge, alarm.element, alarm.direction) == ("bridge-2", 4, "weaker")
    assert alarm.since == pytest.approx(BEGIN_S + LOSES_AT * WEEK_S, abs=WEEK_S)
    assert alarm.raised <= BEGIN_S + (LOSES_AT + 4) * WEEK_S
    assert alarm.ratio_q025 < 0.8 < alarm.ratio_q975
    assert alarm.sentence().startswith("element 4 is ")


def test_an_alarm_is_raised_once_and_stands_over_any_restart(history: Path) -> None:
    first = check(history, Settings(), AFTER_S)
    again = check(history, Settings(), AFTER_S)
    assert (again.raised, again.standing, again.bridges) == ((), first.standing, 0)
    everything = check(history, Settings(), AFTER_S, everything=True)
    assert (everything.raised, everything.standing) == ((), first.standing)
    # Whatever would be found now: it stands until somebody acknowledges it.
    sleepy = Settings(learning=500)
    assert check(history, sleepy, AFTER_S, everything=True).standing == first.standing


def test_two_processes_find_what_one_finds(history: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = check(history, Settings(), AFTER_S)
    for path in (history / "alarms").rglob("*.json"):
        path.unlink()
    monkeypatch.setattr(alarms, "_BATCH", 1)
    assert check(history, Settings(), AFTER_S, processes=2) == one


def test_a_period_that_is_not_over_does_not_count(history: Path) -> None:
    before_s = BEGIN_S + (LOSES_AT + 0.9) * WEEK_S
    assert check(history, Settings(), before_s).raised == ()
    # Later the same crossings are looked at again, though nothing was added.
    assert check(history, Settings(), AFTER_S).bridges == 2


def test_after_it_is_acknowledged_what_is_then_is_the_baseline(history: Path) -> None:
    (alarm,) = check(history, Settings(), AFTER_S).standing
    noted = acknowledge(history, alarm, "owner", "props were put in", alarm.raised + WEEK_S)
    assert noted.acknowledged is not None
    after = check(history, Settings(), AFTER_S, everything=True)
    assert (after.raised, after.standing) == ((), ())
    assert alarms_of(history, "sim-fleet", "bridge-2") == ([noted], [])
    with pytest.raises(InputError, match="is acknowledged already"):
        acknowledge(history, alarm, "somebody else", "", AFTER_S)


def test_damaged_files_of_alarms_get_a_line_and_what_stands_stands(history: Path) -> None:
    (alarm,) = check(history, Settings(), AFTER_S).standing
    where = history / "alarms/realm=sim-fleet/bridge=bridge-2"
    (where / "noise.json").write_text("{")
    (where / f"{alarm.alarm_id}.ack.json").write_text('{"by": ""}')
    (history / "alarms/checked.json").write_text("[]")
    found, problems = standing(history)
    assert found == [alarm]
    assert len(problems) == 2
    assert any("noise.json: not an alarm: " in line for line in problems)
    assert any(f"{alarm.alarm_id}.ack.json: by: " in line for line in problems)
    assert check(history, Settings(), AFTER_S).standing == (alarm,)
    newer = (where / f"{alarm.alarm_id}.json").read_text().replace('"edition": 1', '"edition": 2')
    (where / "20250101-1-weaker.json").write_text(newer)
    assert any("20250101-1-weaker.json: edition: " in line for line in standing(history)[1])


def test_alarms_on_the_wire(history: Path) -> None:
    (alarm,) = check(history, Settings(), AFTER_S).standing
    for one in (alarm, acknowledge(history, alarm, "owner", "looked at", AFTER_S)):
        message = pb.Alarm.FromString(encode_alarm(one, 5))
        assert alarm_of(message, "sim-fleet") == one
        assert (message.time_ns, message.text) == (5, one.sentence())
    message.schema_version = 2
    with pytest.raises(ValueError, match="schema version 2, not 1"):
        alarm_of(message, "sim-fleet")


def test_each_alarm_is_told_when_it_is_raised_when_it_is_noted_and_after_a_restart(
    history: Path,
) -> None:
    told: list[tuple[str, bool]] = []

    def put(alarm: Alarm, payload: bytes) -> None:
        assert pb.Alarm.FromString(payload).alarm_id == alarm.alarm_id
        told.append((alarm.bridge, alarm.acknowledged is not None))

    teller = Teller(put)
    teller.tell(history, 1)
    assert told == []
    (alarm,) = check(history, Settings(), AFTER_S).standing
    teller.tell(history, 2)
    teller.tell(history, 3)
    assert told == [("bridge-2", False)]
    Teller(put).tell(history, 4)
    assert told == [("bridge-2", False)] * 2
    acknowledge(history, alarm, "owner", "", AFTER_S)
    teller.tell(history, 5)
    teller.tell(history, 6)
    assert told == [("bridge-2", False), ("bridge-2", False), ("bridge-2", True)]


def test_the_commands(history: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    there = ["--history", str(history)]
    assert cli.main(["alarm", "list", *there]) == 0
    assert capsys.readouterr().out == "no alarms\n"
    assert cli.main(["alarm", "check", *there]) == 0
    said = capsys.readouterr().out
    assert said.startswith("2 bridges looked at, 1 new alarm\nalarm 2025")
    assert "-4-weaker of bridge-2, raised 2025-" in said
    how = "look at the bridge, then: driveby alarm ack BRIDGE --by NAME --note TEXT\n"
    assert said.endswith(how)
    assert cli.main(["alarm", "list", *there]) == 0
    assert capsys.readouterr().out.endswith(how)
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", "--note", "props", *there]) == 0
    assert "acknowledged by owner on" in capsys.readouterr().out
    assert cli.main(["alarm", "list", *there]) == 0
    assert how not in capsys.readouterr().out
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", *there]) == 2
    assert capsys.readouterr().err == f"driveby: {history}: no alarm of bridge-2 stands\n"
    assert cli.main(["alarm", "ack", "bridge-2", *there]) == 2
    assert "--by NAME" in capsys.readouterr().err
    assert cli.main(["alarm", "check", "bridge-2", *there]) == 2
    assert cli.main(["history", "bridge-2", "--figures", str(tmp_path / "f"), *there]) == 0
    assert "props; element 4 is" in capsys.readouterr().out


def test_what_was_noted_while_nobody_told_is_told_at_the_start(history: Path) -> None:
    """Who heard the alarm stand shows it until it hears that somebody took note of it."""
    (alarm,) = check(history, Settings(), AFTER_S).standing
    acknowledge(history, alarm, "owner", "", AFTER_S)
    told: list[tuple[str, bool]] = []

    def put(alarm: Alarm, payload: bytes) -> None:
        told.append((alarm.bridge, alarm.acknowledged is not None))

    month_s = 30 * 86_400.0
    Teller(put).tell(history, round((AFTER_S + month_s - 60.0) * 1e9))
    assert told == [("bridge-2", True)]
    Teller(put).tell(history, round((AFTER_S + month_s + 60.0) * 1e9))
    assert told == [("bridge-2", True)]


def test_an_acknowledgement_that_is_damaged_can_be_given_again(
    history: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (alarm,) = check(history, Settings(), AFTER_S).standing
    damaged = history / f"alarms/realm=sim-fleet/bridge=bridge-2/{alarm.alarm_id}.ack.json"
    damaged.write_text("{")
    words = ["alarm", "ack", "bridge-2", "--by", "owner", "--history", str(history)]
    assert cli.main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{damaged}: not an acknowledgement: " in line
    assert line.endswith("; move that file away and acknowledge again")
    damaged.rename(damaged.with_suffix(".damaged"))
    assert cli.main(words) == 0
    assert standing(history) == ([], [])


@pytest.mark.parametrize(
    ("said", "line"),
    [
        (["--by", "x" * 201], "--by: String should have at most 200 characters"),
        (["--by", "owner", "--note", "x" * 1001], "--note: String should have at most 1000"),
        (["--by", "\n"], "--by: String should have at least 1 character"),
    ],
)
def test_what_is_too_long_to_be_said_gets_a_line(
    history: Path, capsys: pytest.CaptureFixture[str], said: list[str], line: str
) -> None:
    check(history, Settings(), AFTER_S)
    assert cli.main(["alarm", "ack", "bridge-2", *said, "--history", str(history)]) == 2
    assert capsys.readouterr().err.startswith(f"driveby: {line}")
    assert len(standing(history)[0]) == 1


def test_a_note_is_one_line_and_nothing_that_a_terminal_obeys(
    history: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check(history, Settings(), AFTER_S)
    words = ["alarm", "ack", "bridge-2", "--by", "an\nowner", "--note", "one\x1b[2J\ntwo"]
    assert cli.main([*words, "--history", str(history)]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "acknowledged by an owner on" in line
    assert "one\\x1b[2J two; element 4" in line


def test_an_alarm_in_another_place_than_its_own_gets_a_line(history: Path) -> None:
    (alarm,) = check(history, Settings(), AFTER_S).standing
    path = history / f"alarms/realm=sim-fleet/bridge=bridge-2/{alarm.alarm_id}.json"
    copy = path.with_name("copy.json")
    copy.write_bytes(path.read_bytes())
    elsewhere = history / f"alarms/realm=live/bridge=bridge-2/{alarm.alarm_id}.json"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.write_bytes(path.read_bytes())
    found, problems = standing(history)
    assert found == [alarm]
    for wrong in (copy, elsewhere):
        said = f"{wrong}: is alarm {alarm.alarm_id} of bridge-2 in realm sim-fleet, which"
        assert any(line.startswith(said) for line in problems)


def test_an_alarm_stands_though_its_crossings_are_gone(
    history: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check(history, Settings(), AFTER_S)
    (history / "crossings").unlink()
    there = ["--history", str(history)]
    assert cli.main(["alarm", "list", *there]) == 0
    assert "of bridge-2, raised" in capsys.readouterr().out
    assert cli.main(["alarm", "check", "--all", *there]) == 0
    assert "stands; element 4" in capsys.readouterr().out
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", *there]) == 0
    assert standing(history) == ([], [])
