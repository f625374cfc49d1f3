"""Recordings of many drives, made from one: the same crossing again and again, at other times."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from schemas.signals import (
    NS_PER_S,
    AccelBatch,
    GnssFix,
    VehicleInfo,
    decode_accel,
    decode_gnss,
    decode_info,
    encode_accel,
    encode_gnss,
    encode_info,
)
from schemas.topics import Message
from services.recordings.recording import read_messages, read_site
from services.recordings.writer import RecordingOrigin, RecordingWriter

SAMPLE = Path(__file__).parents[1] / "recordings" / "sample" / "crossing.mcap"
EXACT = Path(__file__).parent / "data" / "noise_free.mcap"
"""For least squares: 0.1 s a crossing and not one."""
APART_NS = 600 * NS_PER_S
AnySignal = AccelBatch | GnssFix | VehicleInfo
_DECODE: dict[str, Callable[[bytes], AnySignal]] = {
    "accel": decode_accel,
    "gnss": decode_gnss,
    "info": decode_info,
}


def drives(folder: Path, crossings: int, each: int = 1, source: Path = EXACT) -> list[Path]:
    """Write so many crossings, `each` in a recording, ten minutes apart; the recordings."""
    folder.mkdir(parents=True, exist_ok=True)
    once = [
        (message, _DECODE[message.key.stream](message.payload))
        for message in read_messages(source)
        if message.key.stream in _DECODE
    ]
    site = read_site(source)
    paths = []
    for first in range(0, crossings, each):
        path = folder / f"drive-{first:05d}.mcap"
        key = once[0][0].key
        writer = RecordingWriter(
            path, reason="test", origin=RecordingOrigin(key.realm, key.identifier, site)
        )
        for number in range(first, min(first + each, crossings)):
            for message in _later(once, number):
                writer.write(message)
        writer.finish("done")
        paths.append(path)
    return paths


def _later(once: list[tuple[Message, AnySignal]], number: int) -> Iterator[Message]:
    """The messages of a drive `number` times ten minutes later, as of another boot."""
    by = number * APART_NS
    for message, output in once:
        boot_id = message.boot_id + number
        times: dict[str, Any] = {"boot_id": boot_id, "wall_time_ns": output.wall_time_ns + by}
        match output:
            case AccelBatch():
                payload = encode_accel(output._replace(**times))
            case GnssFix():
                payload = encode_gnss(output._replace(**times))
            case VehicleInfo():
                payload = encode_info(output._replace(**times))
        yield message._replace(
            payload=payload,
            boot_id=boot_id,
            log_time_ns=message.log_time_ns + by,
            publish_time_ns=message.publish_time_ns + by,
        )
