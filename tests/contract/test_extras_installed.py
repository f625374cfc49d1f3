"""Each set of extras, installed into an empty environment: its commands run, and import no other.

Needs a package index, minutes and two gigabytes; `make test-all` runs it.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from services.common.extras import EXTRAS
from tests.builders.without import modules_of
from tests.contract.test_extras import ROOT, RUNS, write_files

COMMANDS = """
import json, sys
from driveby.services.cli.main import main
for words in {}:
    assert main(words) == 0, words
print("\\n" + json.dumps(sorted({{name.partition(".")[0] for name in sys.modules}})))
"""


def pins() -> str:
    """Return the pinned versions as constraints, without hashes: the wheel itself has none."""
    text = (ROOT / "requirements" / "runtime.txt").read_text()
    return "\n".join(re.findall(r"^([\w.-]+==[^\\\n]+?) *\\\\?$", text, re.MULTILINE))


def installed(wheel: Path, extras: str, folder: Path) -> Path:
    """Return the interpreter of an empty environment with the wheel and these extras."""
    python = folder / "environment" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", python.parents[1]], check=True)
    constraints = folder / "pins.txt"
    constraints.write_text(pins())
    named = f"{wheel}[{extras}]" if extras else str(wheel)
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    command += ["--no-compile", "-c", str(constraints), named]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no package index: {done.stderr.strip().splitlines()[-1]}")
    return python


def test_pins_are_read() -> None:
    found = pins().splitlines()
    assert len(found) > 30
    assert any(line.startswith("numba==") for line in found)


@pytest.mark.slow
@pytest.mark.parametrize("extras", RUNS)
def test_commands_run_with_installed_extras(wheel: Path, tmp_path: Path, extras: str) -> None:
    python = installed(wheel, extras, tmp_path)
    files = tmp_path / "files"
    files.mkdir()
    write_files(files)
    commands = [command.replace("{}", str(files)).split() for command in RUNS[extras]]
    commands = [words for words in commands if words[0] != "validate"]  # from a checkout only
    done = subprocess.run(
        [python, "-c", COMMANDS.format(commands)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    imported = set(json.loads(done.stdout.splitlines()[-1]))
    mine = [extra for extra in extras.split(",") if extra]
    allowed = {module for extra in mine for module in modules_of(extra)}
    others = {module for extra in EXTRAS for module in EXTRAS[extra]} - allowed
    assert imported & others == set()
    for extra in mine:
        assert imported & set(EXTRAS[extra]), extra
