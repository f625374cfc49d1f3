"""The tables of the pages: those that follow from code are up to date, all of them parse."""

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

from schemas import results, site
from schemas.reasons import BridgeReason, Reason
from schemas.topics import TOPICS
from tests.contract.test_pages import PAGES, ROOT

SCRIPT = ROOT / "docs/scripts/tables.py"


@pytest.fixture(scope="module")
def script() -> dict[str, Any]:
    return runpy.run_path(str(SCRIPT))


def test_tables_on_pages_are_those_of_the_code(script: dict[str, Any]) -> None:
    pages = script["pages"]()
    old = [path.name for path, text in pages.items() if path.read_text("utf-8") != text]
    assert old == [], "run make tables"
    markers = re.findall(r"<!-- table: ([a-z ]+) -->", "".join(pages.values()))
    assert sorted(markers) == sorted(script["TABLES"]), "each table stands on one page"


def test_a_changed_cell_or_remedy_is_found(script: dict[str, Any]) -> None:
    written = script["written"]
    for name in ("contract", "commands", "install", "verdicts", "programmer"):
        text = (ROOT / f"docs/{name}.md").read_text("utf-8")
        block = re.search(
            r"<!-- (?:table: [a-z ]+|remedies) -->\n(.*?)<!-- end -->", text, re.DOTALL
        )
        assert block is not None
        last = block[1].rstrip()
        changed = text.replace(last, last[:-4] + "other |" if name != "programmer" else "", 1)
        assert changed != text
        assert written(changed) == text, name


def test_every_topic_key_field_and_reason_stands_in_a_table() -> None:
    contract = (ROOT / "docs/contract.md").read_text("utf-8")
    for topic in TOPICS:
        assert f"| `{topic.owner}/…/{topic.stream}` |" in contract
    for key in (*site.Bridge.model_fields, *site.Vehicle.model_fields, *site.Sensor.model_fields):
        assert f"`{key}`" in contract
    for field in (*results.Derived.model_fields, *results.BridgeResult.model_fields):
        assert f"`{field}`" in contract
    verdicts = (ROOT / "docs/verdicts.md").read_text("utf-8")
    for reason in (*Reason, *BridgeReason):
        assert f"| `{reason}` |" in verdicts


def test_the_subscriber_is_short(script: dict[str, Any]) -> None:
    assert sum(bool(line) for line in script["SUBSCRIBER"].splitlines()) <= 15


# Markdown


def tables(text: str) -> list[list[str]]:
    """Return the lines of each table, outside of code."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    found: list[list[str]] = [[]]
    for line in prose.splitlines():
        if line.lstrip().startswith("|"):
            found[-1].append(line)
        elif found[-1]:
            found.append([])
    return [lines for lines in found if lines]


def cells(line: str) -> list[str]:
    """Return the cells of a row; `\\|` is a character of a cell."""
    assert line.startswith("|"), f"indented: {line[:60]}"
    assert line.endswith("|"), f"without an end: {line[:60]}"
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def faults(text: str) -> list[str]:
    """Return what is wrong with the tables of a page."""
    found = []
    for lines in tables(text):
        head, *rest = lines
        if not rest or not all(re.fullmatch(r":?-+:?", cell) for cell in cells(rest[0])):
            found.append(f"no rule below the head: {head[:60]}")
            continue
        width = len(cells(head))
        found += [
            f"{len(cells(row))} cells: {row[:60]}" for row in rest if len(cells(row)) != width
        ]
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_table_parses(page: Path) -> None:
    text = page.read_text("utf-8")
    assert faults(text) == []
    for block in re.findall(r"^.*\n\|.*\n\| ?:?---", text, re.MULTILINE):
        before = block.splitlines()[0]
        assert not before.strip(), f"a table needs a blank line before it: {before[:60]}"


def test_a_broken_table_is_found() -> None:
    good = "| a | b |\n| --- | --: |\n| `x\\|y` | 1 |\n"
    assert faults(good) == []
    assert faults(f"```\n| a |\n```\n{good}") == []
    assert faults("| a | b |\n| 1 | 2 |\n") == ["no rule below the head: | a | b |"]
    assert faults(f"{good}| x | 1 | 2 |\n") == ["3 cells: | x | 1 | 2 |"]
    assert faults(f"{good}| x \\| 1 |\n") == ["1 cells: | x \\| 1 |"]
