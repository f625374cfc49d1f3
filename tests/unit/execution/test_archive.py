"""An archive of recordings: the results of one drive, gone on with, whatever cannot be read."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from schemas.reasons import Reason
from schemas.results import Crossing
from schemas.settings import IdentificationSettings
from services.execution.archive import Archive, Asked, drives_of, identify_archive, is_failed
from services.execution.dispatch import failed
from services.execution.here import Here
from services.execution.kept import Kept
from services.execution.offline import identify_recordings, site_of
from services.identification.bridge_state import NOTHING_STORED, with_common_shares
from services.identification.crossing_data import CrossingData
from services.identification.identify import identify
from services.identification.outputs import Work
from services.recordings.recording import Message, read_messages
from services.recordings.writer import write_recording
from tests.drives import EXACT, drives

LEAST_SQUARES = IdentificationSettings(method="least_squares")


class Counting:
    """Identifies, and counts how often."""

    def __init__(self) -> None:
        self.ids: list[str] = []

    def __call__(
        self, data: CrossingData, settings: IdentificationSettings, **others: Any
    ) -> Crossing:
        self.ids.append(data.crossing_id)
        return identify(data, settings, **others)


def asked(*recordings: Path) -> Asked:
    return Asked(recordings, site_of([EXACT], None), LEAST_SQUARES, NOTHING_STORED, {})


def done(
    into: Path, *recordings: Path, identify: Callable[..., Crossing] = identify
) -> tuple[Archive, list[Crossing]]:
    crossings: list[Crossing] = []
    found = identify_archive(
        asked(*recordings), Here(identify=identify), Kept(into), crossings.append
    )
    return found, sorted(crossings, key=lambda one: one.entry_time)


def timeless(crossing: Crossing) -> Crossing:
    diagnostics = {k: v for k, v in crossing.diagnostics.items() if k != "seconds"}
    return crossing.model_copy(update={"diagnostics": diagnostics})


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Five crossings in three recordings, all minutes apart."""
    return drives(tmp_path_factory.mktemp("drives"), 5, each=2)


@pytest.fixture
def same(five: list[Path], tmp_path: Path) -> list[Path]:
    """The same to be damaged."""
    copies = [tmp_path / "recordings" / path.name for path in five]
    copies[0].parent.mkdir()
    for path, copy in zip(five, copies, strict=True):
        copy.write_bytes(path.read_bytes())
    return copies


def test_results_are_those_of_all_recordings_together(five: list[Path], tmp_path: Path) -> None:
    whole = identify_recordings(five, site_of(five, None), LEAST_SQUARES)
    found, crossings = done(tmp_path / "into", *five)
    told = with_common_shares(crossings, found.bridges)
    assert [timeless(one) for one in told] == [timeless(one) for one in whole.crossings]
    assert found.bridges == whole.bridges
    assert (found.verdicts.total(), found.there, found.failed, found.problems) == (5, 0, (), ())


def test_what_is_there_is_not_identified_again(five: list[Path], tmp_path: Path) -> None:
    counting = Counting()
    _, first = done(tmp_path / "into", *five[:2], identify=counting)
    assert len(counting.ids) == 4
    found, all_five = done(tmp_path / "into", *five, identify=counting)
    assert found.there == 4
    assert len(counting.ids) == len(set(counting.ids)) == 5
    assert all_five[:4] == first  # to the last bit, and with the seconds that they took then


def test_who_is_killed_in_between_goes_on(five: list[Path], tmp_path: Path) -> None:
    class KilledError(Exception):
        pass

    class Dying(Counting):
        def __call__(self, *arguments: Any, **others: Any) -> Crossing:
            if len(self.ids) == 3:
                raise KilledError
            return super().__call__(*arguments, **others)

    dying, counting = Dying(), Counting()
    with pytest.raises(KilledError):
        done(tmp_path / "into", *five, identify=dying)
    found, crossings = done(tmp_path / "into", *five, identify=counting)
    assert (found.there, len(crossings)) == (3, 5)
    assert sorted(dying.ids + counting.ids) == sorted(c.crossing_id for c in crossings)


