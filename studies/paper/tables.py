"""The paper's tables as data: Tables 1 to 8, CC BY 4.0 (README.md next to them)."""

import json
from functools import cache
from pathlib import Path
from typing import Any, Final

_TABLES: Final = Path(__file__).with_name("tables.json")


@cache
def tables_of_paper() -> dict[str, Any]:
    """Return all tables, by the names of the file."""
    tables: dict[str, Any] = json.loads(_TABLES.read_text(encoding="utf-8"))
    return tables


def of_paper(scenario: int, name: str) -> tuple[float, float]:
    """Return mean and standard deviation of Table 7."""
    row = tables_of_paper()["table7_normalised_estimates"][name]
    return row["mean"][scenario - 1], row["std"][scenario - 1]


def accuracy_of_paper(scenario: int, name: str) -> float:
    """Return S_A of Table 8."""
    return float(tables_of_paper()["table8_accuracy_S_A"][name][scenario - 1])
