"""Words for the published states of crossings, as `driveby watch` and the live view show them."""

from typing import Final

from schemas.proto import driveby_pb2 as pb

ON_BRIDGE: Final = "on the bridge"
FROM_RECORDING: Final = "from a recording"
"""State of a detected crossing whose truck has left the bridge long ago."""
DETECTED: Final = "detected"
"""State of a detected crossing of which it is unknown whether its truck is there."""
_LATE_S: Final = 60.0
"""Time in s since an entry, on the truck's clock, after which it is found in a recording."""
_WORDS: Final = {
    pb.DETECTED: ON_BRIDGE,
    pb.COMPLETE: "complete",
    pb.WAITING_NOT_VALIDATED: "waits for validation",
    pb.IDENTIFYING: "identifying",
    pb.DONE: "done",
}


def words_of_state(crossing: pb.Crossing, now_ns: int, *, sees_trucks: bool = True) -> str:
    """Return the state of a crossing in words, empty for an unknown one.

    `now_ns` is the present on the clock of the truck's data, in ns since 1970 UTC. Without trucks'
    data, as with the credentials of a viewer, that clock is unknown.
    """
    words = _WORDS.get(crossing.state, "")
    is_late = (now_ns - crossing.entry_time_ns) * 1e-9 > _LATE_S
    if words != ON_BRIDGE or not is_late:
        return words
    return FROM_RECORDING if sees_trucks else DETECTED
