"""The spool: what survives kills and cuts, what is freed, what is given up and counted."""

import os
import signal
import subprocess
import sys
import threading
import time
import zlib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.spool import SpoolBoot
from services.common.errors import InputError
from services.truck.spool import Spool

MIB = 1 << 20


def payload(sequence: int, size: int = 100) -> bytes:
    return sequence.to_bytes(4, "big") * (size // 4)


def fill(spool: Spool, first: int, last: int, stream: str = "accel", size: int = 100) -> None:
    for sequence in range(first, last + 1):
        spool.append(stream, sequence, payload(sequence, size))


def used_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*.spool"))


def sequences(spool: Spool, boot_id: int, stream: str = "accel") -> list[int]:
    found: list[int] = []
    next_sequence: int | None = 0
    while next_sequence is not None:
        page = spool.read(stream, boot_id, next_sequence, 10**6)
        found += [message.sequence for message in page.messages]
        next_sequence = page.next_sequence
    return found


def test_what_was_appended_is_read_again_in_pages(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    fill(spool, 0, 49)
    fill(spool, 0, 9, "gnss")
    page = spool.read("accel", spool.boot_id, 5, 40, max_messages=10)
    assert [m.sequence for m in page.messages] == list(range(5, 15))
    assert [m.payload for m in page.messages] == [payload(n) for n in range(5, 15)]
    assert page.next_sequence == 15
    page = spool.read("accel", spool.boot_id, 15, 40, max_bytes=350)
    assert ([m.sequence for m in page.messages], page.next_sequence) == ([15, 16, 17], 18)
    assert sequences(spool, spool.boot_id) == list(range(50))
    assert spool.read("accel", spool.boot_id + 1, 0, 9) == ([], None)
    assert spool.read("info", spool.boot_id, 0, 9) == ([], None)
    assert spool.contents("gnss") == [SpoolBoot(spool.boot_id, 10, [(0, 9)], -1, 0)]
    assert spool.streams() == ["accel", "gnss"]
    spool.close()


def test_a_message_larger_than_a_page_is_given_alone(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    fill(spool, 0, 2, size=1000)
    page = spool.read("accel", spool.boot_id, 0, 2, max_bytes=100)
    assert ([m.sequence for m in page.messages], page.next_sequence) == ([0], 1)
    spool.close()


def test_boots_follow_each_other_also_when_the_clock_went_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path)
    first = spool.boot_id
    fill(spool, 0, 9)
    spool.close()
    monkeypatch.setattr(time, "time_ns", lambda: first - 3_600_000_000_000)
    spool = Spool(tmp_path)
    assert spool.boot_id == first + 1
    fill(spool, 0, 4)
    assert sequences(spool, first) == list(range(10))
    spool.close()
    Spool(tmp_path).close()
    spool = Spool(tmp_path)
    assert [boot.boot_id for boot in spool.contents("accel")] == [first, first + 1]
    spool.confirm({("accel", first): 9, ("accel", first + 1): 4})
    spool.close()
    spool = Spool(tmp_path)
    assert spool.streams() == []
    assert spool.boot_id > first + 1
    spool.close()


@pytest.mark.process
def test_what_was_appended_survives_kill_9(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from services.truck.spool import Spool\n"
        "spool = Spool(Path(sys.argv[1])); number = 0\n"
        "while True:\n"
        "    spool.append('accel', number, number.to_bytes(4, 'big') * 400)\n"
        "    number += 1; print(number, flush=True)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    while (output := int(process.stdout.readline())) < 3000:
        pass
    os.kill(process.pid, signal.SIGKILL)
    rest, _ = process.communicate()
    output = max([output, *(int(line) for line in rest.split("\n")[:-1])])
    spool = Spool(tmp_path)
    [boot] = spool.contents("accel")
    assert boot.next_sequence in (output, output + 1)
    assert boot.held == [(0, boot.next_sequence - 1)]
    assert sequences(spool, boot.boot_id) == list(range(boot.next_sequence))
    spool.close()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 2700))
def test_a_torn_end_is_cut_off(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    folder = tmp_path_factory.mktemp("spool")
    spool = Spool(folder)
    boot = spool.boot_id
    fill(spool, 0, 19)
    spool.close()
    [segment] = folder.glob("*.spool")
    whole = segment.read_bytes()
    record = (len(whole) - 20) // 20
    segment.write_bytes(whole[:cut])
    spool = Spool(folder)
    complete = max(0, min(cut, len(whole)) - 20) // record
    assert sequences(spool, boot) == list(range(complete))
    kept = 20 + complete * record if complete else 0
    assert sum(path.stat().st_size for path in folder.glob("*.spool")) == kept
    fill(spool, 0, 3)
    assert sequences(spool, spool.boot_id) == [0, 1, 2, 3]
    spool.close()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 2600), bit=st.integers(0, 7))
def test_a_flipped_bit_costs_its_record_and_never_gives_wrong_bytes(
    tmp_path_factory: pytest.TempPathFactory, at: int, bit: int
) -> None:
    folder = tmp_path_factory.mktemp("spool")
    spool = Spool(folder)
    boot = spool.boot_id
    fill(spool, 0, 19)
    spool.close()
    [segment] = folder.glob("*.spool")
    content = bytearray(segment.read_bytes())
    content[at % len(content)] ^= 1 << bit
    segment.write_bytes(content)
    spool = Spool(folder)
    messages = spool.read("accel", boot, 0, 100).messages
    assert all(message.payload == payload(message.sequence) for message in messages)
    record = (len(content) - 20) // 20
    hit = (at % len(content) - 20) // record
    if at % len(content) >= 20 and not 4 <= (at % len(content) - 20) % record < 8:
        assert [m.sequence for m in messages] == [n for n in range(20) if n != hit]
    else:  # the header, or a length: what stands behind cannot be found
        assert [m.sequence for m in messages][: max(0, hit)] == list(range(max(0, hit)))
    spool.close()


