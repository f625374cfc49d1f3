"""What the engine remembers of a truck since it started, and of a bridge."""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from schemas.proto import driveby_pb2 as pb
from schemas.results import Crossing
from schemas.site import Bridge, Vehicle
from schemas.vehicle_info import Difference
from services.identification.bridge_state import Counted
from services.identification.outputs import Output, Work
from services.identification.stays import MERGE_S
from services.identification.streams import Boot


class TruckBoot:
    """One boot of one truck: its messages, and what has been said of its crossings."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.boot = Boot()
        self.latest_s = -np.inf
        self.began_s = np.inf
        self.forgotten_s = -np.inf
        self.clock_s = -np.inf
        """The latest time that more than one message has told."""
        self.doubtful_s = -np.inf
        """One far ahead of it, which only one message has told yet."""
        self.detected: dict[tuple[str, float], str] = {}
        """Crossing ids by bridge and about the time of entry."""
        self.done: set[str] = set()
        self.decided: list[tuple[str, float, float, str]] = []
        """Bridge, times of the fixes around it, and id of each crossing that is decided."""
        self.said: dict[str, set[pb.CrossingState]] = {}
        """By crossing id: states that an earlier run of the worker has told."""
        self.side: dict[str, int] = {}
        """By bridge: far before its start (-1), far behind its end (1), or near (0)."""
        self.differences: list[Difference] = []
        """Where it says of itself what the site file does not say of it."""

    def is_busy_at(self, bridge: Bridge) -> bool:
        """Whether a crossing of this bridge has begun and is not decided yet."""
        return any(
            known_bridge == bridge.id and crossing_id not in self.done
            for (known_bridge, _), crossing_id in self.detected.items()
        )

    def forget_before(self, time_s: float) -> None:
        """Forget samples, fixes and crossings that are decided: no stay is found there again."""
        self.forgotten_s = time_s
        self.boot.forget_before(time_s)
        self.decided = [one for one in self.decided if one[2] >= time_s]
        kept = {crossing_id for *_, crossing_id in self.decided}
        self.detected = {
            (bridge, entry_s): crossing_id
            for (bridge, entry_s), crossing_id in self.detected.items()
            if entry_s >= time_s - MERGE_S or crossing_id in kept or crossing_id not in self.done
        }
        kept.update(self.detected.values())
        self.done &= kept
        self.said = {name: states for name, states in self.said.items() if name in kept}


class UnderWay(NamedTuple):
    """A crossing that is being identified."""

    work: Work
    done: Output
    """What is told when it is: the truck's clock may have been forgotten by then."""


class Waiting(NamedTuple):
    """A crossing that is complete and waits for a certificate, or behind one that did."""

    work: Work
    identifying: Output | None
    """What is told when it goes on; None if an earlier run has told it."""
    done: Output


@dataclass
class BridgeCrossings:
    """What has been found on one bridge, in one realm."""

    counted: Counted = field(default_factory=Counted)
    under_way: deque[UnderWay] = field(default_factory=deque)
    """In the order in which they were found: so their results are told."""
    results: dict[int, Crossing] = field(default_factory=dict)
    """Those that have come before one that was found earlier, by number of the work."""
