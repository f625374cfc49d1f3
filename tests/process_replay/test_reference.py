"""Recorded crossings through the engine give what they gave when the reference was made.

Where a change of the result is meant: `.venv/bin/python tests/data/make_reference_estimate.py`.

Least squares is compared to 1e-7. Markov chains take another path where a processor rounds
otherwise (measured with other kernels of OpenBLAS: means moved by up to 0.011 standard deviations),
so what comes from them is compared in standard deviations.
"""

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from schemas.results import Crossing

SOUND_NM2 = 1.56e10
SCENARIO_6 = [1.0, 1.0, 1.0, 0.4, 1.0, 1.0, 1.0]


@pytest.fixture(scope="module")
def maker(project: Path) -> ModuleType:
    path = project / "tests" / "data" / "make_reference_estimate.py"
    spec = importlib.util.spec_from_file_location("make_reference_estimate", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def reference(maker: ModuleType) -> dict[str, Any]:
    stored: dict[str, Any] = json.loads(maker.REFERENCE.read_text())
    assert stored.keys() == maker.SOURCES.keys()
    return stored


@pytest.fixture(scope="module")
def sample(maker: ModuleType) -> Crossing:
    found: Crossing = maker.identified(maker.SOURCES["sample"])
    return found


@pytest.fixture(scope="module")
def noise_free(maker: ModuleType) -> Crossing:
    found: Crossing = maker.identified(maker.SOURCES["noise_free"])
    return found


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    if isinstance(value, dict):
        items = [(str(key), inner) for key, inner in value.items()]
    elif isinstance(value, list):
        items = [(str(key), inner) for key, inner in enumerate(value)]
    else:
        return {name: value}
    return {k: v for key, inner in items for k, v in leaves(inner, f"{name}.{key}").items()}


def moved(
    found: dict[str, Any], expected: dict[str, Any], tolerance: dict[str, float]
) -> dict[str, Any]:
    """What differs by more than 1e-7, or by more than the tolerance that its name begins with."""
    ours, theirs = leaves(found), leaves(expected)
    assert ours.keys() == theirs.keys()
    differences = {}
    for name, value in ours.items():
        if isinstance(value, float):
            # Heights of the road are around zero: what counts is their size, millimetres. Seconds
            # since 1970 carry a quarter of a microsecond.
            size = 1e-3 if name.startswith(".road_") else abs(theirs[name])
            size = 10.0 if name.endswith("_time") else size
            allowed = [limit for start, limit in tolerance.items() if name.startswith(start)]
            same = abs(value - theirs[name]) <= max([1e-7 * size, *allowed])
        else:
            same = value == theirs[name]
        if not same:
            differences[name] = (value, theirs[name])
    return differences


def test_least_squares_gives_the_reference(
    maker: ModuleType, reference: dict[str, Any], noise_free: Crossing
) -> None:
    assert moved(maker.digest(noise_free), reference["noise_free"], {}) == {}


def test_the_sample_gives_the_reference(
    maker: ModuleType, reference: dict[str, Any], sample: Crossing
) -> None:
    expected = reference["sample"]
    tolerance = {
        f".estimates.{name}.": 0.1 * values["std"] for name, values in expected["estimates"].items()
    }
    # The road is drawn at the mean of the chains: micrometres follow from a tenth of all spreads.
    tolerance |= {".road_front_m": 5e-6, ".road_rear_m": 5e-6, ".iri_m_per_km": 1e-2}
    tolerance |= {".chi2_per_dof": 1e-4, ".scale_error": 0.02 * expected["scale_error"]}
    assert moved(maker.digest(sample), expected, tolerance) == {}


def test_the_sample_is_small_good_and_holds_the_truth(maker: ModuleType, sample: Crossing) -> None:
    assert maker.SOURCES["sample"].recording.stat().st_size < 2_000_000
    assert (sample.verdict, sample.reasons, sample.method) == ("good", (), "pre")
    assert sample.parameters is not None
    for number, ratio in enumerate(SCENARIO_6, start=1):
        p = sample.parameters[f"EI_{number}"]
        assert p.q025 <= ratio * SOUND_NM2 <= p.q975, number


def test_without_noise_every_rigidity_is_found_within_one_per_cent(noise_free: Crossing) -> None:
    assert noise_free.parameters is not None
    ratios = [noise_free.parameters[f"EI_{n}"].mean / SOUND_NM2 for n in range(1, 8)]
    assert ratios == pytest.approx(SCENARIO_6, rel=0.01)
