"""The logger's line of its own log on its health."""

from collections import defaultdict
from collections.abc import Mapping

from schemas.signals import NS_PER_S
from services.common.naming import count_of
from services.logger.clocks import STEP_NS

_MAX_NAMED = 3
_LONG_LAG_S = 60.0
"""Shortest lag that is explained: the network is rarely the cause."""


def health_line(figures: Mapping[str, float]) -> str:
    """Return the figures for the log, once a minute; `health` has all others."""
    known = defaultdict(float, figures)
    why = ""
    if known["lag_s"] > _LONG_LAG_S:
        why = " (samples so old when they came: played faster than real, sent late, or a clock off)"
    return (
        f"{count_of(known['trucks_alive'], 'truck')}, {known['rate_per_s']:.0f} messages/s, "
        f"lag {known['lag_s']:.2f} s{why}, queue {known['queue']:.0f}, lost {known['lost']:.0f}, "
        f"missing {known['missing']:.0f}, recovered {known['recovered']:.0f}, "
        f"duplicates {known['duplicates']:.0f}, refused {known['refused']:.0f}, "
        f"dropped {known['dropped']:.0f}, written {known['written']:.0f} to "
        f"{count_of(known['files'], 'file')}, {known['disk_free_bytes'] / 1e9:.1f} GB left"
    )


def clock_note(figures: Mapping[str, float]) -> str:
    """Return the trucks whose clocks are ahead of the logger's, for `health`; empty without any."""
    name = "clock_offset_s/"
    ahead = {
        truck.removeprefix(name): -offset_s
        for truck, offset_s in sorted(figures.items())
        if truck.startswith(name) and offset_s * NS_PER_S <= -STEP_NS
    }
    shown = [f"{truck} by {by_s:.1f} s" for truck, by_s in list(ahead.items())[:_MAX_NAMED]]
    more = " …" if len(ahead) > _MAX_NAMED else ""
    return f"clocks ahead: {', '.join(shown)}{more}" if shown else ""
