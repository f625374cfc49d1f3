"""A recorded crossing through the engine gives what it gave when the reference was made.

Where a change of the result is meant: `.venv/bin/python tests/data/make_reference_estimate.py`.
"""

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest


@pytest.fixture(scope="module")
def maker(project: Path) -> ModuleType:
    path = project / "tests" / "data" / "make_reference_estimate.py"
    spec = importlib.util.spec_from_file_location("make_reference_estimate", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    if isinstance(value, dict):
        items = [(str(key), inner) for key, inner in value.items()]
    elif isinstance(value, list):
        items = [(str(key), inner) for key, inner in enumerate(value)]
    else:
        return {name: value}
    return {k: v for key, inner in items for k, v in leaves(inner, f"{name}.{key}").items()}


def test_the_sample_gives_the_reference(maker: ModuleType) -> None:
    expected = leaves(json.loads(maker.REFERENCE.read_text()))
    found = leaves(maker.estimate())
    assert found.keys() == expected.keys()
    moved = {}
    for name, value in found.items():
        if isinstance(value, float):
            # Heights of the road are around zero: what counts is their size, millimetres. Seconds
            # since 1970 carry a quarter of a microsecond.
            size = 1e-3 if name.startswith(".road_") else abs(expected[name])
            size = 10.0 if name.endswith("_time") else size
            same = abs(value - expected[name]) <= 1e-7 * size
        else:
            same = value == expected[name]
        if not same:
            moved[name] = (value, expected[name])
    assert moved == {}


def test_the_sample_is_small_and_good(maker: ModuleType) -> None:
    assert maker.SAMPLE.stat().st_size < 2_000_000
    found = maker.estimate()["parameters"]
    ratios = [found[f"EI_{n}"] / 1.56e10 for n in range(1, 8)]
    assert ratios == pytest.approx([1, 1, 1, 0.4, 1, 1, 1], rel=0.01)
