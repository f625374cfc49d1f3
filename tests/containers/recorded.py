"""What a logger has recorded of a truck, in a copy of its folder."""

from pathlib import Path
from typing import NamedTuple

from schemas.topics import Key
from services.recordings.recording import read_messages


class Drive(NamedTuple):
    """One start of a truck, as the logger has recorded it."""

    begin_s: float
    end_s: float
    fixes: int


def numbers_of(folder: Path, vehicle: str = "truck-1") -> dict[tuple[Key, int], list[int]]:
    """Return the sequence numbers by key and boot, but for those of `info`."""
    found: dict[tuple[Key, int], list[int]] = {}
    for path in folder.rglob(f"*{vehicle}*.mcap"):
        for message in read_messages(path):
            if message.key.owner == "vehicle" and message.key.stream != "info":
                found.setdefault((message.key, message.boot_id), []).append(message.sequence)
    return found


def drives_of(folder: Path, vehicle: str = "truck-1") -> dict[int, Drive]:
    """Return the drives by boot."""
    times: dict[int, list[int]] = {}
    for path in folder.rglob(f"*{vehicle}*.mcap"):
        for message in read_messages(path):
            if message.key.stream == "gnss":
                times.setdefault(message.boot_id, []).append(message.log_time_ns)
    return {
        boot: Drive(min(found) * 1e-9, max(found) * 1e-9, len(found))
        for boot, found in times.items()
    }


def check_complete(folder: Path, vehicle: str = "truck-1") -> None:
    """Check that no message is missing and none is there twice."""
    numbers = numbers_of(folder, vehicle)
    assert numbers
    for name, found in numbers.items():
        assert sorted(found) == list(range(len(found))), (name, len(found))
