"""A morning in a realm, as messages: what `driveby watch` is shown in tests and pictures."""

from typing import Any

import numpy as np

from schemas.alarms import Acknowledgement, Alarm, encode_alarm
from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult, ResultHeader
from schemas.results_on_the_wire import bridge_to_protobuf, crossing_to_protobuf
from schemas.signals import AccelBatch, AccelChannel, GnssFix, Identity, encode_accel, encode_gnss
from schemas.site import Site
from schemas.topics import Key
from services.bus.realm_listener import BusMessage
from services.cli.realm_model import RealmModel
from tests.unit.viewer.found import RATIOS, results_of, some_crossing

NOW_NS = 1_790_000_600_000_000_000
NOW_S = 5000.0
HEADER = ResultHeader("0.1.0", 1.79e9, "hash", {}, 1)


class Listened:
    """What a page wants to know of a `Listening`."""

    def __init__(self, realm: str = "live", alive: set[str] | None = None) -> None:
        self.realm = realm
        self.alive = alive or set()
        self.elsewhere: dict[str, set[str]] = {}
        self.lost_s: float | None = None
        self.gone_s: dict[str, float] = {}


def heard(owner: Any, name: str, stream: str, payload: bytes) -> BusMessage:
    return BusMessage(Key("live", owner, name, stream), Identity(1, 0), payload)


def deliver(watched: RealmModel, message: BusMessage, ago_s: float = 0.0) -> str | None:
    """A message that came so long before now."""
    return watched.ingest(message, NOW_S - ago_s, NOW_NS - round(ago_s * 1e9))


def drives(
    watched: RealmModel, name: str, *, ago_s: float = 0.0, lag_s: float = 0.1, channels: int = 4
) -> list[str | None]:
    """Five seconds of a truck: 20 batches and 10 fixes a second."""
    names = ("sprung_front", "sprung_rear", "unsprung_front", "unsprung_rear")[:channels]
    output = []
    for number in range(100):
        since_s = ago_s + 4.95 - 0.05 * number
        time_ns = NOW_NS - round((since_s + lag_s + 0.05) * 1e9)
        batch = {one: AccelChannel(1000.0, np.zeros(50)) for one in names}
        payload = encode_accel(AccelBatch(1, number, number, time_ns, batch))
        output.append(deliver(watched, heard("vehicle", name, "accel", payload), since_s))
        if number % 2 == 0:
            fix = encode_gnss(GnssFix(1, number, number, time_ns, 36.0, 140.0, 20.0, 9.8))
            output.append(deliver(watched, heard("vehicle", name, "gnss", fix), since_s))
    return output


def state(
    crossing_id: str,
    which: pb.CrossingState,
    vehicle: str,
    entry: float,
    bridge: str = "bridge-1",
) -> BusMessage:
    entry_ns = 1_790_000_000_000_000_000 + round(entry * 1e9)
    message = pb.Crossing(
        schema_version=1, crossing_id=crossing_id, vehicle=vehicle, bridge=bridge,
        direction=pb.START_TO_END, state=which, time_ns=entry_ns, entry_time_ns=entry_ns,
    )  # fmt: skip
    return heard("bridge", bridge, "crossing", message.SerializeToString())


def result(
    site: Site,
    name: str,
    vehicle: str = "truck-1",
    *,
    bridge: str = "bridge-1",
    ratios: np.ndarray = RATIOS,
    **changes: Any,
) -> CrossingResult:
    """With priors, as method pre gives them."""
    found = results_of(site, some_crossing(name, **changes), ratios=ratios)
    given = found.crossings[0].model_dump() | {"vehicle": vehicle, "bridge": bridge}
    nominal = site.bridges[0].nominal_flexural_rigidity_nm2[0]
    for one, value in (given["parameters"] or {}).items():
        if one.startswith("EI_"):
            value["prior"] = {"distribution": "log_normal", "location": nominal, "scale": 0.55}
    return CrossingResult.model_validate(given)


def estimate(crossing: CrossingResult) -> BusMessage:
    payload = crossing_to_protobuf(crossing, HEADER).SerializeToString()
    return heard("bridge", crossing.bridge, "estimate", payload)


WEAK_FINDING = (
    "Element 4 (12.9 to 17.1 m) is 60 % less stiff than the other elements "
    "(95 % interval 57 to 62 %). No other element differs clearly (estimates differ "
    "by up to 3 %). A loss of 16 % in any of these elements is detected with 95 % probability."
)


def bridge_state(
    site: Site,
    bridge: str = "bridge-1",
    finding: str = WEAK_FINDING,
    *,
    crossings: int = 3,
    ratios: np.ndarray = RATIOS,
) -> BusMessage:
    found = results_of(site, some_crossing("a"), used="a", ratios=ratios).bridges["bridge-1"]
    used = tuple(f"c-{n}" for n in range(crossings))
    changes = {"verdict": "good", "crossings_used": used, "finding": finding}
    message = bridge_to_protobuf(bridge, NOW_NS, found.model_copy(update=changes))
    return heard("bridge", bridge, "state", message.SerializeToString())


