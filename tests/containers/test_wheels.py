"""The built wheel in containers of several Debian releases, each with its own Python.

Nothing of the project is installed in them: `tests.matrix` makes an empty environment, installs the
wheel from the package index, runs `driveby demo` and a selection of the tests. WHEELS=smoke runs
the demo and few tests instead.
"""

import os
import re
import shutil
from pathlib import Path

import pytest

from tests.containers.stack import ROOT, Stack

pytestmark = [pytest.mark.containers, pytest.mark.timeout(3600)]

IMAGES = ("python:3.11-slim-bookworm", "python:3.13-slim-trixie", "python:3.14-slim-forky")
RUN = """
python -m pip install --quiet --target /tmp/setuptools setuptools || exit 1
cd /driveby
PYTHONPATH=/tmp/setuptools python -m tests.matrix /wheel/*.whl --out /tmp/matrix "$@" && exit
tail -n 60 /tmp/matrix/*/log.txt
exit 1
"""
SMOKE = ("-k", "test_topics or test_recording")


@pytest.fixture(scope="module")
def wheel(engine: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the wheel of the commit."""
    Stack("driveby-wheels").make("dist")
    [built] = (ROOT / "build" / "dist").glob("*.whl")
    folder = tmp_path_factory.mktemp("wheel")
    shutil.copy(built, folder)
    return folder


@pytest.fixture
def index(tmp_path: Path) -> list[str]:
    """Options that give a container pip's settings of this machine (docs/containers.md)."""
    options = ["--volume", f"{tmp_path}:/settings:ro"]
    for variable in ("PIP_CONFIG_FILE", "PIP_CERT"):
        if os.environ.get(variable):
            shutil.copy(os.environ[variable], tmp_path / variable)
            options += ["--env", f"{variable}=/settings/{variable}"]
    return options


@pytest.mark.parametrize("versions", ["newest", "lowest"])
@pytest.mark.parametrize("image", IMAGES)
def test_demo_runs_and_tests_pass(wheel: Path, index: list[str], image: str, versions: str) -> None:
    stack = Stack("driveby-wheels")
    if stack.docker("image", "inspect", image, check=False).code != 0:
        pytest.skip(f"no image {image}: BASES={image} sh tests/containers/images.sh makes it")
    mounted = ("--volume", f"{ROOT}:/driveby:ro", "--volume", f"{wheel}:/wheel:ro", *index)
    words = ["--versions", versions, *(SMOKE if os.environ.get("WHEELS") == "smoke" else ())]
    done = stack.docker("run", "--rm", *mounted, image, "sh", "-c", RUN, "sh", *words)
    row = done.out.splitlines()[-1]
    print(f"\n{image}: {row}")
    python = re.search(r"python:([\d.]+)", image)
    assert python
    assert row.startswith(f"| {python[1]}."), row
    assert re.search(rf"\| {versions} \| runs \(\d+ s\) \| \d+ passed", row), row
