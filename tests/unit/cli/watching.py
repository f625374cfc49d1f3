"""A morning in a realm, as messages: what `driveby watch` is shown in tests and pictures."""

from typing import Any

import numpy as np

from schemas.alarms import Acknowledgement, Alarm, encode_alarm
from schemas.proto import driveby_pb2 as pb
from schemas.results import Crossing, Header
from schemas.results_on_the_wire import bridge_to_protobuf, crossing_to_protobuf
from schemas.signals import AccelBatch, Channel, GnssFix, Identity, encode_accel, encode_gnss
from schemas.site import Site
from schemas.topics import Key
from services.bus.listening import Heard
from services.cli.watched import Watched
from tests.unit.viewer.found import results_of, some_crossing

NOW_NS = 1_790_000_600_000_000_000
NOW_S = 5000.0
HEADER = Header("0.1.0", 1.79e9, "hash", {}, 1)


class Listened:
    """What a page wants to know of a `Listening`."""

    def __init__(self, realm: str = "live", alive: set[str] | None = None) -> None:
        self.realm = realm
        self.alive = alive or set()
        self.elsewhere: dict[str, set[str]] = {}


def heard(owner: Any, name: str, stream: str, payload: bytes) -> Heard:
    return Heard(Key("live", owner, name, stream), Identity(1, 0), payload)


def tell(watched: Watched, message: Heard, ago_s: float = 0.0) -> str | None:
    """A message that came so long before now."""
    return watched.take(message, NOW_S - ago_s, NOW_NS - round(ago_s * 1e9))


def drives(
    watched: Watched, name: str, *, ago_s: float = 0.0, lag_s: float = 0.1, channels: int = 4
) -> list[str | None]:
    """Five seconds of a truck: 20 batches and 10 fixes a second."""
    names = ("sprung_front", "sprung_rear", "unsprung_front", "unsprung_rear")[:channels]
    said = []
    for number in range(100):
        since_s = ago_s + 4.95 - 0.05 * number
        time_ns = NOW_NS - round((since_s + lag_s + 0.05) * 1e9)
        batch = {one: Channel(1000.0, np.zeros(50)) for one in names}
        payload = encode_accel(AccelBatch(1, number, number, time_ns, batch))
        said.append(tell(watched, heard("vehicle", name, "accel", payload), since_s))
        if number % 2 == 0:
            fix = encode_gnss(GnssFix(1, number, number, time_ns, 36.0, 140.0, 20.0, 9.8))
            said.append(tell(watched, heard("vehicle", name, "gnss", fix), since_s))
    return said


def state(crossing_id: str, which: pb.CrossingState, vehicle: str, entry: float) -> Heard:
    entry_ns = 1_790_000_000_000_000_000 + round(entry * 1e9)
    message = pb.Crossing(
        schema_version=1, crossing_id=crossing_id, vehicle=vehicle, bridge="bridge-1",
        direction=pb.START_TO_END, state=which, time_ns=entry_ns, entry_time_ns=entry_ns,
    )  # fmt: skip
    return heard("bridge", "bridge-1", "crossing", message.SerializeToString())


def result(site: Site, name: str, vehicle: str = "truck-1", **changes: Any) -> Crossing:
    """With priors, as method pre gives them."""
    given = results_of(site, some_crossing(name, **changes)).crossings[0].model_dump()
    nominal = site.bridges[0].nominal_flexural_rigidity_nm2[0]
    for one, value in (given["parameters"] or {}).items():
        if one.startswith("EI_"):
            value["prior"] = {"distribution": "log_normal", "location": nominal, "scale": 0.55}
    return Crossing.model_validate({**given, "vehicle": vehicle})


def estimate(crossing: Crossing) -> Heard:
    payload = crossing_to_protobuf(crossing, HEADER).SerializeToString()
    return heard("bridge", crossing.bridge, "estimate", payload)


def bridge_state(site: Site) -> Heard:
    found = results_of(site, some_crossing("a"), used="a").bridges["bridge-1"]
    used = ("a", "b", "c")
    fused = found.model_copy(
        update={
            "verdict": "good",
            "crossings_used": used,
            "finding": "Element 4, 12.9 to 17.1 m: 60 % less stiff than the other elements, "
            "interval 57 to 62 %. All others agree within 3 %.",
        }
    )
    payload = bridge_to_protobuf("bridge-1", NOW_NS, fused).SerializeToString()
    return heard("bridge", "bridge-1", "state", payload)


def alarm(bridge: str = "bridge-1", *, by: str = "", raised: float = 1.7899e9) -> Heard:
    """Element 4 has lost a tenth; acknowledged if it is said by whom."""
    note = Acknowledgement(by=by, time=raised + 1.0) if by else None
    found = Alarm(
        alarm_id=f"a-{raised:.0f}", realm="live", bridge=bridge, element=4, direction="weaker",
        since=1.7878e9, raised=raised, sum=11.0, threshold=9.3, ratio=0.9, ratio_q025=0.88,
        ratio_q975=0.92, acknowledged=note,
    )  # fmt: skip
    return heard("bridge", bridge, "alarm", encode_alarm(found, NOW_NS))


def health(name: str, *, ok: bool = True, note: str = "", **figures: float) -> Heard:
    message = pb.Health(
        schema_version=1, time_ns=NOW_NS - 12_000_000_000, service=name, ok=ok,
        figures=figures, note=note,
    )  # fmt: skip
    return heard("service", name, "health", message.SerializeToString())


def progress(name: str, crossing_id: str, stage: str, fraction: float) -> Heard:
    message = pb.Progress(
        schema_version=1, time_ns=NOW_NS, crossing_id=crossing_id, stage=stage, fraction=fraction
    )
    return heard("service", name, "progress", message.SerializeToString())


def a_morning(site: Site) -> Watched:
    """Three trucks, one of them gone; crossings good, doubtful, rejected and on their way."""
    watched = Watched()
    drives(watched, "truck-1")
    drives(watched, "truck-2", lag_s=0.4)
    drives(watched, "truck-3", ago_s=300.0)
    for number, entry in enumerate((0.0, 90.0, 180.0)):
        tell(watched, estimate(result(site, f"good-{number}", entry=entry)))
    doubtful = result(
        site, "b", "truck-2", verdict="suspect", reasons=("model_misfit",), entry=240.0
    )
    tell(watched, estimate(doubtful))
    bad = result(
        site, "c", "truck-3", verdict="rejected", reasons=("channel_missing",), entry=300.0
    )
    tell(watched, estimate(bad))
    tell(watched, bridge_state(site))
    tell(watched, state("d", pb.DETECTED, "truck-1", 550.0))
    tell(watched, state("d", pb.COMPLETE, "truck-1", 550.0))
    tell(watched, state("d", pb.IDENTIFYING, "truck-1", 550.0))
    tell(watched, progress("worker", "d", "sampling", 0.45))
    tell(watched, state("e", pb.DETECTED, "truck-2", 596.0))
    tell(watched, health("logger", rate_per_s=120.0, queue=3.0, lost=0.0, dropped=0.0))
    tell(watched, health("worker", queue=14.0))
    return watched
