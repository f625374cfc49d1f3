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

from tests.benchmarks import recordings

MINUTES = (10, 60)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for minutes in MINUTES:
            path = folder / f"{minutes}.mcap"
            messages = recordings.drive()[: minutes * 60 * 30]
            recordings.write(path, messages)
            del messages
            command = [sys.executable, "-m", "tests.benchmarks.view", str(path)]
            subprocess.run(command, check=True)


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
