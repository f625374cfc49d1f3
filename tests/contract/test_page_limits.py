"""Words of each page, as `wc -w` counts them. A page that grows sheds something else."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAX_WORDS = {
    "README.md": 900,
    "ARCHITECTURE.md": 1800,
    "CHANGELOG.md": 900,
    "CONTRIBUTING.md": 1800,
    "docs/cluster.md": 1100,
    "docs/commands.md": 1000,
    "docs/containers.md": 1400,
    "docs/contract.md": 4100,
    "docs/engineer.md": 2000,
    "docs/fusion.md": 2000,
    "docs/history.md": 1500,
    "docs/install.md": 500,
    "docs/logger.md": 1400,
    "docs/method-pre.md": 3000,
    "docs/output.md": 2000,
    "docs/programmer.md": 900,
    "docs/promises.md": 1100,
    "docs/python.md": 1000,
    "docs/recordings.md": 2000,
    "docs/security.md": 1000,
    "docs/sensors.md": 1600,
    "docs/survey.md": 2000,
    "docs/truck.md": 1600,
    "docs/validation.md": 4600,
    "docs/verdicts.md": 2300,
    "docs/worker.md": 2000,
}
"""Half of the words of contract, commands, validation and verdicts are generated tables."""
MAX_IN_DOCS = 36_000


def words(page: Path) -> int:
    return len(page.read_text("utf-8").split())


@pytest.mark.parametrize("name", MAX_WORDS)
def test_page_is_within_its_limit(name: str) -> None:
    assert words(ROOT / name) <= MAX_WORDS[name]


def test_every_page_has_a_limit_and_all_keep_theirs() -> None:
    pages = {f"docs/{path.name}": words(path) for path in (ROOT / "docs").glob("*.md")}
    assert pages.keys() <= MAX_WORDS.keys()
    assert sum(pages.values()) <= MAX_IN_DOCS
