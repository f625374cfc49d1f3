"""Printed tables of a bridge and its elements."""

from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from typing import TYPE_CHECKING, Protocol

import numpy as np

from schemas.reasons import LEFT_OUT_TEXTS, BridgeReason
from schemas.results import (
    BridgeResult,
    CrossingResult,
    ElementState,
    Parameter,
    Thirds,
    ThirdsState,
    Track,
)
from services.common.language import ENGLISH
from services.common.naming import count_of, entry_in_name
from services.identification.bridge_state import compared
from services.identification.comparison import (
    describe_level,
    describe_possibly_weak,
    possibly_weak,
    unresolved_elements,
)

if TYPE_CHECKING:
    from rich.console import Console


_ENOUGH_RUNS = 5
"""Runs of a wheel-path group from which their lateral wander is known to a third."""
_NO_CHANGE = (
    "all crossings are combined here; driveby history and driveby alarm check show whether EI "
    "changed between them"
)

_NO_BASELINE = (
    "no baseline: elements are compared with each other only; to find a loss since an earlier "
    "survey, give --baseline EARLIER.json"
)


class BridgeElements(Protocol):
    """Data of a bridge in a table: from a site file, or from results."""

    @property
    def id(self) -> str:
        """Name of the bridge."""

    @property
    def lengths_m(self) -> Sequence[float]:
        """Lengths of its elements, m."""

    @property
    def nominal_flexural_rigidity_nm2(self) -> Sequence[float]:
        """Nominal rigidities of its elements, N·m²."""


def print_bridge(
    console: "Console",
    bridge: BridgeElements,
    state: BridgeResult,
    crossings: Sequence[CrossingResult] = (),
) -> None:
    """Print the fused state of a bridge: first the quality of the measurement, then the bridge.

    With all its `crossings` the runs of each wheel-path group are counted, not estimated.
    """
    used, left = len(state.crossings_used), state.crossings_left_out_count
    console.print(
        f"[bold]{bridge.id}[/], {count_of(used, 'crossing')} fused"
        + (f", {left} excluded" if left else "")
    )
    for one in state.crossings_left_out:
        console.print(
            f"  {one.crossing_id}: {LEFT_OUT_TEXTS.get(one.reason, one.reason)}",
            soft_wrap=True,
        )
    console.print(f"measurement [bold]{state.verdict}[/]")
    print_reasons(console, state.reasons, state.reason_texts, ENGLISH.bridge_advice)
    if not state.elements:
        return
    has_meaning = BridgeReason.NOT_FUSED not in state.reasons
    losses, is_doubtful = state.probability_of_loss, state.verdict != "good"
    print_elements(console, bridge, state.elements, has_meaning, losses, is_doubtful=is_doubtful)
    if state.finding is not None:
        print_finding(console, bridge, state)
        if state.probability_of_loss is None and len(_days(state)) > 1:
            console.print(_NO_CHANGE)
    for line in _of_state(state, crossings):
        console.print(line)


def print_reasons(
    console: "Console", codes: Sequence[str], texts: Sequence[str], remedies: Mapping[str, str]
) -> None:
    """Print each reason with its remedy, as in reports; a remedy of several reasons once."""
    for number, (code, text) in enumerate(zip(codes, texts, strict=True)):
        lines = [f"  {code}: {text}"]
        remedy = remedies.get(code)
        if remedy is not None and remedy not in map(remedies.get, codes[:number]):
            lines.append(f"    {remedy}")
        for line in lines:
            console.print(line, markup=False)


def print_finding(console: "Console", bridge: BridgeElements, state: BridgeResult) -> None:
    """Print the finding of a state; without a baseline also what it cannot find."""
    console.print(f"[bold]the bridge:[/] {state.finding}")
    if state.probability_of_loss is not None:
        return
    nominal, lengths = map(np.array, (bridge.nominal_flexural_rigidity_nm2, bridge.lengths_m))
    unresolved = unresolved_elements(state.elements.values())
    lower = possibly_weak(compared(state, nominal, lengths), unresolved)
    for line in (*describe_possibly_weak(lower), _NO_BASELINE):
        console.print(line)


def _days(state: BridgeResult) -> set[date]:
    """Return the days of a state's crossings, as in their names."""
    entries = map(entry_in_name, state.crossings_used)
    return {entry.date() for entry in entries if entry is not None}


def level_lines(
    level: Parameter | ElementState,
    thirds: Thirds | ThirdsState,
    *,
    is_stated: bool = False,
) -> Iterator[str]:
    """Yield the overall stiffness, unless it is stated already, and that of the thirds."""
    parts = (thirds.left, thirds.middle, thirds.right)
    if not is_stated:
        yield f"overall stiffness / nominal: {level.mean:.2f} ± {level.std:.2f}"
    listed = ", ".join(f"{part.mean:.2f} ± {part.std:.2f}" for part in parts)
    yield f"by thirds of the bridge: {listed} (± standard deviation)"


def states_level(state: BridgeResult) -> bool:
    """Return whether the finding of a state has its overall stiffness."""
    if state.finding is None or state.level is None:
        return False
    return describe_level(state.level) in state.finding


