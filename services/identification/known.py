"""Records of known crossings, and their comparison with stays.

They answer whether a crossing was identified: for the worker at a restart, for the logger before it
deletes a recording. `services.ledger.crossing_log` reads them.
"""

import json
from dataclasses import dataclass, field
from hashlib import sha256

from schemas.proto import driveby_pb2 as pb
from schemas.results import ResultHeader
from schemas.settings import NOT_OF_THE_RESULT
from services.finding.stays import LONGEST_STAY_S, MERGE_S, Passage, Stay, overlap
from services.identification.usable import FusableCrossing


@dataclass
class CrossingRecord:
    """A crossing with published messages; times in ns since 1970 UTC."""

    realm: str
    vehicle: str
    bridge: str
    crossing_id: str
    entry_ns: int
    exit_ns: int = 0
    """Exit; 0 if unknown."""
    states: set[pb.CrossingState] = field(default_factory=set)
    last: pb.Crossing | None = None
    """The last published state."""
    has_result: bool = False
    """Whether it has a result with the current settings and site file."""
    usable: FusableCrossing | None = None
    """Part of the result that counts in the state of the bridge."""
    has_other_result: bool = False
    """Whether it has a result by another search or site file."""
    is_taken: bool = False
    """Whether it is being identified from a recording, so that another detection is ignored."""
    is_in_state: bool = False
    """Whether a published state of the bridge includes it."""

    @property
    def is_identified(self) -> bool:
        """Whether it has a result, or a published message about one that is lost here."""
        return self.has_result or pb.DONE in self.states


def search_hash(header: ResultHeader) -> str:
    """Return the hash of everything that determines the result of a crossing.

    It covers method, seed, all settings that can change the result, and the site file; not the
    versions of program and method.
    """
    ignored = NOT_OF_THE_RESULT | {"method_edition"}
    settings = {k: v for k, v in header.settings.items() if k not in ignored}
    text = json.dumps([header.site_hash, header.seed, settings], sort_keys=True)
    return sha256(text.encode()).hexdigest()[:16]


def is_stay_of(known: CrossingRecord, stay: Stay, entry_ns: int) -> bool:
    """Return whether a stay with entry at `entry_ns` (ns since 1970) is the crossing `known`."""
    if abs(known.entry_ns - entry_ns) < MERGE_S * 1e9:
        return True
    if not known.exit_ns:
        # Where a history starts on the bridge, its entry is unknown, only that it is earlier.
        longest_ns = LONGEST_STAY_S * 1e9
        begins = stay.passage is Passage.BEGINS_ON_BRIDGE
        return begins and 0 < entry_ns - known.entry_ns < longest_ns
    exit_ns = entry_ns + round((stay.exit_s - stay.entry_s) * 1e9)
    return overlap(known.entry_ns, known.exit_ns, entry_ns, exit_ns)
