"""Outputs of the engine: messages to publish, tasks, validation requests."""

from typing import NamedTuple

from schemas.proto import driveby_pb2 as pb
from schemas.results import BridgeResult, CrossingResult
from schemas.results_on_the_wire import bridge_to_protobuf, direction_to_protobuf
from schemas.settings import IdentificationSettings
from schemas.topics import Key
from schemas.validation_records import VehicleBridgePair
from services.finding.crossing_data import CrossingData, Detection
from services.finding.stays import Passage
from services.identification.bridge_state import FusionSettings, RecentCrossings


class Output(NamedTuple):
    """A message to publish, with the result itself if it carries one."""

    key: Key
    payload: bytes
    result: CrossingResult | None = None


class IdentificationTask(NamedTuple):
    """A crossing to be identified, with all data needed."""

    number: int
    """Number that identifies the task within its engine."""
    data: CrossingData
    settings: IdentificationSettings
    certificate: str | None = None
    """Hash of the validation record of its vehicle and bridge, where one is known."""

    @property
    def crossing_id(self) -> str:
        """Id of its crossing."""
        return self.data.crossing_id


class FusionTask(NamedTuple):
    """Crossings of a bridge to be fused, with all data needed.

    A newer task of the same realm and bridge includes the older one.
    """

    realm: str
    bridge: str
    counted: RecentCrossings
    fusing: FusionSettings
    exit_time: float
    """Exit of the crossing after which the state is published (s since 1970 UTC)."""


class ValidationRequest(NamedTuple):
    """Request for the validation of a vehicle and bridge, for a waiting crossing."""

    pair: VehicleBridgePair


EngineOutput = Output | IdentificationTask | FusionTask | ValidationRequest


def crossing_output(found: Detection, state: pb.CrossingState, time_ns: int) -> Output:
    """Return the message that a crossing has reached a state, at `time_ns` since 1970 UTC."""
    left = found.stay.passage is not Passage.ENDS_ON_BRIDGE
    message = pb.Crossing(
        schema_version=1,
        crossing_id=found.crossing_id,
        vehicle=found.vehicle,
        bridge=found.bridge,
        direction=direction_to_protobuf(
            "start_to_end" if found.stay.direction > 0 else "end_to_start"
        ),
        state=state,
        time_ns=time_ns,
        entry_time_ns=found.entry_ns,
        exit_time_ns=found.exit_ns if left else 0,
    )
    payload = message.SerializeToString(deterministic=True)
    return Output(Key(found.realm, "bridge", found.bridge, "crossing"), payload)


def state_output(realm: str, bridge: str, exit_time: float, latest: BridgeResult) -> Output:
    """Return the message of a bridge's state after the crossing that ended at `exit_time` (s)."""
    message = bridge_to_protobuf(bridge, round(exit_time * 1e9), latest)
    payload = message.SerializeToString(deterministic=True)
    return Output(Key(realm, "bridge", bridge, "state"), payload)
