"""Reference data of the numerical tests, and the record of known answers that table.py prints."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

REFERENCE = Path(__file__).parents[1] / "data" / "reference"

Agree = Callable[[str, float, float, float], None]


@pytest.fixture(scope="session")
def reference_folder() -> Path:
    return REFERENCE


@pytest.fixture(scope="session")
def known_answers() -> dict[str, Any]:
    answers: dict[str, Any] = json.loads((REFERENCE / "known_answers.json").read_text("utf-8"))
    return answers


@pytest.fixture(scope="session")
def paper_tables() -> dict[str, Any]:
    tables: dict[str, Any] = json.loads((REFERENCE / "paper_tables.json").read_text("utf-8"))
    return tables


@pytest.fixture
def agree(record_property: Callable[[str, object], None]) -> Agree:
    """agree(what, known, ours, tolerance): record both for the table, and compare relatively."""

    def check(what: str, known: float, ours: float, tolerance: float) -> None:
        record_property("known answer", (what, float(known), float(ours), tolerance))
        assert ours == pytest.approx(known, rel=tolerance), what

    return check


@pytest.fixture
def measured(record_property: Callable[[str, object], None]) -> Agree:
    """measured(what, expected, ours, tolerance): the same for an absolute tolerance."""

    def check(what: str, expected: float, ours: float, tolerance: float) -> None:
        record_property("measured", (what, float(expected), float(ours), tolerance))
        assert ours == pytest.approx(expected, abs=tolerance), what

    return check
