"""What a burst needed does not stay."""

import ctypes
import subprocess
import sys

import pytest

PROGRAM = """
from pathlib import Path
from services.logger.memory import give_back_memory

def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

before = resident_mb()
burst = [bytes(5000) for _ in range(20_000)]
kept = burst[::50]
del burst
high = resident_mb()
give_back_memory()
print(before, high, resident_mb())
"""


@pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="only glibc gives memory back when asked"
)
def test_free_memory_is_given_back() -> None:
    outcome = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    ).stdout
    before, high, after = map(float, outcome.split())
    assert high > before + 80.0
    assert after < before + 20.0
