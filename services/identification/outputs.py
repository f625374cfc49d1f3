"""What the engine yields: messages to publish, work to be done elsewhere, certificates wanted."""

from typing import NamedTuple

from schemas.certificates import Pair
from schemas.proto import driveby_pb2 as pb
from schemas.results import BridgeResult, Crossing
from schemas.results_on_the_wire import bridge_to_protobuf, direction_to_protobuf
from schemas.settings import IdentificationSettings
from schemas.topics import Key
from services.identification.bridge_state import Counted, Fusing
from services.identification.crossing_data import CrossingData
from services.identification.stays import Passage, Stay
from services.identification.streams import Boot


class Output(NamedTuple):
    """A message to publish, and the result itself where it is one."""

    key: Key
    payload: bytes
    result: Crossing | None = None


class Work(NamedTuple):
    """A crossing to be identified: all that is needed for it, wherever that is done."""

    number: int
    """Tells the works of one engine apart."""
    data: CrossingData
    settings: IdentificationSettings
    certificate: str | None = None
    """The hash of the certificate of its vehicle and bridge, where one is known."""

    @property
    def crossing_id(self) -> str:
        """The crossing that it is about."""
        return self.data.crossing_id


class Fuse(NamedTuple):
    """Crossings of a bridge that are to be fused: all that is needed for it, wherever that is done.

    A newer one of the same realm and bridge holds all that an older one holds.
    """

    realm: str
    bridge: str
    counted: Counted
    fusing: Fusing
    exit_time: float
    """Of the crossing that the state is told after (s since 1970 UTC)."""


class Wanted(NamedTuple):
    """A crossing waits for the certificate of its vehicle and bridge."""

    pair: Pair


Said = Output | Work | Fuse | Wanted


def crossing_output(
    realm: str,
    vehicle: str,
    bridge: str,
    boot: Boot,
    stay: Stay,
    crossing_id: str,
    state: pb.CrossingState,
    time_s: float,
) -> Output:
    """The message that a crossing has come to a state, at `time_s` on the clock of its boot."""
    left = stay.passage is not Passage.ENDS_ON_BRIDGE
    message = pb.Crossing(
        schema_version=1,
        crossing_id=crossing_id,
        vehicle=vehicle,
        bridge=bridge,
        direction=direction_to_protobuf("start_to_end" if stay.direction > 0 else "end_to_start"),
        state=state,
        time_ns=boot.wall_time_ns(time_s),
        entry_time_ns=boot.wall_time_ns(stay.entry_s),
        exit_time_ns=boot.wall_time_ns(stay.exit_s) if left else 0,
    )
    payload = message.SerializeToString(deterministic=True)
    return Output(Key(realm, "bridge", bridge, "crossing"), payload)


def state_output(realm: str, bridge: str, exit_time: float, latest: BridgeResult) -> Output:
    """The message of a bridge's state after the crossing that ended at `exit_time` (s)."""
    message = bridge_to_protobuf(bridge, round(exit_time * 1e9), latest)
    payload = message.SerializeToString(deterministic=True)
    return Output(Key(realm, "bridge", bridge, "state"), payload)
