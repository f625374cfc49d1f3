"""One id for each stay, also across restarts of the worker and from recordings."""

from collections.abc import Iterable

from schemas.proto import driveby_pb2 as pb
from services.finding.crossing_data import CrossingData, Detection
from services.finding.finder import Name
from services.identification.known import CrossingRecord, is_stay_of

_TruckOnBridge = tuple[str, str, str]
"""Realm, vehicle and bridge."""


class ReportedCrossings:
    """Crossings that were reported before the finder detected them."""

    def __init__(self, known: Iterable[CrossingRecord] = ()) -> None:
        self._known: dict[_TruckOnBridge, list[CrossingRecord]] = {}
        for one in known:
            self.add(one)

    def add(self, known: CrossingRecord) -> None:
        """Add a crossing; of two candidates for a stay the first one counts."""
        self._known.setdefault((known.realm, known.vehicle, known.bridge), []).append(known)

    def recognise(self, detection: Detection) -> Name | None:
        """Return the id under which a stay was reported, None if it was not."""
        for known in self._at(detection):
            if is_stay_of(known, detection.stay, detection.entry_ns):
                return Name(known.crossing_id, known.is_identified or known.is_taken)
        return None

    def reported(self, detection: Detection) -> set[pb.CrossingState]:
        """Return the states of a crossing that an earlier run has published."""
        for known in self._at(detection):
            if known.crossing_id == detection.crossing_id:
                return known.states
        return set()

    def take(self, data: CrossingData, entry_ns: int, exit_ns: int) -> None:
        """Record that a crossing is being identified from a recording."""
        whose = data.realm, data.vehicle.id, data.bridge.id
        for known in self._known.get(whose, ()):
            if known.crossing_id == data.crossing_id:
                known.is_taken = True
                return
        self.add(CrossingRecord(*whose, data.crossing_id, entry_ns, exit_ns, is_taken=True))

    def _at(self, detection: Detection) -> list[CrossingRecord]:
        return self._known.get((detection.realm, detection.vehicle, detection.bridge), [])
