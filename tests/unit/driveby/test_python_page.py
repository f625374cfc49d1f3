"""docs/python.md: every snippet runs, from top to bottom, where somebody has checked out."""

import re
from itertools import islice
from pathlib import Path

import pytest

from services.planning import survey
from services.planning.alternatives import alternatives

SNIPPETS = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.fixture
def _few_alternatives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forecast two of the alternatives of a survey; tests/unit/cli/test_survey.py has them all."""
    monkeypatch.setattr(survey, "alternatives", lambda *given: islice(alternatives(*given), 2))


@pytest.mark.usefixtures("_few_alternatives")
def test_every_snippet_runs(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = project / "docs" / "python.md"
    text = page.read_text()
    snippets = list(SNIPPETS.finditer(text))
    assert len(snippets) == text.count("```python") >= 8
    (tmp_path / "recordings").symlink_to(project / "recordings")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "notebook"}
    for snippet in snippets:
        line = text[: snippet.start(1)].count("\n")
        exec(compile("\n" * line + snippet[1], str(page), "exec"), names)  # noqa: S102
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"recordings", "draws.nc", "crossing.png", "drive.mcap", "report.html"}
    assert str(names["figure"]).startswith("Figure(")
