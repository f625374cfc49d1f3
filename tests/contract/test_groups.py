"""With two workers, the tests of a group run on one of them, in order."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.groups import begun_at, interleaved

ROOT = Path(__file__).parents[2]
TESTS = """
import pytest

NUMBERS = pytest.mark.parametrize("number", range(4))

@pytest.fixture(scope="module")
def shared():
    return 1

@NUMBERS
@pytest.mark.xdist_group("own")
def test_own(number):
    pass

@NUMBERS
def test_module_with_a_fixture(shared, number):
    pass

@pytest.fixture
def from_shared(shared):
    return shared

@NUMBERS
def test_module_by_way_of_another(from_shared, number):
    pass

@pytest.mark.parametrize("number", range(20))
def test_alone(number):
    pass
"""


def test_tests_of_a_group_run_on_one_worker(tmp_path: Path) -> None:
    """Only the scheduler decides where: without groups, the tests of each alternate.

    The workers begin with other folders, and pytest-xdist refuses tests in different orders.
    """
    for name, text in (("a/test_some.py", TESTS), ("b/test_other.py", "def test_other(): pass")):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(text)
    settings = "[pytest]\ntestpaths = .\nmarkers =\n    process: a\n"
    (tmp_path / "pytest.ini").write_text(settings)
    command = [sys.executable, "-m", "pytest", "-p", "xdist", "-p", "tests.groups", "-v", "-n", "2"]
    command += ["--dist", "loadgroup", "-p", "no:cacheprovider"]
    outside = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    own = {"PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=outside | own, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    ran = re.findall(r"\[(gw\d)\].* PASSED a/test_some\.py::test_([a-z]+)", done.stdout)
    for group, size in (("own", 4), ("module", 8)):
        workers = [worker for worker, name in ran if name == group]
        assert len(workers) == size
        assert len(set(workers)) == 1, (group, workers)


class Item(NamedTuple):
    """What `interleaved` reads of a test."""

    name: str
    fixturenames: tuple[str, ...] = ()
    marks: tuple[str, ...] = ()

    def get_closest_marker(self, name: str) -> bool:
        return name in self.marks


def test_those_that_wait_come_evenly_between_the_others() -> None:
    waiting = [Item("a", ("endpoint",)), Item("b", ("tls_endpoint",)), Item("c", (), ("process",))]
    group = Item("g", ("endpoint",), ("xdist_group",))
    others = [Item(str(number)) for number in range(6)]
    found = interleaved([*waiting, *others, group])  # type: ignore[list-item]
    assert "".join(item.name for item in found) == "g0a12b34c5"


def test_each_worker_begins_with_other_folders(tmp_path: Path) -> None:
    for name in ("a/b", "a/c", "d"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "test_some.py").touch()
    (tmp_path / "data").mkdir()
    folders = [str(tmp_path / name) for name in ("a/b", "a/c", "d")]
    found = [begun_at(tmp_path, number / 3) for number in range(3)]
    assert [names[0] for names in found] == folders
    assert [sorted(names) for names in found] == [folders] * 3


def test_this_run_is_grouped(request: pytest.FixtureRequest) -> None:
    assert request.config.pluginmanager.has_plugin("tests.groups")
