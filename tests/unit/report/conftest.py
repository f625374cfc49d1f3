"""Pictures of reports: composed in every test, drawn where a test depends on what is drawn."""

from typing import IO, Any

import pytest
from matplotlib.figure import Figure


@pytest.fixture
def drawn() -> None:
    """Keep the pictures of a test's pages drawn; their letters are paths, not text."""


@pytest.fixture(autouse=True)
def _composed(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the pictures empty: drawing them takes most of the time of a page."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(Figure, "savefig", _empty)


def _empty(_: Figure, file: IO[bytes], **asked: Any) -> None:
    assert asked["format"] == "svg"
    file.write(b"<svg></svg>")