def alarm(
    bridge: str = "bridge-1",
    *,
    by: str = "",
    element: int = 4,
    since: float = 1.7878e9,
    raised: float = 1.7899e9,
) -> BusMessage:
    """An element has lost a tenth; acknowledged if it is said by whom."""
    note = Acknowledgement(by=by, time=raised + 1.0) if by else None
    found = Alarm(
        alarm_id=f"a-{raised:.0f}", realm="live", bridge=bridge, element=element,
        direction="weaker", since=since, raised=raised, sum=11.0, threshold=9.3, ratio=0.9,
        ratio_q025=0.88, ratio_q975=0.92, acknowledged=note,
    )  # fmt: skip
    return heard("bridge", bridge, "alarm", encode_alarm(found, NOW_NS))


def health(
    name: str, *, ok: bool = True, note: str = "", ended: bool = False, **figures: float
) -> BusMessage:
    message = pb.Health(
        schema_version=1, time_ns=NOW_NS - 12_000_000_000, service=name, ok=ok,
        figures=figures, note=note, ended=ended,
    )  # fmt: skip
    return heard("service", name, "health", message.SerializeToString())


def progress(name: str, crossing_id: str, stage: str, fraction: float) -> BusMessage:
    message = pb.Progress(
        schema_version=1, time_ns=NOW_NS, crossing_id=crossing_id, stage=stage, fraction=fraction
    )
    return heard("service", name, "progress", message.SerializeToString())


def a_morning(site: Site) -> RealmModel:
    """Three trucks, one of them gone; crossings good, doubtful, rejected and on their way."""
    watched = RealmModel()
    drives(watched, "truck-1")
    drives(watched, "truck-2", lag_s=0.4)
    drives(watched, "truck-3", ago_s=300.0)
    for number, entry in enumerate((0.0, 90.0, 180.0)):
        deliver(watched, estimate(result(site, f"good-{number}", entry=entry)))
    doubtful = result(
        site, "b", "truck-2", verdict="suspect", reasons=("model_misfit",), entry=240.0
    )
    deliver(watched, estimate(doubtful))
    bad = result(
        site, "c", "truck-3", verdict="rejected", reasons=("channel_missing",), entry=300.0
    )
    deliver(watched, estimate(bad))
    deliver(watched, bridge_state(site))
    deliver(watched, state("d", pb.DETECTED, "truck-1", 550.0))
    deliver(watched, state("d", pb.COMPLETE, "truck-1", 550.0))
    deliver(watched, state("d", pb.IDENTIFYING, "truck-1", 550.0))
    deliver(watched, progress("worker", "d", "sampling", 0.45))
    deliver(watched, state("e", pb.DETECTED, "truck-2", 596.0))
    deliver(watched, health("logger", rate_per_s=120.0, queue=3.0, lost=0.0, dropped=0.0))
    deliver(watched, health("worker", queue=14.0, identifying=1.0, identifying_longest_s=8.0))
    return watched


def a_fleet(site: Site) -> RealmModel:
    """Three trucks and four bridges: an alarm of one stands, that of another is acknowledged."""
    watched = RealmModel()
    drives(watched, "truck-1")
    drives(watched, "truck-2", lag_s=0.4)
    drives(watched, "truck-3", ago_s=300.0)
    rng = np.random.default_rng(4)
    quiet = (
        "No element differs clearly from the others (estimates differ by up to {} %). "
        "A loss of 14 % in any of these elements is detected with 95 % probability."
    )
    for number, bridge in enumerate(("bridge-02", "bridge-03", "bridge-11", "bridge-07")):
        ratios = 1.0 + 0.012 * rng.standard_normal(7)
        is_weak = bridge == "bridge-07"
        ratios[3] *= 0.8 if is_weak else 1.0
        finding = quiet.format(2 + number)
        if is_weak:
            finding = (
                "Element 4 (12.9 to 17.1 m) is 20 % less stiff than the other elements "
                "(95 % interval 16 to 24 %). No other element differs clearly (estimated at "
                "most 3 %). A loss of 14 % in any of these elements is detected "
                "with 95 % probability."
            )
        of = {"bridge": bridge, "ratios": ratios}
        who = f"truck-{number % 3 + 1}"
        deliver(watched, estimate(result(site, f"{bridge}-a", who, entry=90.0 * number, **of)))
        crossings = 40 + 7 * number
        deliver(watched, bridge_state(site, bridge, finding, crossings=crossings, ratios=ratios))
    rejected = {"verdict": "rejected", "reasons": ("channel_missing",), "entry": 330.0}
    deliver(watched, estimate(result(site, "c", "truck-3", bridge="bridge-03", **rejected)))
    for which in (pb.DETECTED, pb.COMPLETE, pb.IDENTIFYING):
        deliver(watched, state("d", which, "truck-1", 550.0, "bridge-11"))
    deliver(watched, progress("worker", "d", "sampling", 0.45))
    deliver(watched, state("e", pb.DETECTED, "truck-2", 596.0, "bridge-07"))
    deliver(watched, alarm("bridge-03", by="the owner", element=2, since=1.7809e9, raised=1.783e9))
    deliver(watched, alarm("bridge-07"))
    deliver(watched, health("logger", rate_per_s=120.0, queue=3.0, lost=0.0, dropped=0.0))
    deliver(watched, health("worker", queue=14.0, identifying=1.0, identifying_longest_s=8.0))
    return watched
