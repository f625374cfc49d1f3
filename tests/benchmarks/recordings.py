"""Times of what the logger does with files: python -m tests.benchmarks.recordings

One hour of one truck: 20 batches of 4 × 50 random samples and 10 fixes a second, a chunk every
half second, and as it would be if it took an hour, a list of what is in it every minute.
"""

import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from schemas.signals import (
    CHANNELS,
    AccelBatch,
    AccelChannel,
    GnssFix,
    encode_accel,
    encode_gnss,
)
from schemas.topics import Key, Message
from services.recordings.recording import read_identities, read_messages
from services.recordings.recovery import describe, recover_recording
from services.recordings.writer import RecordingOrigin, RecordingWriter

HOUR_BATCHES = 3600 * 20
NOW_NS = 1_700_000_000_000_000_000


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        measure(Path(folder))


def measure(folder: Path) -> None:
    messages = list(drive())
    whole, cut = folder / "whole.mcap", folder / "cut.mcap"
    began = time.process_time()
    write(whole, messages)
    say("write 1 h (processor time)", time.process_time() - began, len(messages))
    print(f"size of 1 h: {whole.stat().st_size / 1e6:.0f} MB")
    cut.write_bytes(whole.read_bytes()[: int(0.9 * whole.stat().st_size)])
    began = time.perf_counter()
    read_identities(whole)
    say("which messages are in it, closed", time.perf_counter() - began, len(messages))
    began = time.perf_counter()
    number = sum(numbers.size for numbers in read_identities(cut).values())
    say("which messages are in it, cut off", time.perf_counter() - began, number)
    began = time.perf_counter()
    number = sum(1 for _ in read_messages(cut))
    say("read, cut off", time.perf_counter() - began, number)
    began = time.perf_counter()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    recovery = recover_recording(cut, folder / "r.mcap")
    more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3
    say("recover, cut off", time.perf_counter() - began, recovery.messages)
    print(f"  {describe(recovery)}; {more:.0f} MB more memory at most")


def drive() -> list[Message]:
    rng = np.random.default_rng(1)
    payloads = []
    for _ in range(50):
        channels = {name: AccelChannel(1000.0, rng.standard_normal(50)) for name in CHANNELS}
        payloads.append(encode_accel(AccelBatch(1, 0, 5, NOW_NS, channels)))
    fix = encode_gnss(GnssFix(1, 0, 0, NOW_NS, 50.0, 8.0, 100.0, 10.0))
    accel, gnss = (Key("live", "vehicle", "truck-1", name) for name in ("accel", "gnss"))
    messages = []
    for n in range(HOUR_BATCHES):
        time_ns = NOW_NS + n * 50_000_000
        messages.append(Message(accel, payloads[n % 50], 1, n, time_ns, time_ns))
        if n % 2 == 0:
            messages.append(Message(gnss, fix, 1, n // 2, time_ns, time_ns))
    return messages


def write(path: Path, messages: list[Message]) -> None:
    writer = RecordingWriter(path, reason="benchmark", origin=RecordingOrigin("live", "truck-1"))
    for n, message in enumerate(messages):
        writer.write(message)
        if n % 1800 == 1799:
            writer._next_identities_s = 0.0
        if n % 15 == 14:
            writer.sync()
    writer.finish("done")


def say(what: str, seconds: float, messages: int) -> None:
    print(f"{what}: {seconds * 1e3:,.0f} ms for {messages:,} messages")


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
