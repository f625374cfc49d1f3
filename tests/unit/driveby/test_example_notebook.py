"""The notebook of docs/examples/paper_and_pre: stored as it ran, and it still runs."""

import base64
import json
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

import driveby

Cell = dict[str, Any]


@pytest.fixture(scope="module")
def cells(project: Path) -> list[Cell]:
    path = project / "docs" / "examples" / "paper_and_pre" / "compare.ipynb"
    found: list[Cell] = json.loads(path.read_text())["cells"]
    return found


def code_of(cells: list[Cell]) -> list[str]:
    sources = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    return [source.removeprefix("%matplotlib inline\n") for source in sources]


def executed(cells: list[Cell]) -> dict[str, Any]:
    names: dict[str, Any] = {}
    for source in code_of(cells):
        exec(compile(source, "compare.ipynb", "exec"), names)  # noqa: S102 - of this repository
    return names


def test_notebook_is_stored_with_results_of_one_run(cells: list[Cell]) -> None:
    codes = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in codes] == list(range(1, len(codes) + 1))
    outputs = [output for cell in codes for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] in ("error", "stream")]
    pictures = [one["data"]["image/png"] for one in outputs if "image/png" in one["data"]]
    assert len(pictures) == 1
    assert base64.b64decode(pictures[0]).startswith(b"\x89PNG")


def test_notebook_runs_with_a_quick_method(
    cells: list[Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Least squares on the exact drive answers every question: 0.1 s in place of minutes."""
    identify, asked = driveby.identify, []

    def quick(simulation: driveby.Simulation, *, method: str) -> driveby.Identification:
        asked.append((method, simulation))
        return identify(asked[0][1], method="least_squares")

    monkeypatch.setattr(driveby, "identify", quick)
    names = executed(cells)
    assert [method for method, _ in asked] == ["random_walk", "random_walk", "pre"]
    assert asked[0][1] is names["exact"]
    assert asked[1][1] is asked[2][1] is names["measured"]
    assert next(iter(names["ratios"].columns)) == "truth"
    assert names["ratios"]["pre, sensors"].to_numpy() == pytest.approx(names["truth"], rel=0.02)
    assert isinstance(names["figure"], Figure)


@pytest.mark.slow
def test_notebook_finds_what_it_says(cells: list[Cell]) -> None:
    names = executed(cells)
    errors = {
        name: abs(names["ratios"][name] / names["ratios"]["truth"] - 1).max()
        for name in names["answers"]
    }
    assert errors["pre, sensors"] < 0.05
    assert errors["random walk, sensors"] > 4 * errors["pre, sensors"]
    assert ((names["low"] <= names["truth"]) & (names["truth"] <= names["high"])).all()