def _of_state(state: BridgeResult, crossings: Sequence[CrossingResult]) -> Iterator[str]:
    if state.level is not None and state.thirds is not None:
        yield from level_lines(state.level, state.thirds, is_stated=states_level(state))
    if state.between_crossing_std is not None and len(state.crossings_used) == 1:
        yield (
            "single crossing: intervals include the between-crossing variability, which cannot be "
            "estimated from one crossing"
        )
    if state.between_crossing_std is not None and len(state.crossings_used) > 1:
        low, high = state.between_crossing_std_q025, state.between_crossing_std_q975
        yield (
            f"between-crossing variability of EI: {100.0 * state.between_crossing_std:.1f} % "
            f"(95 % interval {100.0 * (low or 0.0):.1f} to {100.0 * (high or 0.0):.1f} %)"
        )
    for track in state.tracks:
        wander = ""
        if track.wander_m is not None:
            wander = f", lateral wander {_wander(track.wander_m, *_runs(state, track, crossings))}"
        yield (
            f"wheel-path group of {track.vehicle}, {track.direction.replace('_', ' ')}{wander}: "
            f"{100.0 * track.common_share:.0f} % of the profile mismatch is common to all runs; "
            "more runs of this group average out the rest only"
        )


def _wander(wander_m: float, runs: float, is_exact: bool) -> str:
    """Return the lateral wander of a group, with a caveat if its runs are few.

    A standard deviation of n runs has a relative error of 1/√(2(n − 1)), 35 % for five.
    """
    if runs >= _ENOUGH_RUNS:
        return f"{wander_m:.2f} m"
    number = f"{'' if is_exact else 'about '}{count_of(round(runs), 'run')}"
    return f"{wander_m:.2f} m (poorly known from {number}, so partly a typical value)"


def _runs(
    state: BridgeResult, track: Track, crossings: Sequence[CrossingResult]
) -> tuple[float, bool]:
    """Return the number of runs of a wheel-path group, and whether it is exact.

    A state does not have it, nor groups of a single run. Without the crossings it is the mean of
    the groups of the truck, which stands in the names of crossings.
    """
    group = (track.vehicle, track.direction)
    group_of = {one.crossing_id: (one.vehicle, one.direction) for one in crossings}
    # A group with other stretches of road has the same truck and direction.
    alike = [one for one in state.tracks if (one.vehicle, one.direction) == group]
    if group_of.keys() >= set(state.crossings_used):
        runs = sum(group_of[name] == group for name in state.crossings_used)
        return runs / len(alike), len(alike) == 1
    of_truck = [name for name in state.crossings_used if name.startswith(f"{track.vehicle}.")]
    if not of_truck:  # names of older programs
        return len(state.crossings_used) / len(state.tracks), False
    return len(of_truck) / sum(one.vehicle == track.vehicle for one in state.tracks), False


def print_elements(
    console: "Console",
    bridge: BridgeElements,
    elements: Mapping[str, Parameter | ElementState],
    has_meaning: bool,
    losses: Mapping[str, Mapping[str, float]] | None,
    *,
    is_doubtful: bool = False,
) -> None:
    """Print a line for each element; `has_meaning` is whether intervals have one.

    `losses` are probabilities, by element and per cent of the baseline. Those of a doubtful
    measurement have a question mark, as in reports; unresolved elements have none.
    """
    from rich.table import Table

    every = [elements[f"EI_{n}"] for n in range(1, len(bridge.lengths_m) + 1)]
    bounds = [one.q975 if has_meaning else one.mean for one in every]
    ratios = [
        b / nominal for b, nominal in zip(bounds, bridge.nominal_flexural_rigidity_nm2, strict=True)
    ]
    digits_of_ei, digits_of_ratio = _digits(max(bounds) / 1e9, 2), _digits(10.0 * max(ratios), 3)
    table = Table(box=None, pad_edge=False)
    for heading in ("element", "from (m)", "to (m)", "EI (GN·m²)"):
        table.add_column(heading, justify="right")
    if has_meaning:
        table.add_column("95 % interval", justify="right")
    table.add_column("EI/nominal", justify="right")
    if has_meaning and not losses:  # the loss is more important, and a line has 80 characters
        table.add_column("95 % interval", justify="right")
    percents = list(next(iter(losses.values()))) if losses else []
    if losses:
        table.add_column(f"probability\nloss>{'/'.join(percents)}", justify="right")
    start, unresolved, doubt = 0.0, unresolved_elements(every), "?" if is_doubtful else ""
    for number, (length, nominal) in enumerate(
        zip(bridge.lengths_m, bridge.nominal_flexural_rigidity_nm2, strict=True), start=1
    ):
        p = elements[f"EI_{number}"]
        row = [f"EI_{number}", f"{start:.2f}", f"{start + length:.2f}"]
        for unit, digits in ((1e9, digits_of_ei), (nominal, digits_of_ratio)):
            row.append(f"{p.mean / unit:.{digits}f}")
            if has_meaning and not (losses and unit == nominal):
                row.append(f"{p.q025 / unit:.{digits}f} … {p.q975 / unit:.{digits}f}")
        if losses:
            of = {} if number in unresolved else losses.get(f"EI_{number}", {})
            stated = "/".join(f"{100.0 * of[p]:.0f}" for p in percents if p in of)
            row.append(f"{stated} %{doubt}" if stated else "not resolved")
        table.add_row(*row)
        start += length
    console.print(table)


def _digits(largest: float, usual: int) -> int:
    """Return how many decimals leave values of a column as long as `usual` ones below 100.

    Longer ones would break intervals in a line of 80 characters.
    """
    longer = max(0, len(f"{largest:.0f}") - 2)
    return max(0, usual - longer)
