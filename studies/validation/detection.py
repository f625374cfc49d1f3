"""Detection of weak elements by numbers of crossings, and false detections.

The simulated surveys have an EI by a scenario of the paper. Each survey's crossings are taken in
consecutive groups of 1, 2, 4 and more, none in two groups of a size; each group is fused as in a
worker, and its state is compared with the truth: whether the weak element is named, and whether an
undamaged one is.
"""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from schemas.results import CrossingResult
from schemas.site import Bridge
from services.common.progress import Steps, no_step_progress
from services.identification.bridge_state import (
    RecentCrossings,
    add_crossings,
    compared,
    state_of,
    usable,
)
from services.identification.comparison import Comparison
from services.simulation.survey_kinds import KINDS
from studies.validation.calibration import Record
from studies.validation.surveys import by_survey, weak_ratios

SIZES: Final = (1, 2, 4, 8, 16)
"""Numbers of crossings that are fused."""


class CrossingGroup(NamedTuple):
    """Joint result of some crossings of a survey."""

    kind: str
    crossings: int
    weak: frozenset[int]
    """Numbers of the weak elements, from 1."""
    comparison: Comparison | None
    """Comparison of the elements; None without a good crossing."""


class DetectionSummary(NamedTuple):
    """Statistics of groups of one kind and size; None where there is nothing to count."""

    kind: str
    crossings: int
    groups: int
    answered: float
    """Share of the groups with a state, to which all other shares refer."""
    named: float | None
    """Share in which every weak element is named.

    Its 95 % interval against the other elements is below 1 less `comparison.CLEAR_LOSS`.
    """
    below: float | None
    """Share in which its interval is below the other elements, by whatever loss."""
    loss: tuple[float, float, float] | None
    """Medians of the lower end, the middle and the upper end of the weak element's loss."""
    falsely_named: float | None
    """Share in which an undamaged element is named weak."""
    undamaged_below: float | None
    """Share of the undamaged elements whose interval is below the others."""


def groups_of(
    records: Iterable[Record],
    bridge: Bridge,
    sizes: Sequence[int] = SIZES,
    progress: Steps = no_step_progress,
) -> list[CrossingGroup]:
    """Return groups of all surveys of these records with weak elements, of this bridge."""
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2)
    lengths = np.array(bridge.lengths_m)
    found = []
    surveys = by_survey(records)
    for number, ((kind, _), lines) in enumerate(surveys.items()):
        progress(number, len(surveys))
        ratios = weak_ratios(bridge, KINDS[kind])
        if ratios is None:
            continue
        weak = frozenset((1 + np.flatnonzero(ratios < ratios.max())).tolist())
        for size in sizes:
            for first in range(0, len(lines) - size + 1, size):
                some = [line["result"] for line in lines[first : first + size]]
                results = [
                    usable(CrossingResult.model_validate(one)) for one in some if one is not None
                ]
                counted = add_crossings(
                    RecentCrossings(), [one for one in results if one is not None]
                )
                state = state_of(counted, bridge.id)
                comparison = None
                if state is not None and state.elements:
                    comparison = compared(state, nominal, lengths)
                found.append(CrossingGroup(kind, size, weak, comparison))
    return found


def detection(groups: Sequence[CrossingGroup]) -> list[DetectionSummary]:
    """Return a line for each kind and size, in the order of the groups."""
    keys = dict.fromkeys((group.kind, group.crossings) for group in groups)
    return [
        _detected(*key, [group for group in groups if (group.kind, group.crossings) == key])
        for key in sorted(keys, key=lambda key: (list(KINDS).index(key[0]), key[1]))
    ]


def _detected(kind: str, crossings: int, groups: Sequence[CrossingGroup]) -> DetectionSummary:
    comparison = [group.comparison for group in groups if group.comparison is not None]
    weak = groups[0].weak
    theirs = [[one for one in each.elements if one.number in weak] for each in comparison]
    undamaged = [[one for one in each.elements if one.number not in weak] for each in comparison]
    losses = [(1.0 - one.high, 1.0 - one.ratio, 1.0 - one.low) for each in theirs for one in each]
    low, middle, high = np.median(losses, axis=0).tolist() if losses else (0.0, 0.0, 0.0)
    return DetectionSummary(
        kind,
        crossings,
        len(groups),
        len(comparison) / len(groups),
        _share([all(one.is_weak for one in each) for each in theirs if each]),
        _share([all(one.high < 1.0 for one in each) for each in theirs if each]),
        (low, middle, high) if losses else None,
        _share([any(one.is_weak for one in each) for each in undamaged]),
        _share([one.high < 1.0 for each in undamaged for one in each]),
    )


def _share(those: Sequence[bool]) -> float | None:
    return float(np.mean(those)) if those else None


HEADINGS = ("survey", "fused", "groups", "named", "below", "loss", "false", "undamaged")


def cells(line: DetectionSummary) -> list[str]:
    """Return the cells of a row of the table under HEADINGS."""

    def percent(value: float | None) -> str:
        return "–" if value is None else f"{100.0 * value:.0f} %"

    groups = f"{line.groups}"
    if line.answered < 1.0:
        groups = f"{round(line.answered * line.groups)} of {line.groups}"
    loss = "–"
    if line.loss is not None:
        low, middle, high = (100.0 * value for value in line.loss)
        loss = f"{middle:.0f} ({low:.0f} … {high:.0f}) %"
    return [
        line.kind,
        str(line.crossings),
        groups,
        percent(line.named),
        percent(line.below),
        loss,
        percent(line.falsely_named),
        "–" if line.undamaged_below is None else f"{100.0 * line.undamaged_below:.1f} %",
    ]
