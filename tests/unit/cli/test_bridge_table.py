"""The printed state of a bridge: what is poorly known is named as such."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from rich.console import Console

from schemas.results import BridgeResult, CrossingResult, ElementState, Results, Track
from services.cli.bridge_table import print_bridge
from services.cli.identify import _print
from services.cli.main import main
from services.execution import fuse_results
from services.execution.fuse_results import FusedElements
from services.simulation.drive import paper_site
from tests.unit.identification.test_fusing import crossing, write
from tests.unit.viewer.found import results_of, some_crossing

WAYS: Final = ("start_to_end", "end_to_start")


def group(direction: str, vehicle: str = "truck-1") -> Track:
    fields = {"direction": direction, "common_share": 0.4, "wander_m": 0.118}
    return Track.model_validate({"vehicle": vehicle} | fields)


def printed(
    runs: int, groups: int, *others: Track, crossings: Sequence[CrossingResult] = ()
) -> str:
    tracks = (*(group(way) for way in WAYS[:groups]), *others)
    element = ElementState(mean=1e10, std=1e8, q025=9.8e9, q975=1.02e10)
    state = BridgeResult.model_validate(
        {
            **{f"EI_{n}": element for n in (1, 2, 3)},
            "verdict": "good",
            "crossings_used": (
                *(f"truck-1.bridge-1.{n}" for n in range(runs)),
                *(f"{one.vehicle}.bridge-1.{n}" for one in others for n in range(runs, runs + 4)),
            ),
            "tracks": tracks,
        }
    )
    file = io.StringIO()
    console = Console(file=file, width=200, color_system=None)
    elements = FusedElements("bridge-1", (10.0,) * 3, (1e10,) * 3)
    print_bridge(console, elements, state, crossings)
    return " ".join(file.getvalue().split())


@pytest.mark.parametrize(
    ("runs", "groups", "is_known"), [(2, 1, False), (4, 2, False), (5, 1, True), (9, 2, False)]
)
def test_wander_of_few_runs_is_poorly_known(runs: int, groups: int, is_known: bool) -> None:
    text = printed(runs, groups)
    assert "lateral wander 0.12 m" in text
    assert ("poorly known from about" in text) != is_known
    if runs == 4:
        assert "0.12 m (poorly known from about 2 runs, so partly a typical value)" in text


def test_runs_of_each_wheel_path_group_are_counted() -> None:
    """Three crossings from start to end and two from end to start."""
    site = paper_site()
    crossings = [
        one.model_copy(update={"crossing_id": f"truck-1.bridge-1.{n}", "direction": WAYS[n >= 3]})
        for n, one in enumerate(
            results_of(site, *(some_crossing(str(n)) for n in range(5))).crossings
        )
    ]
    text = printed(5, 2, crossings=crossings)
    assert "start to end, lateral wander 0.12 m (poorly known from 3 runs, so partly" in text
    assert "end to start, lateral wander 0.12 m (poorly known from 2 runs, so partly" in text
    alone = printed(4, 1, crossings=crossings)  # the other direction was driven once
    assert "start to end, lateral wander 0.12 m (poorly known from 3 runs, so partly" in alone
    every = [one.model_copy(update={"direction": WAYS[0]}) for one in crossings]
    assert "poorly known" not in printed(5, 1, crossings=every)


def test_fuse_and_identify_count_the_runs_of_a_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of three crossings one went the other way, and a group of one run is not in the state."""
    fuse_one = fuse_results._state
    grouped = {"tracks": (group(WAYS[0]),)}

    def with_group(*given: Any) -> BridgeResult:
        fused = fuse_one(*given)
        assert fused is not None
        return fused.model_copy(update=grouped)

    monkeypatch.setattr(fuse_results, "_state", with_group)
    driven = [crossing(n).model_copy(update={"direction": WAYS[n == 2]}) for n in range(3)]
    assert main(["fuse", str(write(tmp_path / "r.json", driven))]) == 0
    assert "(poorly known from 2 runs, " in " ".join(capsys.readouterr().out.split())

    site = paper_site()
    found = results_of(site, *(some_crossing(name) for name in "abc"), used="a")
    backward = found.crossings[2].model_copy(update={"direction": WAYS[1]})
    (state,) = found.bridges.values()
    state = state.model_copy(update=grouped | {"crossings_used": tuple("abc")})
    crossings = (*found.crossings[:2], backward)
    found = found.model_copy(update={"crossings": crossings, "bridges": {"bridge-1": state}})
    _print(Console(width=200), found, site)
    assert "(poorly known from 2 runs, " in " ".join(capsys.readouterr().out.split())


def test_runs_of_another_truck_do_not_count() -> None:
    text = printed(3, 1, group(WAYS[0], "truck-2"))
    assert "of truck-1, start to end, lateral wander 0.12 m (poorly known from about 3 runs" in text
    assert "of truck-2, start to end, lateral wander 0.12 m (poorly known from about 4 runs" in text


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


@pytest.mark.parametrize(("verdict", "mark"), [("good", ""), ("suspect", "?")])
def test_losses_of_a_crossing_are_marked_where_they_are_doubtful(
    capsys: pytest.CaptureFixture[str], verdict: str, mark: str
) -> None:
    """Element 2 has an interval from 0.05 to 4 of nominal: no loss of it is determined."""
    site = paper_site()
    reasons = () if verdict == "good" else ("model_misfit",)
    content = results_of(site, some_crossing("a", verdict=verdict, reasons=reasons)).model_dump()
    (one,) = content["crossings"]
    nominal = site.bridges[0].nominal_flexural_rigidity_nm2[1]
    wide = {"mean": nominal, "std": nominal, "q025": 0.05 * nominal, "q975": 4.0 * nominal}
    one["parameters"]["EI_2"] |= wide
    below = {f"EI_{n}": 1.0 for n in range(1, 8)}
    one["derived"]["probability_below_90_percent_of_baseline"] = below
    _print(Console(width=200), Results.model_validate(content), site)
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.rstrip() for line in lines if line.split()[:1]}
    assert rows["EI_2"].endswith(" not resolved")
    assert rows["EI_4"].endswith(f" 100 %{mark}")
