"""The lanes of a live view: states of each truck's crossings of a bridge, over time."""

from __future__ import annotations

from typing import Final

import rerun as rr

from services.viewer.crossing_view import VERDICT_COLOURS
from services.viewer.live_layout import lane_entity
from services.viewer.live_parts import TimestampedStream
from services.viewer.rerun_parts import rgb

_LANE_STEP_NS: Final = 1_000_000
"""Smallest time in ns between two states of a crossing, so that the first one is visible."""
LANE_STATES: Final = {
    "on the bridge": "#0072B2",
    "complete": "#56B4E9",
    "waits for validation": "#CC79A7",
    "identifying": "#999999",
    **VERDICT_COLOURS,
}


class CrossingLanes:
    """One lane for each bridge and truck."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._drawn_ns: dict[tuple[str, str], int] = {}
        """Time up to which crossings are drawn, by bridge and truck."""

    def draw(self, bridge: str, vehicle: str, state: str, moment_ns: int) -> None:
        """Draw a state of a truck's crossings of a bridge, from a time on."""
        entity = lane_entity(bridge, vehicle)
        if (bridge, vehicle) not in self._drawn_ns:
            colours = [(*rgb(colour), 255) for colour in LANE_STATES.values()]
            style = rr.StateConfiguration(values=list(LANE_STATES), colors=colours)
            self._recording.log(entity, style, static=True)
        before_ns = self._drawn_ns.get((bridge, vehicle), 0)
        if state == "on the bridge" and moment_ns < before_ns:
            return  # it belongs to a crossing whose truck is already over the next bridge
        moment_ns = max(moment_ns, before_ns + _LANE_STEP_NS)
        self._drawn_ns[bridge, vehicle] = moment_ns
        TimestampedStream(self._recording, moment_ns).log(entity, rr.StateChange(state=state))

    def end_ns(self, bridge: str) -> int:
        """Return the time up to which any truck's crossings of a bridge are drawn."""
        return max((ns for (name, _), ns in self._drawn_ns.items() if name == bridge), default=0)
