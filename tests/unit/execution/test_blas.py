"""Whoever calls us from a notebook has not set OPENBLAS_NUM_THREADS, and need not."""

import subprocess
import sys
from pathlib import Path

from threadpoolctl import threadpool_info, threadpool_limits

from schemas.settings import IdentificationSettings
from services.execution.offline import site_of
from tests.identifications import identify_recordings


def blas_threads() -> list[int]:
    return [lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"]


def test_an_identification_computes_with_one_thread_of_blas(project: Path) -> None:
    sample = [project / "recordings" / "sample" / "crossing.mcap"]
    settings = IdentificationSettings(method="least_squares", starts=1)
    inside: list[int] = []
    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        assert 2 in before
        identify_recordings(
            sample, site_of(sample, None), settings, lambda *outcome: inside.extend(blas_threads())
        )
        assert set(inside) == {1}
        # numpy and scipy bring one each, and both have what they had.
        assert set(blas_threads()) == set(before) == {2}


def test_tests_compute_with_one_thread_of_blas_as_the_commands_do(project: Path) -> None:
    """A module that imports numpy at the top of conftest.py would come before the limit."""
    code = "import sys, tests.conftest; print('numpy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=project
    )
    assert done.stdout == "False\n"
