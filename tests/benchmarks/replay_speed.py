"""How much faster than real `driveby replay --speed 0` is: python -m tests.benchmarks.replay_speed

Ten minutes of one truck (20 batches of 4 × 50 random samples and 10 fixes a second), replayed by
the command itself to a logger on loopback, until the logger has everything on disk. The start of
the command and its look at every message before are in the time.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from schemas.signals import CHANNELS, AccelBatch, AccelChannel, GnssFix, encode_accel, encode_gnss
from schemas.topics import Key, Message
from services.recordings.recording import read_info
from services.recordings.writer import write_recording
from tests.endpoints import free_endpoint

MINUTES = 10
RUNS = 3


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, endpoint = folder / "drive.mcap", free_endpoint()
        messages = list(drive())
        write_recording(source, messages, site_toml=None, reason="benchmark")
        listen = ("--listen", endpoint, "--folder", str(folder), "--realm", "*")
        logger = subprocess.Popen(
            [sys.executable, "-m", "services", "logger", *listen],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        try:
            assert logger.stdout is not None
            logger.stdout.readline()
            for run in range(RUNS):
                options = ("--endpoint", endpoint, "--speed", "0", "--name", f"r{run}")
                began = time.perf_counter()
                done = subprocess.run(
                    [sys.executable, "-m", "services", "replay", str(source), *options],
                    capture_output=True,
                    text=True,
                    check=True,
                )
                took_s = time.perf_counter() - began
                print(
                    f"{MINUTES} min, {len(messages)} messages: {took_s:.2f} s, "
                    f"{MINUTES * 60 / took_s:.0f} times real speed; of that publishing: "
                    + done.stdout.splitlines()[1]
                )
        finally:
            logger.terminate()
            logger.wait()
        logged = [read_info(path) for path in folder.glob("replay-r*/*/*.mcap")]
        print(f"on disk: {[sum(info.messages.values()) for info in logged]}")


def drive() -> Iterator[Message]:
    rng = np.random.default_rng(1)
    accel, gnss = (Key("live", "vehicle", "truck-1", name) for name in ("accel", "gnss"))
    for n in range(MINUTES * 60 * 20):
        device_ns = n * 50_000_000
        time_ns = 1_700_000_000_000_000_000 + device_ns
        channels = {name: AccelChannel(1000.0, rng.standard_normal(50)) for name in CHANNELS}
        batch = encode_accel(AccelBatch(1, n, device_ns, time_ns, channels))
        yield Message(accel, batch, 1, n, time_ns, time_ns)
        if n % 2 == 0:
            fix = encode_gnss(GnssFix(1, n // 2, device_ns, time_ns, 50.0, 8.0, 100.0, 10.0))
            yield Message(gnss, fix, 1, n // 2, time_ns, time_ns)


if __name__ == "__main__":
    main()
