"""Tests are type-checked as the program is; those that are not yet are listed in pyproject.toml."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAX_UNTYPED = 88
"""Number of test modules that mypy may skip; lower it with the list."""
ALWAYS_TYPED = ("tests.builders", "tests.contract", "tests.process_replay", "tests.same")


def untyped() -> list[str]:
    """Return the test modules whose errors mypy ignores."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mypy"]
    assert settings["strict"]
    assert "tests" in settings["packages"]
    (found,) = (one["module"] for one in settings["overrides"] if one.get("ignore_errors"))
    return list(found)


def test_list_of_untyped_tests_only_shrinks() -> None:
    names = untyped()
    assert len(names) <= MAX_UNTYPED
    assert names == sorted(set(names))
    for name in names:
        assert (ROOT / f"{name.replace('.', '/')}.py").is_file(), name
        assert not name.startswith(ALWAYS_TYPED), name


@pytest.mark.slow
def test_listed_tests_are_not_typed_yet(tmp_path: Path) -> None:
    text = (ROOT / "pyproject.toml").read_text()
    settings = tmp_path / "pyproject.toml"
    settings.write_text(text.replace("ignore_errors = true", "ignore_errors = false"))
    command = [sys.executable, "-m", "mypy", "--config-file", str(settings)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    found = set(re.findall(r"^(tests/.*)\.py:\d+: error", done.stdout, re.MULTILINE))
    assert {name.replace("/", ".") for name in found} == set(untyped()), done.stdout[-2000:]
