"""The printed state of a bridge: what is poorly known is named as such."""

import io

import pytest
from rich.console import Console

from schemas.results import BridgeResult, ElementState, Track
from services.cli.bridge_table import print_bridge
from services.execution.fuse_results import FusedElements


def printed(runs: int, groups: int) -> str:
    directions = ("start_to_end", "end_to_start")[:groups]
    tracks = tuple(
        Track.model_validate(
            {"vehicle": "truck-1", "direction": one, "common_share": 0.4, "wander_m": 0.118}
        )
        for one in directions
    )
    element = ElementState(mean=1e10, std=1e8, q025=9.8e9, q975=1.02e10)
    state = BridgeResult.model_validate(
        {
            **{f"EI_{n}": element for n in (1, 2, 3)},
            "verdict": "good",
            "crossings_used": tuple(f"truck-1.bridge-1.{n}" for n in range(runs)),
            "tracks": tracks,
        }
    )
    file = io.StringIO()
    console = Console(file=file, width=200, color_system=None)
    print_bridge(console, FusedElements("bridge-1", (10.0,) * 3, (1e10,) * 3), state)
    return " ".join(file.getvalue().split())


@pytest.mark.parametrize(
    ("runs", "groups", "is_known"), [(2, 1, False), (4, 2, False), (5, 1, True), (9, 2, False)]
)
def test_wander_of_few_runs_is_poorly_known(runs: int, groups: int, is_known: bool) -> None:
    text = printed(runs, groups)
    assert "lateral wander 0.12 m" in text
    assert ("poorly known from about" in text) != is_known
    if runs == 4:
        assert "0.12 m (poorly known from about 2 runs, partly a usual value)" in text
