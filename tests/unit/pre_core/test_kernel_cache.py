"""Kernels where their machine code cannot be stored."""

import errno

import pytest
from numba.core import caching

from pre_core.kernels import lanes


def test_kernel_that_cannot_be_stored_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def successor(number: int) -> int:
        return number + 1

    monkeypatch.setattr(caching.IndexDataCacheFile, "save", full)
    with pytest.warns(RuntimeWarning, match="No space left on device"):
        assert lanes.compiled()(successor)(1) == 2
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])
    with pytest.warns(RuntimeWarning, match="no folder"):
        assert lanes.compiled(error_model="numpy")(successor)(1) == 2