@pytest.mark.parametrize("length", [0, 4, 8])
def test_a_record_shorter_than_its_own_head_is_no_record(tmp_path: Path, length: int) -> None:
    """Its checksum may be right: what it would be read from are bytes that it does not cover."""
    spool = Spool(tmp_path)
    boot = spool.boot_id
    fill(spool, 0, 2)
    spool.close()
    [segment] = tmp_path.glob("*.spool")
    whole = segment.read_bytes()
    last = bytearray(whole[20 : 20 + (len(whole) - 20) // 3])
    last[4:8] = length.to_bytes(4, "big")
    last[0:4] = zlib.crc32(last[4 : 8 + length]).to_bytes(4, "big")
    segment.write_bytes(whole + last)
    spool = Spool(tmp_path)
    assert sequences(spool, boot) == [0, 1, 2]
    assert spool.discarded_bytes == len(last)
    assert segment.read_bytes() == whole
    spool.close()


def test_what_a_logger_has_is_freed(tmp_path: Path) -> None:
    spool = Spool(tmp_path, budget_bytes=MIB)
    boot = spool.boot_id
    fill(spool, 0, 299, size=1000)
    fill(spool, 0, 9, "gnss", size=1000)
    before = used_bytes(tmp_path)
    spool.confirm({("accel", boot): 199})
    assert used_bytes(tmp_path) < before
    [held] = spool.contents("accel")
    assert held.durable == 199
    assert held.next_sequence == 300
    [(first, last)] = held.held
    assert 100 < first <= 200
    assert last == 299
    # Segments in which another stream is not durable yet stay.
    spool.confirm({("accel", boot): 299})
    assert spool.contents("gnss") == [SpoolBoot(boot, 10, [(0, 9)], -1, 0)]
    spool.close()
    spool = Spool(tmp_path, budget_bytes=MIB)
    [held] = spool.contents("accel")
    assert held.boot_id == boot
    assert held.durable >= 199
    spool.confirm({("accel", boot): 299, ("gnss", boot): 9})
    assert list(tmp_path.glob("*.spool")) == []
    assert spool.contents("accel") == spool.contents("gnss") == []
    assert spool.dropped() == 0
    assert spool.boot_id > boot
    spool.close()


def test_over_budget_the_oldest_goes_and_is_counted(tmp_path: Path) -> None:
    spool = Spool(tmp_path, budget_bytes=MIB)
    boot = spool.boot_id
    fill(spool, 0, 99, size=1000)
    spool.confirm({("accel", boot): 49})
    for first in range(100, 3000, 100):
        fill(spool, first, first + 99, size=1000)
        spool.sync()
        assert used_bytes(tmp_path) <= MIB + 200_000
    [held] = spool.contents("accel")
    [(first, last)] = held.held
    assert last == 2999
    assert held.dropped == spool.dropped() == first - 50
    spool.close()
    again = Spool(tmp_path, budget_bytes=MIB)
    assert again.contents("accel") == [held]
    # A logger that has written down the loss goes on behind it.
    again.confirm({("accel", boot): 2999})
    assert again.contents("accel") == []
    again.close()


def test_a_full_disk_leaves_the_spool_usable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path)
    fill(spool, 0, 4)
    real = os.write

    def short(file: int, data: bytes) -> int:
        return real(file, data[: len(data) // 2])

    monkeypatch.setattr(os, "write", short)
    with pytest.raises(OSError, match="No space"):
        spool.append("accel", 5, payload(5))
    monkeypatch.setattr(os, "write", real)
    fill(spool, 6, 9)
    assert spool.contents("accel") == [SpoolBoot(spool.boot_id, 10, [(0, 4), (6, 9)], -1, 0)]
    assert sequences(spool, spool.boot_id) == [0, 1, 2, 3, 4, 6, 7, 8, 9]
    spool.close()


def test_an_unreadable_state_only_offers_again(tmp_path: Path) -> None:
    spool = Spool(tmp_path, budget_bytes=MIB)
    boot = spool.boot_id
    fill(spool, 0, 299, size=1000)
    spool.confirm({("accel", boot): 199})
    spool.close()
    (tmp_path / "state.json").write_text("{")
    spool = Spool(tmp_path, budget_bytes=MIB)
    [held] = spool.contents("accel")
    assert (held.durable, held.held[-1][1]) == (-1, 299)
    spool.close()


def test_one_process_at_a_time(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    with pytest.raises(InputError, match="another truck uses this spool"):
        Spool(tmp_path)
    spool.close()
    Spool(tmp_path).close()


def test_bad_folders_and_budgets_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least 1 MiB"):
        Spool(tmp_path, budget_bytes=1000)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be created"):
        Spool(tmp_path / "file" / "spool")


def test_reading_while_appending(tmp_path: Path) -> None:
    spool = Spool(tmp_path, budget_bytes=MIB)
    stop = threading.Event()

    def sync() -> None:
        while not stop.wait(0.001):
            spool.sync()

    thread = threading.Thread(target=sync)
    thread.start()
    for number in range(600):
        spool.append("accel", number, payload(number, 1000))
        if number % 50 == 49:
            assert sequences(spool, spool.boot_id) == list(range(number + 1))
    stop.set()
    thread.join()
    spool.close()
