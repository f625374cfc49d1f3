"""The line on the logger's health in its own log."""

from collections import defaultdict
from collections.abc import Mapping

from schemas.signals import NS_PER_S
from services.common.naming import count_of, first_of, offset_in_words
from services.logger.clocks import STEP_NS

_MAX_NAMED = 3
_BEHIND_S = 2.0
"""Smallest offset of a clock that is named as behind."""
_LONG_LAG_S = 60.0
"""Shortest lag that is explained: the network is rarely the cause."""


def health_line(figures: Mapping[str, float]) -> str:
    """Return the figures for the log, once a minute; `health` has all others."""
    known = defaultdict(float, figures)
    why = ""
    if known["lag_s"] > _LONG_LAG_S:
        why = " (old samples: replayed faster than real time, sent late, or a clock is wrong)"
    room = "disk_free_bytes"  # unknown until the writer has looked
    left = f", {known[room] / 1e9:.1f} GB left" if room in figures else ""
    return (
        f"{count_of(known['trucks_alive'], 'truck')}, {known['rate_per_s']:.0f} messages/s, "
        f"lag {offset_in_words(known['lag_s'], 2)}{why}, "
        f"queue {known['queue']:.0f}, lost {known['lost']:.0f}, "
        f"missing {known['missing']:.0f}, recovered {known['recovered']:.0f}, "
        f"duplicates {known['duplicates']:.0f}, refused {known['refused']:.0f}, "
        f"dropped {known['dropped']:.0f}, written {known['written']:.0f}, "
        f"{count_of(known['files'], 'open file')}{left}"
    )


def clock_note(figures: Mapping[str, float]) -> str:
    """Return the trucks whose clocks differ from the logger's, for `health`; empty without any.

    Their offset is the shortest delay in minutes, so a network explains at most a second or two.
    """
    name = "clock_offset_s/"
    offsets_s = {
        truck.removeprefix(name): offset_s
        for truck, offset_s in sorted(figures.items())
        if truck.startswith(name)
    }
    ahead = {truck: -one for truck, one in offsets_s.items() if one * NS_PER_S <= -STEP_NS}
    behind = {truck: one for truck, one in offsets_s.items() if one >= _BEHIND_S}
    notes = (_named("clocks ahead", ahead), _named("clocks behind, or all samples late", behind))
    return "; ".join(note for note in notes if note)


def _named(what: str, trucks_s: Mapping[str, float]) -> str:
    shown = [f"{truck} by {offset_in_words(by_s, 1)}" for truck, by_s in trucks_s.items()]
    return f"{what}: {first_of(shown, _MAX_NAMED)}" if shown else ""
