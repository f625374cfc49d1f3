"""Kernels where their machine code cannot be stored."""

import errno
import logging
import threading

import pytest
from numba.core import caching

from pre_core.kernels import lanes


def test_kernel_that_cannot_be_stored_runs(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def successor(number: int) -> int:
        return number + 1

    monkeypatch.setattr(lanes, "_WARNED", threading.Event())
    monkeypatch.setattr(caching.IndexDataCacheFile, "save", full)
    with caplog.at_level(logging.WARNING):
        assert lanes.compiled()(successor)(1) == 2
        monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])
        assert lanes.compiled(error_model="numpy")(successor)(1) == 2
    (warning,) = caplog.records
    assert "No space left on device" in warning.getMessage()
