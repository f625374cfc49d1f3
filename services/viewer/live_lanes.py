"""The lanes of a live view: states of each truck's crossings of a bridge, over time."""

from __future__ import annotations

from typing import Final

import rerun as rr

from schemas.proto import driveby_pb2 as pb
from services.common.crossing_states import FROM_RECORDING, ON_BRIDGE
from services.common.language import utc_second
from services.viewer.crossing_view import VERDICT_COLOURS
from services.viewer.live_layout import lane_entity
from services.viewer.live_parts import TimestampedStream
from services.viewer.rerun_parts import rgb

_LANE_STEP_NS: Final = 1_000_000
"""Smallest time in ns between two states of a crossing, so that the first one is visible."""
LANE_STATES: Final = {
    ON_BRIDGE: "#0072B2",
    FROM_RECORDING: "#F0E442",
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
        if state == ON_BRIDGE and moment_ns < before_ns:
            return  # it belongs to a crossing whose truck is already over the next bridge
        moment_ns = max(moment_ns, before_ns + _LANE_STEP_NS)
        self._drawn_ns[bridge, vehicle] = moment_ns
        TimestampedStream(self._recording, moment_ns).log(entity, rr.StateChange(state=state))

    def end_ns(self, bridge: str) -> int:
        """Return the time up to which any truck's crossings of a bridge are drawn."""
        return max((ns for (name, _), ns in self._drawn_ns.items() if name == bridge), default=0)


class RecordedCrossings:
    """Crossings found in recordings that wait for their result, the newest of each bridge."""

    def __init__(self) -> None:
        self._lines: dict[str, tuple[str, str]] = {}
        """Identifier of the crossing and the line on it, by bridge."""

    def note(self, crossing: pb.Crossing) -> None:
        """Keep a crossing until its result."""
        when = utc_second(crossing.entry_time_ns * 1e-9)
        line = f"From a recording: {crossing.vehicle} crossed on {when} UTC. No result yet."
        self._lines[crossing.bridge] = crossing.crossing_id, line

    def forget(self, bridge: str, crossing_id: str) -> None:
        """Remove a crossing that has its result."""
        if self._lines.get(bridge, ("", ""))[0] == crossing_id:
            del self._lines[bridge]

    def text(self, bridge: str) -> str:
        """Return the line on a bridge's crossing without a result; empty without one."""
        return self._lines.get(bridge, ("", ""))[1]
