"""The layout of docs/examples/foxglove names topics and fields that recordings have."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from schemas.proto import driveby_pb2 as pb

ROOT = Path(__file__).parents[2]
LAYOUT = json.loads((ROOT / "docs/examples/foxglove/driveby.json").read_text())
PATH = re.compile(r'"([^"]+)"((?:\.\w+(?:\[\d+\])?)+)')


def leaves(node: str | dict[str, Any]) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    else:
        yield from leaves(node["first"])
        yield from leaves(node["second"])


def paths() -> list[str]:
    panels = LAYOUT["configById"].values()
    plotted = [path["value"] for panel in panels for path in panel.get("paths", ())]
    return plotted + [panel["topicPath"] for panel in panels if "topicPath" in panel]


@pytest.fixture(scope="module")
def recorded() -> dict[str, tuple[str, bytes]]:
    """The first message of each topic of the sample, with the name of its type."""
    found: dict[str, tuple[str, bytes]] = {}
    with (ROOT / "recordings/sample/crossing.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            found.setdefault(channel.topic, (schema.name, message.data))
    return found


def test_panels_of_the_layout_are_those_with_settings() -> None:
    assert sorted(leaves(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_map_follows_the_location_of_the_truck(recorded: dict[str, tuple[str, bytes]]) -> None:
    topic = LAYOUT["configById"]["map!driveby1"]["followTopic"]
    assert recorded[topic][0] == "foxglove.LocationFix"


@pytest.mark.parametrize("path", paths())
def test_path_leads_to_a_value_of_the_sample(
    path: str, recorded: dict[str, tuple[str, bytes]]
) -> None:
    found = PATH.fullmatch(path)
    assert found is not None
    name, payload = recorded[found[1]]
    value = getattr(pb, name.removeprefix("driveby.v1.")).FromString(payload)
    for field, index in re.findall(r"\.(\w+)(?:\[(\d+)\])?", found[2]):
        value = getattr(value, field)
        value = value[int(index)] if index else value
    assert isinstance(value, float | str)
    assert value != ""


def test_one_replacement_adapts_the_layout() -> None:
    page = (ROOT / "docs/examples/foxglove/README.md").read_text()
    before = re.findall(r"sed 's,([^,]+),", page)
    text = (ROOT / "docs/examples/foxglove/driveby.json").read_text()
    assert before == ["sim-drive/vehicle/truck-1"]
    assert text.count(before[0]) == text.count("driveby/v1/") == 8
    assert max(line.count(before[0]) for line in text.splitlines()) == 1
