"""Several recordings as one drive."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.signals import GnssFix, VehicleInfo, encode_gnss, encode_info
from schemas.topics import Key, Message
from services.common.errors import InputError
from services.recordings import merge
from services.recordings.merge import read_together, recordings_in
from services.recordings.writer import write_recording

S = 1_000_000_000
START_NS = 1_700_000_000 * S


def fix(sequence: int, time_s: float, vehicle: str = "truck-1", realm: str = "live") -> Message:
    time_ns = START_NS + round(time_s * S)
    payload = encode_gnss(GnssFix(1, sequence, sequence, time_ns, 50.0, 8.0, 100.0, 10.0))
    return Message(Key(realm, "vehicle", vehicle, "gnss"), payload, 1, sequence, time_ns, time_ns)


def info(time_s: float) -> Message:
    time_ns = START_NS + round(time_s * S)
    payload = encode_info(VehicleInfo(1, 0, 0, time_ns, "truck-1", ""))
    return Message(Key("live", "vehicle", "truck-1", "info"), payload, 1, 0, time_ns, time_ns)


def written(path: Path, *messages: Message) -> tuple[int, Path]:
    write_recording(path, messages, site_toml=None, reason="test")
    moving = [m.log_time_ns for m in messages if m.key.stream != "info"]
    return min(moving), path


def read(*files: tuple[int, Path]) -> list[tuple[str, str, int]]:
    return [(m.key.identifier, m.key.stream, m.sequence) for _, m in read_together(files)]


def test_two_trucks_are_one_drive_in_the_order_of_time(tmp_path: Path) -> None:
    one = written(tmp_path / "a.mcap", *(fix(n, n) for n in range(3)))
    two = written(tmp_path / "b.mcap", *(fix(n, n + 0.5, "truck-2") for n in range(3)))
    in_order = [(truck, "gnss", n) for n in range(3) for truck in ("truck-1", "truck-2")]
    assert read(one, two) == read(two, one) == in_order


def test_a_file_that_goes_on_repeats_what_is_latched_and_it_comes_once(tmp_path: Path) -> None:
    one = written(tmp_path / "a.mcap", info(-50), fix(0, 0), fix(1, 1))
    two = written(tmp_path / "b.mcap", info(-50), fix(1, 1), fix(2, 2))
    names = [("info", 0), ("gnss", 0), ("gnss", 1), ("gnss", 2)]
    assert [name[1:] for name in read(two, one)] == names


def test_the_copy_that_was_made_of_a_replay_adds_nothing(tmp_path: Path) -> None:
    one = written(tmp_path / "a.mcap", fix(0, 0), fix(1, 1))
    copy = written(tmp_path / "b.mcap", *(fix(n, n, realm="replay-a") for n in range(2)))
    assert len(read(one, copy)) == 2


def test_a_file_keeps_its_order_and_what_came_late_has_no_turn_of_its_own(tmp_path: Path) -> None:
    one = written(tmp_path / "a.mcap", fix(0, 0), fix(2, 2), fix(1, 1), fix(3, 3))
    two = written(tmp_path / "b.mcap", fix(0, 1.5, "truck-2"), fix(1, 2.5, "truck-2"))
    assert [n for truck, _, n in read(one, two) if truck == "truck-1"] == [0, 2, 1, 3]
    due = [(timed.due_ns - START_NS) / S for timed in read_together([one, two])]
    assert due == sorted(due) == [0.0, 1.5, 2.0, 2.0, 2.5, 3.0]


def test_a_file_is_opened_when_its_time_has_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [
        written(tmp_path / f"{n}.mcap", fix(2 * n, 10 * n), fix(2 * n + 1, 10 * n + 1))
        for n in range(5)
    ]
    opened: list[Path] = []
    is_read = merge.read_messages

    def reading(path: Path) -> Iterator[Message]:
        opened.append(path)
        return is_read(path)

    monkeypatch.setattr(merge, "read_messages", reading)
    messages = read_together(files)
    for _ in range(2):
        next(messages)
    assert len(opened) == 1
    assert len(list(messages)) == 8
    assert opened == [path for _, path in files]


def test_of_a_folder_all_recordings_below_are_taken(tmp_path: Path) -> None:
    for name in ("b/2.mcap", "a/1.mcap", "a/.hidden.mcap", "a/notes.txt"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    one, two = tmp_path / "a/1.mcap", tmp_path / "b/2.mcap"
    assert recordings_in([tmp_path]) == [one, two]
    assert recordings_in([two, tmp_path, one]) == [two, one]
    (tmp_path / "c").mkdir()
    with pytest.raises(InputError, match="c: holds no recording"):
        recordings_in([tmp_path / "c"])
