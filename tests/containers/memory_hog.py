"""Fills the memory of its container until the kernel ends the process that it was given.

    python memory_hog.py PID

The kernel would end the largest process, which is this one: the other's own score is raised, which
needs no privilege.
"""

import sys
from pathlib import Path

STEP_BYTES = 4 << 20


def main(pid: str) -> None:
    process = Path("/proc") / pid
    (process / "oom_score_adj").write_text("1000")
    filled = []
    while process.exists():
        filled.append(bytearray(b"\1") * STEP_BYTES)


if __name__ == "__main__":
    main(sys.argv[1])