def test_a_recording_by_two_names_gives_each_crossing_once(
    five: list[Path], tmp_path: Path
) -> None:
    again = tmp_path / "again.mcap"
    again.write_bytes(five[0].read_bytes())
    counting = Counting()
    found, _ = done(tmp_path / "into", *five, again, five[1], identify=counting)
    assert found.verdicts.total() == len(counting.ids) == 5


def test_what_cannot_be_read_is_a_line_and_costs_itself_only(
    same: list[Path], tmp_path: Path
) -> None:
    gone, empty, other = (tmp_path / name for name in ("gone.mcap", "empty.mcap", "other.mcap"))
    empty.touch()
    other.write_bytes(b"no recording at all")
    found, crossings = done(tmp_path / "into", gone, same[0], empty, *same[1:], other)
    assert len(crossings) == 5
    assert sorted(line.split(": ")[0] for line in found.problems) == sorted(
        str(path) for path in (gone, empty, other)
    )
    assert any(line == f"{gone}: no such file" for line in found.problems)


def test_a_message_that_is_none_is_left_out_with_a_line(same: list[Path], tmp_path: Path) -> None:
    """Before the truck comes to the bridge: the crossing has all that it needs."""
    messages = list(read_messages(same[2]))
    number = next(n for n, m in enumerate(messages) if m.key.stream == "accel")
    messages[number] = messages[number]._replace(payload=b"\xff" * 30)
    wrong = tmp_path / "wrong.mcap"
    write_recording(wrong, messages, reason="test", site_toml=None)
    found, crossings = done(tmp_path / "into", *same[:2], wrong)
    assert len(crossings) == 5
    (line,) = found.problems
    assert line.startswith(f"{wrong}: 1 message is left out, first accel 0: ")


def test_a_recording_without_a_stream_is_a_line(same: list[Path], tmp_path: Path) -> None:
    def without(stream: str) -> list[Message]:
        return [m for m in read_messages(same[0]) if m.key.stream != stream]

    mute = tmp_path / "mute.mcap"
    write_recording(mute, without("accel"), reason="test", site_toml=None)
    found, crossings = done(tmp_path / "into", mute, *same[1:])
    assert len(crossings) == 3
    (line,) = found.problems
    assert line.startswith(f"{mute}: no accelerations")


def test_what_failed_is_told_and_tried_again(five: list[Path], tmp_path: Path) -> None:
    def failing(data: CrossingData, settings: IdentificationSettings, **others: Any) -> Crossing:
        if "T001003" in data.crossing_id:
            return failed(Work(0, data, settings))
        return identify(data, settings, **others)

    found, crossings = done(tmp_path / "into", *five, identify=failing)
    (name,) = found.failed
    assert "T001003" in name
    assert [c.crossing_id for c in crossings if is_failed(c)] == [name]
    assert found.verdicts["rejected"] == 1
    found, crossings = done(tmp_path / "into", *five)
    assert (found.there, found.failed) == (4, ())
    assert all(Reason.FAILED not in one.reasons for one in crossings)


def test_recordings_that_follow_each_other_are_one_drive(tmp_path: Path) -> None:
    """Ten minutes from one to the next: each is a drive, but where one lasts into another."""
    paths = drives(tmp_path, 6)
    longer = tmp_path / "longer.mcap"
    write_recording(
        longer,
        [*read_messages(paths[1]), *read_messages(paths[2]), *read_messages(paths[3])],
        reason="test",
        site_toml=None,
    )
    problems: list[str] = []
    found = [set(drive) for drive in drives_of([longer, *reversed(paths)], problems)]
    assert found == [{paths[0]}, {longer, *paths[1:4]}, {paths[4]}, {paths[5]}]
    assert problems == []
