"""Alarms of a history: raised, kept over restarts, told, acknowledged by somebody only."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
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
from tests.fleet import WEEK_S, bridge_of, crossing_of, results_of, templates, trucks_of

BEGIN_S = datetime(2025, 1, 6, tzinfo=UTC).timestamp()  # a Monday
WEEKS = 24
LOSES_AT = 14
AFTER_S = BEGIN_S + WEEKS * WEEK_S


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One bridge that is sound, one that loses a fifth of element 4 in week 14."""
    folder = tmp_path_factory.mktemp("history")
    rng = np.random.default_rng(2)
    trucks, kinds, some = trucks_of(rng, 2), templates(), []
    for name in ("bridge-1", "bridge-2"):
        bridge = bridge_of(rng, name)
        for week in range(WEEKS):
            ei = bridge.ei_nm2.copy()
            ei[3] *= 0.8 if week >= LOSES_AT and name == "bridge-2" else 1.0
            for day in (1, 4):
                entry_s = BEGIN_S + week * WEEK_S + day * 86_400.0
                truck, kind = trucks[int(rng.integers(2))], kinds[int(rng.integers(3))]
                some.append(crossing_of(rng, kind, truck, bridge, entry_s, ei))
    temperatures = {one.crossing_id: 10.0 for one in some}
    add_results(folder, results_of(some, AFTER_S), temperatures)
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
    assert said.startswith("2 bridges looked at, 1 new alarms\nalarm 2025")
    assert "-4-weaker of bridge-2, raised 2025-" in said
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", "--note", "props", *there]) == 0
    assert "acknowledged by owner on" in capsys.readouterr().out
    assert cli.main(["alarm", "ack", "bridge-2", "--by", "owner", *there]) == 2
    assert capsys.readouterr().err == f"driveby: {history}: no alarm of bridge-2 stands\n"
    assert cli.main(["alarm", "ack", "bridge-2", *there]) == 2
    assert "--by NAME" in capsys.readouterr().err
    assert cli.main(["alarm", "check", "bridge-2", *there]) == 2
    assert cli.main(["history", "bridge-2", "--figures", str(tmp_path / "f"), *there]) == 0
    assert "props; element 4 is" in capsys.readouterr().out
