"""What several contract tests need."""

from pathlib import Path

import pytest

from tests.builders.wheels import distribution


@pytest.fixture(scope="session")
def first_distribution(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Source archive and wheel of the working tree, for tests that change nothing in the folder."""
    return distribution(project, tmp_path_factory.mktemp("first"), 1e9, 0o664, 0o002)


@pytest.fixture(scope="session")
def wheel(first_distribution: Path) -> Path:
    (found,) = first_distribution.glob("*.whl")
    return found
