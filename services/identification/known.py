"""What is known of a crossing before its data come again, and when a stay is that crossing.

The one answer to "was this crossing identified?": the worker asks it when it starts again, the
logger before it deletes a recording. Where it is read from is `services.history.store`.
"""

import json
from dataclasses import dataclass, field
from hashlib import sha256

from schemas.proto import driveby_pb2 as pb
from schemas.results import Header
from schemas.settings import NOT_OF_THE_RESULT
from schemas.signals import NS_PER_S
from services.identification.bridge_state import Usable
from services.identification.stays import MERGE_S, Passage, Stay

LONGEST_STAY_S = 270.0
"""Who is on a short bridge for so long does not cross it."""


@dataclass
class Known:
    """One crossing of which something was told; times are ns since 1970 UTC."""

    realm: str
    vehicle: str
    bridge: str
    crossing_id: str
    entry_ns: int
    exit_ns: int = 0
    """0: not told."""
    states: set[pb.CrossingState] = field(default_factory=set)
    last: pb.Crossing | None = None
    """The state that was told last."""
    has_result: bool = False
    """By the search that was asked for."""
    usable: Usable | None = None
    """What of the result counts in the state of the bridge."""
    has_other_result: bool = False
    """By another search or site file."""
    is_taken: bool = False
    """It is being identified from a recording: who finds it once more has nothing to do."""
    is_in_state: bool = False
    """A state of the bridge that takes account of it was told."""

    @property
    def is_identified(self) -> bool:
        """Whether it has a result, or was told to have one in a message that is lost here."""
        return self.has_result or pb.DONE in self.states


def search_hash(header: Header) -> str:
    """What two results of one crossing must have in common to be the same result.

    Method, seed, all settings that can change it, and the site file; not the program's version.
    """
    settings = {k: v for k, v in header.settings.items() if k not in NOT_OF_THE_RESULT}
    text = json.dumps([header.site_hash, header.seed, settings], sort_keys=True)
    return sha256(text.encode()).hexdigest()[:16]


def is_stay_of(known: Known, stay: Stay, entry_ns: int) -> bool:
    """Whether a stay on its bridge, whose entry was at `entry_ns` (since 1970), is a crossing."""
    if abs(known.entry_ns - entry_ns) < MERGE_S * 1e9:
        return True
    if not known.exit_ns:
        # Where a history begins on the bridge, its entry is not known, only that it is earlier.
        longest_ns = LONGEST_STAY_S * 1e9
        begins = stay.passage is Passage.BEGINS_ON_BRIDGE
        return begins and 0 < entry_ns - known.entry_ns < longest_ns
    exit_ns = entry_ns + round((stay.exit_s - stay.entry_s) * 1e9)
    return overlap(known.entry_ns, known.exit_ns, entry_ns, exit_ns)


def are_one(entry_ns: float, exit_ns: float, other_entry_ns: float, other_exit_ns: float) -> bool:
    """Whether two stays of one truck on one bridge are the same: begun together, or overlapping."""
    if abs(entry_ns - other_entry_ns) < MERGE_S * NS_PER_S:
        return True
    return overlap(entry_ns, exit_ns, other_entry_ns, other_exit_ns)


def overlap(begin: float, end: float, other_begin: float, other_end: float) -> bool:
    """Whether two stretches of time have more than a moment in common."""
    return begin < other_end and other_begin < end
