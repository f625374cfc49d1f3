"""What it costs to find crossings: an hour of one truck, among few bridges and among thousands.

    python -m tests.benchmarks.detection [--minutes 60] [--bridges 10 10000]

A truck drives along a straight road with a bridge every few minutes, which are the site's first
bridges; all others lie anywhere in a region of 100 km, a kilometre from the road or more. Printed
is the processor time of the part that finds crossings in positions (`Engine`, every fix noted and
fed), and of taking in the batches of accelerations. Nothing is identified.
"""

import argparse
import time
from collections.abc import Iterator, Sequence

import numpy as np

from schemas.results import ResultHeader
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS
from schemas.site import Bridge, Site
from schemas.site_file import site_hash
from schemas.topics import Message
from services.common.geodesy import bridge_frame, to_lat_lon
from services.drives.runs import GnssTrack, Run, run_to_messages
from services.identification.engine import Engine
from services.identification.outputs import IdentificationTask
from services.simulation.drive import paper_site

SPEED_M_PER_S = 20.0
ON_THE_ROAD = 10
_FIRST_M = 1000.0
_PIECE_S = 300.0
"""The drive is made in such pieces: an hour of samples need not be held."""
_START_S = 1_767_225_600.0


def site_of(bridges: int, minutes: float) -> Site:
    """So many bridges: the first ten on the road, the others anywhere around."""
    paper = paper_site()
    one = paper.bridges[0]
    length_m = SPEED_M_PER_S * 60.0 * minutes
    frame = bridge_frame(one)
    rng = np.random.default_rng(1)
    on_road = _FIRST_M + np.arange(ON_THE_ROAD) * (length_m - 2.0 * _FIRST_M) / ON_THE_ROAD
    found: list[Bridge] = []
    for n in range(bridges):
        along, aside = (on_road[n], 0.0) if n < ON_THE_ROAD else rng.uniform(-5e4, 5e4, 2)
        aside += 0.0 if n < ON_THE_ROAD else np.copysign(1000.0, aside)
        (a_lat, b_lat), (a_lon, b_lon) = to_lat_lon(frame, [along, along + one.span_m], aside)
        ends = {
            "start_latitude_deg": float(a_lat),
            "start_longitude_deg": float(a_lon),
            "end_latitude_deg": float(b_lat),
            "end_longitude_deg": float(b_lon),
        }
        found.append(one.model_copy(update={"id": f"bridge-{n}", **ends}))
    return paper.model_copy(update={"bridges": tuple(found)})


def drive(site: Site, minutes: float) -> Iterator[Message]:
    """The messages of a truck that drives along the road of `site_of`."""
    frame = bridge_frame(paper_site().bridges[0])
    rng = np.random.default_rng(2)
    numbers: dict[str, int] = {}
    for piece in range(int(np.ceil(60.0 * minutes / _PIECE_S))):
        accel = piece * _PIECE_S + np.arange(round(50.0 * _PIECE_S)) / 50.0
        fixes = piece * _PIECE_S + np.arange(round(10.0 * _PIECE_S)) / 10.0
        latitude, longitude = to_lat_lon(
            frame, SPEED_M_PER_S * fixes + 0.4 * rng.standard_normal(fixes.size)
        )
        speed, height = np.full(fixes.size, SPEED_M_PER_S), np.full(fixes.size, 5.0)
        track = GnssTrack(_START_S + fixes, latitude, longitude, height, speed, None)
        noise = {name: rng.standard_normal(accel.size) for name in CHANNELS}
        run = Run("made up", _START_S + accel, 50.0, noise, track)
        for message in run_to_messages([run], site, "sim-detection", site.vehicles[0].id):
            yield _of_one_boot(message, numbers)


def _of_one_boot(message: Message, numbers: dict[str, int]) -> Message:
    """The same message in the one boot of the whole drive."""
    from schemas import signals

    stream = message.key.stream
    if stream not in ("accel", "gnss"):
        return message._replace(boot_id=1)
    sequence = numbers[stream] = numbers.get(stream, -1) + 1
    time_ns = message.log_time_ns - round(_START_S * 1e9)
    same = {"boot_id": 1, "sequence": sequence, "device_time_ns": time_ns}
    if stream == "accel":
        payload = signals.encode_accel(signals.decode_accel(message.payload)._replace(**same))
    else:
        payload = signals.encode_gnss(signals.decode_gnss(message.payload)._replace(**same))
    return message._replace(payload=payload, boot_id=1, sequence=sequence)


def measure(bridges: int, minutes: float) -> dict[str, float]:
    """Crossings found, and processor time in s by stream, of a drive among so many bridges."""
    site = site_of(bridges, minutes)
    settings = IdentificationSettings(method="least_squares")
    header = ResultHeader(
        "0", 0.0, site_hash(site), settings.model_dump(mode="json"), settings.seed
    )
    engine = Engine(site, settings, header)
    spent = {"gnss": 0.0, "accel": 0.0}
    works = 0
    for message in drive(site, minutes):
        stream = message.key.stream
        if stream not in spent:
            continue
        began = time.thread_time()
        engine.expect(message.key, message.payload)
        works += sum(
            isinstance(s, IdentificationTask) for s in engine.feed(message.key, message.payload)
        )
        spent[stream] += time.thread_time() - began
    return {"crossings": works, **spent}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--bridges", type=int, nargs="+", default=[10, 10_000])
    options = parser.parse_args(arguments)
    for bridges in options.bridges:
        found = measure(bridges, options.minutes)
        per_hour = 60.0 / options.minutes
        print(
            f"{bridges} bridges: {found['crossings']:.0f} crossings found in "
            f"{options.minutes:g} minutes of driving; an hour's positions take "
            f"{per_hour * found['gnss']:.2f} s of processor time, its batches of accelerations "
            f"{per_hour * found['accel']:.2f} s"
        )


if __name__ == "__main__":
    main()
