"""The printed state of a bridge: what is poorly known is named as such."""

import io

import numpy as np
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


@pytest.mark.parametrize("has_baseline", [False, True])
def test_what_is_found_without_a_baseline_is_no_all_clear(has_baseline: bool) -> None:
    """Element 2 reads 25 % less, which is not clear, and an equal loss of all cannot show."""
    nominal, lengths = (1e10,) * 4, (5.0,) * 4
    elements = {}
    for n, ratio in enumerate((1.0, 0.75, 1.0, 1.0), start=1):
        low, high = ratio * np.exp(-0.15), ratio * np.exp(0.15)
        elements[f"EI_{n}"] = ElementState(
            mean=1e10 * ratio, std=7.5e8, q025=1e10 * low, q975=1e10 * high
        )
    losses = {name: {"10": 0.5} for name in elements} if has_baseline else None
    state = BridgeResult.model_validate(
        {
            **elements,
            "verdict": "good",
            "crossings_used": ("a",),
            "finding": "No element is clear.",
            "probability_of_loss": losses,
        }
    )
    file = io.StringIO()
    console = Console(file=file, width=200, color_system=None)
    print_bridge(console, FusedElements("bridge-1", lengths, nominal), state)
    text = file.getvalue()
    assert ("Possibly less stiff: element 2 (−25 %" in text) != has_baseline
    assert ("--baseline EARLIER.json" in text) != has_baseline
