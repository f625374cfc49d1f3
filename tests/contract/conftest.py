"""What several contract tests need."""

from pathlib import Path

import pytest

from tests.builders.wheels import built


@pytest.fixture(scope="session")
def wheel(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the working tree, for tests that change nothing in its folder."""
    return built(project, tmp_path_factory.mktemp("source"))
