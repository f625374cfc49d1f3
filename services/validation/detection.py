"""How many crossings does it take to see a weak element, and how often is a sound one accused?

Of simulated surveys with an EI by a scenario of the paper. Each survey's crossings are taken in
groups of 1, 2, 4 and more that follow each other, none in two groups of a size; each group is fused
as a worker does, and asked what the program says: is the weak element named, and is a sound one?
"""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from schemas.results import Crossing
from schemas.site import Bridge
from services.common.progress import Steps, unwatched_steps
from services.identification.bridge_state import Counted, compared, count_in, state_of, usable
from services.identification.comparison import Comparison
from services.simulation.drive import ratios_of
from services.validation.calibration import Record
from services.validation.surveys import KINDS, by_survey

SIZES: Final = (1, 2, 4, 8, 16)
"""Crossings that are fused."""


class Group(NamedTuple):
    """What some crossings of a survey say together."""

    kind: str
    crossings: int
    weak: frozenset[int]
    """The elements that are weak, from 1."""
    said: Comparison | None
    """None where no crossing is good."""


class Detected(NamedTuple):
    """What groups of one kind and size say; None where there is nothing to say."""

    kind: str
    crossings: int
    groups: int
    answered: float
    """The share of the groups that have a state; all others are of these."""
    named: float | None
    """The share in which every weak element is called weak: its 95 % interval against the other
    elements lies below 1 less `comparison.CLEAR_LOSS`."""
    below: float | None
    """The share in which its interval lies below the other elements, by whatever loss."""
    loss: tuple[float, float, float] | None
    """Medians of the lower end, the middle and the upper end of the weak element's loss."""
    accused: float | None
    """The share in which a sound element is called weak."""
    sound_below: float | None
    """The share of the sound elements whose interval lies below the others."""


def groups_of(
    records: Iterable[Record],
    bridge: Bridge,
    sizes: Sequence[int] = SIZES,
    progress: Steps = unwatched_steps,
) -> list[Group]:
    """Of all surveys of these records whose EI is that of a scenario, of this bridge."""
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2)
    lengths = np.array(bridge.lengths_m)
    found = []
    surveys = by_survey(records)
    for number, ((kind, _), lines) in enumerate(surveys.items()):
        progress(number, len(surveys))
        scenario = KINDS[kind].scenario
        if scenario is None:
            continue
        ratios = ratios_of(bridge, scenario, None)
        weak = frozenset((1 + np.flatnonzero(ratios < ratios.max())).tolist())
        for size in sizes:
            for first in range(0, len(lines) - size + 1, size):
                some = [line["result"] for line in lines[first : first + size]]
                results = [usable(Crossing.model_validate(one)) for one in some if one is not None]
                counted = count_in(Counted(), [one for one in results if one is not None])
                state = state_of(counted, bridge.id)
                said = None
                if state is not None and state.elements:
                    said = compared(state, nominal, lengths)
                found.append(Group(kind, size, weak, said))
    return found


def detection(groups: Sequence[Group]) -> list[Detected]:
    """A line for each kind and size, in the order of the groups."""
    keys = dict.fromkeys((group.kind, group.crossings) for group in groups)
    return [
        _detected(*key, [group for group in groups if (group.kind, group.crossings) == key])
        for key in sorted(keys, key=lambda key: (list(KINDS).index(key[0]), key[1]))
    ]


def _detected(kind: str, crossings: int, groups: Sequence[Group]) -> Detected:
    said = [group.said for group in groups if group.said is not None]
    weak = groups[0].weak
    theirs = [[one for one in each.elements if one.number in weak] for each in said]
    sound = [[one for one in each.elements if one.number not in weak] for each in said]
    losses = [(1.0 - one.high, 1.0 - one.ratio, 1.0 - one.low) for each in theirs for one in each]
    low, middle, high = np.median(losses, axis=0).tolist() if losses else (0.0, 0.0, 0.0)
    return Detected(
        kind,
        crossings,
        len(groups),
        len(said) / len(groups),
        _share([all(one.is_weak for one in each) for each in theirs if each]),
        _share([all(one.high < 1.0 for one in each) for each in theirs if each]),
        (low, middle, high) if losses else None,
        _share([any(one.is_weak for one in each) for each in sound]),
        _share([one.high < 1.0 for each in sound for one in each]),
    )


def _share(those: Sequence[bool]) -> float | None:
    return float(np.mean(those)) if those else None


HEADINGS = ("survey", "fused", "groups", "named", "below", "loss", "accused", "of sound")


def cells(line: Detected) -> list[str]:
    """The cells of a row of the table under HEADINGS."""

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
        percent(line.accused),
        "–" if line.sound_below is None else f"{100.0 * line.sound_below:.1f} %",
    ]
