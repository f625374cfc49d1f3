"""Kernels where their machine code cannot be stored, or stored code not be read."""

import errno
import pickle
from pathlib import Path

import numba
import pytest
from numba.core import caching, config

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


def test_kernel_stored_by_another_version_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))

    def predecessor(number: int) -> int:
        return number - 1

    def stored() -> list[Path]:
        return list(tmp_path.rglob("*predecessor*.nbi"))

    assert lanes.compiled()(predecessor)(2) == 1
    (index,) = stored()
    whole = index.read_bytes()
    gone = b"cpre_core.physics.tandem\nNoSuchTruck\n."  # a class that this version does not have
    for damaged in (pickle.dumps(numba.__version__) + gone, whole[:-5]):
        index.write_bytes(damaged)
        assert lanes.compiled()(predecessor)(3) == 2
        assert len(index.read_bytes()) == len(whole)
