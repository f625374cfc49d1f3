"""What `driveby view` does before its window opens: python -m tests.benchmarks.view

Of ten minutes and of an hour of one truck, four channels of 1000 Hz and 10 fixes a second: seconds
and the most memory, of a process of its own, until the Rerun file is there.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from schemas.signals import CHANNELS, AccelBatch, AccelChannel, GnssFix, encode_accel, encode_gnss
from schemas.topics import Key, Message
from tests.benchmarks import recordings

MINUTES = (10, 60)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for minutes in MINUTES:
            path = folder / f"{minutes}.mcap"
            recordings.write(path, drive(minutes))
            command = [sys.executable, "-m", "tests.benchmarks.view", str(path)]
            subprocess.run(command, check=True)


def drive(minutes: int) -> list[Message]:
    """A drive of which every message is another one, as the trucks' are."""
    rng = np.random.default_rng(1)
    accel, gnss = (Key("live", "vehicle", "truck-1", name) for name in ("accel", "gnss"))
    messages = []
    for n in range(1, minutes * 1200 + 1):
        device_ns = n * 50_000_000
        time_ns = recordings.NOW_NS + device_ns
        channels = {name: AccelChannel(1000.0, rng.standard_normal(50)) for name in CHANNELS}
        batch = encode_accel(AccelBatch(1, n, device_ns, time_ns, channels))
        messages.append(Message(accel, batch, 1, n, time_ns, time_ns))
        if n % 2 == 0:
            fix = GnssFix(1, n // 2, device_ns, time_ns, 50.0 + 5e-6 * n, 8.0, 100.0, 10.0)
            messages.append(Message(gnss, encode_gnss(fix), 1, n // 2, time_ns, time_ns))
    return messages


def measure(path: Path) -> None:
    from services.viewer.view import convert

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began, used = time.perf_counter(), time.process_time()
    rrd = path.with_suffix(".rrd")
    convert(path, rrd)
    seconds, processor = time.perf_counter() - began, time.process_time() - used
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"{path.stem} minutes, {path.stat().st_size / 1e6:.0f} MB: {seconds:.1f} s "
        f"({processor:.1f} s of the processor), {most / 1e6:.2f} GB at most "
        f"({before / 1e6:.2f} GB before), {rrd.stat().st_size / 1e6:.0f} MB written",
        flush=True,
    )


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if len(sys.argv) > 1:
        measure(Path(sys.argv[1]))
    else:
        main()
