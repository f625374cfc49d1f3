"""The end of a test run lists what was left out, by cause, with the command that includes it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.left_out import COMMANDS, REMEDIES

ROOT = Path(__file__).parents[2]
TESTS = """
import pytest

@pytest.mark.parametrize("number", range(3))
def test_drawn(number):
    pytest.skip("no Vulkan driver")

def test_of_this_processor():
    pytest.skip("this processor has no avx512")

@pytest.mark.slow
def test_long():
    pass

@pytest.mark.slow
@pytest.mark.faults
def test_kills():
    pass

def test_quick():
    pass
"""


@pytest.mark.parametrize("workers", [[], ["-n", "2"]], ids=["alone", "two-workers"])
def test_summary_counts_each_cause_once_with_its_remedy(workers: list[str], tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n    slow: a\n    faults: b\n")
    command = [sys.executable, "-m", "pytest", "-p", "xdist", "-p", "tests.left_out", *workers]
    command += ["-m", "not slow and not faults", "-p", "no:cacheprovider", "."]
    outside = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    own = {"PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=outside | own, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    listed = done.stdout.partition(" left out ")[2].splitlines()[1:-1]
    assert [line for line in listed if line] == [
        "3 skipped: no Vulkan driver (apt install mesa-vulkan-drivers libvulkan1)",
        "1 skipped: this processor has no avx512",
        "1 deselected: marked slow (make test-all)",
        "1 deselected: marked faults (make faults)",
    ]


def test_commands_and_causes_exist() -> None:
    rules = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {command.removeprefix("make ") for command in COMMANDS.values()} <= set(rules)
    reasons = "\n".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    reasons += (ROOT / "tests/conftest.py").read_text()
    assert [part for part in REMEDIES if part not in reasons and not part.endswith("is not")] == []


def test_this_run_has_the_summary(request: pytest.FixtureRequest) -> None:
    assert request.config.pluginmanager.has_plugin("tests.left_out")
