"""Where and when pytest-xdist runs the tests of `make test`.

Tests that share a fixture of their module are a group, which one worker runs in order: otherwise
each worker would compute the fixture. A test with a group of its own is left in it. Tests that
start processes or listen at a port mostly wait. They come evenly between the others, so that some
workers compute while others wait.

pytest-xdist 3.8 appends the group to a test's node id, which pytest 9.2 no longer lets it change
(https://github.com/pytest-dev/pytest-xdist/issues/1386): the marks have no effect there. So the
first worker writes the groups of its tests into a file that the scheduler of the controller reads.

In a new checkout pytest rewrites the assertions of each file once, which takes longer than the
rest of the collection. So each worker begins with other folders and finds the files of the others
rewritten.
"""

import json
import tempfile
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest
from xdist.scheduler import LoadGroupScheduling

_FILE = "groups_of_tests"
_WRITTEN = pytest.StashKey[Path]()


def pytest_itemcollected(item: pytest.Item) -> None:
    if not item.get_closest_marker("xdist_group") and "module" in scopes_of_fixtures(item):
        item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))


def scopes_of_fixtures(item: pytest.Item) -> set[str]:
    """Return the scopes of the fixtures that a test uses, also by way of others."""
    info = getattr(item, "_fixtureinfo", None)
    found = info.name2fixturedefs.values() if info else ()
    return {definitions[-1].scope for definitions in found}


def groups_of(items: list[pytest.Item]) -> dict[str, str]:
    """Return the group of each test that has one, by node id."""
    marks = ((item.nodeid, item.get_closest_marker("xdist_group")) for item in items)
    return {name: mark.args[0] for name, mark in marks if mark}


def mostly_waits(item: pytest.Item) -> bool:
    listens = {"endpoint", "tls_endpoint"}.intersection(getattr(item, "fixturenames", ()))
    return bool(listens or item.get_closest_marker("process"))


def begun_at(folder: Path, share: float) -> list[str]:
    """Return the folders of tests below one, from this share of them on, the first ones last."""
    names = sorted({str(path.parent) for path in folder.rglob("test_*.py")})
    first = int(share * len(names))
    return names[first:] + names[:first]


def interleaved(items: list[pytest.Item]) -> list[pytest.Item]:
    """Return groups first, then the other tests, those that mostly wait evenly between them."""
    parts: dict[bool, list[pytest.Item]] = {True: [], False: []}
    for item in items:
        if not item.get_closest_marker("xdist_group"):
            parts[mostly_waits(item)].append(item)
    places = {
        item: (number + 0.5) / len(part)
        for part in parts.values()
        for number, item in enumerate(part)
    }
    return sorted(items, key=lambda item: places.get(item, 0.0))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Order the tests and give their groups to the controller, before it receives their ids."""
    given: dict[str, Any] = getattr(config, "workerinput", {})
    if given:
        # One order for all workers, whichever folders they began with.
        items.sort(key=lambda item: item.nodeid.partition("::")[0])
        items[:] = interleaved(items)
    if given.get("workerid") == "gw0":
        Path(given[_FILE]).write_text(json.dumps(groups_of(items)))


def pytest_configure(config: pytest.Config) -> None:
    folder = tempfile.TemporaryDirectory()
    config.add_cleanup(folder.cleanup)
    config.stash[_WRITTEN] = Path(folder.name) / "groups.json"
    given: dict[str, Any] = getattr(config, "workerinput", {})
    if given and config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        share = int(given["workerid"].removeprefix("gw")) / given["workercount"]
        config.args[:] = [name for path in config.args for name in begun_at(Path(path), share)]


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    node.workerinput[_FILE] = str(node.config.stash[_WRITTEN])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> "Grouped | None":
    return Grouped(config, log) if config.getvalue("dist") == "loadgroup" else None


class Grouped(LoadGroupScheduling):  # type: ignore[misc]  # xdist has no types
    """The scheduler of pytest-xdist, with the groups that a worker has written."""

    @cached_property
    def groups(self) -> dict[str, str]:
        """Group of each test that has one, by node id; every worker has collected its tests."""
        found: dict[str, str] = json.loads(self.config.stash[_WRITTEN].read_text())
        return found

    def _split_scope(self, nodeid: str) -> str:
        return self.groups.get(nodeid) or super()._split_scope(nodeid)
