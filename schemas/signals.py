"""Sensor messages between numpy and Protocol Buffers. No I/O.

Whatever bytes it is given, `decode_*` raises nothing but ValueError in one line: malformed, another
schema version, not finite, or impossible. `encode_*` refuses with ValueError everything that
`decode_*` would refuse.
"""

import math
import struct
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError, Message

from schemas.proto import driveby_pb2 as pb
from schemas.topics import check_identifier

SCHEMA_VERSION = 1
CHANNELS = ("sprung_front", "sprung_rear", "unsprung_front", "unsprung_rear")

MAX_CHANNELS = 32
"""Largest number of accelerometers on one truck."""
MAX_RATE_HZ = 50_000.0
MAX_BATCH_S = 1.0
"""Longest batch: ten times the usual 50-100 ms, which still bounds the memory of one message."""
MAX_ACCELERATION_M_PER_S2 = 1e4
"""Largest acceleration, about 1000 g: more is another unit or a broken sensor."""
MAX_SEQUENCE = 2**32 - 1
"""Largest sequence, 32 bits in MCAP: six years of batches without a restart."""
NS_PER_S = 1_000_000_000
MAX_BOOT_ID = 2**64 - 1
EARLIEST_WALL_TIME_NS = 946_684_800_000_000_000  # 2000-01-01
LATEST_WALL_TIME_NS = 7_258_118_400_000_000_000  # 2200-01-01
MAX_SITE_BYTES = 1 << 16

_POSITIONS = {
    "sprung_front": pb.SPRUNG_FRONT,
    "sprung_rear": pb.SPRUNG_REAR,
    "unsprung_front": pb.UNSPRUNG_FRONT,
    "unsprung_rear": pb.UNSPRUNG_REAR,
}
ACCEL_NAMES: dict[int, str] = {position: name for name, position in _POSITIONS.items()}
"""Name of a channel by its position in the protobuf message."""
_POSITION_BYTES, _RATE_BYTES, _TAG_BYTES = 2, 9, 1
"""Encoded size of a position, of a rate, and of the tag of samples or of a name."""
_FLOAT64 = np.dtype("<f8")
_IDENTITY = struct.Struct("!QQ")


class Identity(NamedTuple):
    """The fields that, with realm, vehicle and stream, identify a message."""

    boot_id: int
    sequence: int


class Stamp(NamedTuple):
    """Creation time and identity of a message."""

    wall_time_ns: int
    device_time_ns: int | None = None
    """Time of the sender's monotonic clock; None where the message has none."""
    identity: Identity | None = None
    """Identity in the payload itself; None where it has none."""


class AccelChannel(NamedTuple):
    """Evenly spaced samples (n,) of one accelerometer, m/s², up positive, without gravity."""

    rate_hz: float
    samples: npt.NDArray[np.float64]


Channel = AccelChannel
"""The former name, which drivers of trucks import."""


class AccelBatch(NamedTuple):
    """Some 50-100 ms of all accelerometers of one truck; both times are of each first sample."""

    boot_id: int
    sequence: int
    device_time_ns: int
    wall_time_ns: int
    channels: dict[str, AccelChannel]


class GnssFix(NamedTuple):
    """One fix. Accuracies are one standard deviation; None where unknown."""

    boot_id: int
    sequence: int
    device_time_ns: int
    wall_time_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    speed_m_per_s: float
    heading_deg: float | None = None
    horizontal_accuracy_m: float | None = None
    vertical_accuracy_m: float | None = None
    speed_accuracy_m_per_s: float | None = None


class VehicleInfo(NamedTuple):
    """The truck's own parts of a site file, as TOML."""

    boot_id: int
    sequence: int
    device_time_ns: int
    wall_time_ns: int
    vehicle_id: str
    site_toml: str


def encode_accel(batch: AccelBatch) -> bytes:
    """Return the AccelBatch message."""
    _check_accel(batch)
    message = pb.AccelBatch(schema_version=SCHEMA_VERSION, **_header(batch))
    for name in in_order(batch.channels):
        rate_hz, samples = batch.channels[name]
        message.channels.add(
            position=_POSITIONS.get(name, pb.SENSOR_POSITION_UNSPECIFIED),
            name="" if name in _POSITIONS else name,
            rate_hz=rate_hz,
            acceleration_m_per_s2=samples.tolist(),
        )
    return message.SerializeToString(deterministic=True)


def decode_accel(payload: bytes) -> AccelBatch:
    """Return the batch of an AccelBatch message; raise ValueError if malformed or impossible."""
    message = pb.AccelBatch()
    _parse(message, payload)
    if len(message.channels) > MAX_CHANNELS:
        raise ValueError(f"{len(message.channels)} channels; at most {MAX_CHANNELS}")
    channels: dict[str, AccelChannel] = {}
    for channel in message.channels:
        name = _name(channel)
        if name in channels:
            raise ValueError(f"channel {name} is there twice")
        channels[name] = AccelChannel(channel.rate_hz, _samples(channel))
    batch = AccelBatch(
        message.boot_id, message.sequence, message.device_time_ns, message.wall_time_ns, channels
    )
    _check_accel(batch)
    return batch


def encode_gnss(fix: GnssFix) -> bytes:
    """Return the GnssFix message."""
    _check_gnss(fix)
    message = pb.GnssFix(
        schema_version=SCHEMA_VERSION,
        **_header(fix),
        latitude_deg=fix.latitude_deg,
        longitude_deg=fix.longitude_deg,
        altitude_m=fix.altitude_m,
        speed_m_per_s=fix.speed_m_per_s,
        heading_deg=fix.heading_deg,
        horizontal_accuracy_m=fix.horizontal_accuracy_m,
        vertical_accuracy_m=fix.vertical_accuracy_m,
        speed_accuracy_m_per_s=fix.speed_accuracy_m_per_s,
    )
    return message.SerializeToString(deterministic=True)


def decode_gnss(payload: bytes) -> GnssFix:
    """Return the fix of a GnssFix message; raise ValueError if malformed or impossible."""
    message = pb.GnssFix()
    _parse(message, payload)
    optional = {
        name: getattr(message, name) if message.HasField(name) else None for name in _GNSS_OPTIONAL
    }
    fix = GnssFix(
        message.boot_id,
        message.sequence,
        message.device_time_ns,
        message.wall_time_ns,
        message.latitude_deg,
        message.longitude_deg,
        message.altitude_m,
        message.speed_m_per_s,
        **optional,
    )
    _check_gnss(fix)
    return fix


def encode_info(info: VehicleInfo) -> bytes:
    """Return the VehicleInfo message."""
    _check_info(info)
    message = pb.VehicleInfo(
        schema_version=SCHEMA_VERSION,
        **_header(info),
        vehicle_id=info.vehicle_id,
        site_toml=info.site_toml,
    )
    return message.SerializeToString(deterministic=True)


def decode_info(payload: bytes) -> VehicleInfo:
    """Return the content of a VehicleInfo message; raise ValueError if it is malformed.

    The reader of site files checks whether `site_toml` is a valid one.
    """
    message = pb.VehicleInfo()
    _parse(message, payload)
    info = VehicleInfo(
        message.boot_id,
        message.sequence,
        message.device_time_ns,
        message.wall_time_ns,
        message.vehicle_id,
        message.site_toml,
    )
    _check_info(info)
    return info


TRUCK_DECODERS: Final[Mapping[str, Callable[[bytes], AccelBatch | GnssFix | VehicleInfo]]] = {
    "accel": decode_accel,
    "gnss": decode_gnss,
    "info": decode_info,
}
"""Decoders of the truck's streams that identification uses, by stream."""


@cache
def location_class() -> type[Message]:
    """Return the class foxglove.LocationFix, imported here because few callers need it."""
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

    return LocationFix


def encode_location(fix: GnssFix) -> bytes:
    """Return the fix as foxglove.LocationFix, which Rerun and Foxglove draw on a map."""
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

    _check_gnss(fix)
    message = LocationFix(
        frame_id="gnss",
        latitude=fix.latitude_deg,
        longitude=fix.longitude_deg,
        altitude=fix.altitude_m,
    )
    message.timestamp.seconds, message.timestamp.nanos = divmod(fix.wall_time_ns, NS_PER_S)
    if fix.heading_deg is not None:
        message.heading = math.radians(fix.heading_deg)
    if fix.horizontal_accuracy_m is not None and fix.vertical_accuracy_m is not None:
        east = fix.horizontal_accuracy_m**2
        up = fix.vertical_accuracy_m**2
        message.position_covariance.extend([east, 0, 0, 0, east, 0, 0, 0, up])
        message.position_covariance_type = LocationFix.DIAGONAL_KNOWN
    return message.SerializeToString(deterministic=True)


def check_location(payload: bytes) -> int:
    """Return the wall time in ns of a foxglove.LocationFix; raise ValueError if impossible."""
    message: Any = location_class()()
    try:
        message.ParseFromString(payload)
    except DecodeError as error:
        raise ValueError(f"not a foxglove.LocationFix: {error}") from None
    _check_position(message.latitude, message.longitude, message.altitude)
    return check_wall_time(message.timestamp.seconds * NS_PER_S + message.timestamp.nanos)


def encode_identity(boot_id: int, sequence: int) -> bytes:
    """Return the 16 bytes of a Zenoh attachment: two unsigned 64-bit big-endian integers."""
    _check_identity(boot_id, sequence)
    return _IDENTITY.pack(boot_id, sequence)


def decode_identity(attachment: bytes | None) -> Identity:
    """Return the identity in an attachment; raise ValueError if it is missing or malformed."""
    if attachment is None:
        raise ValueError("no attachment; 16 bytes with boot_id and sequence are expected")
    if len(attachment) != _IDENTITY.size:
        raise ValueError(f"attachment of {len(attachment)} bytes; {_IDENTITY.size} are expected")
    boot_id, sequence = _IDENTITY.unpack(attachment)
    _check_identity(boot_id, sequence)
    return Identity(boot_id, sequence)


def check_version(version: int) -> None:
    """Raise ValueError if this program cannot read messages of that schema version."""
    if version != SCHEMA_VERSION:
        raise ValueError(f"schema version {version}; this program reads {SCHEMA_VERSION}")


def check_wall_time(time_ns: int) -> int:
    """Return a time in ns since 1970 UTC between 2000 and 2200; raise ValueError for others."""
    if not EARLIEST_WALL_TIME_NS <= time_ns < LATEST_WALL_TIME_NS:
        raise ValueError(f"time {time_ns} ns is not between the years 2000 and 2200")
    return time_ns


_GNSS_OPTIONAL = (
    "heading_deg",
    "horizontal_accuracy_m",
    "vertical_accuracy_m",
    "speed_accuracy_m_per_s",
)


def _header(message: AccelBatch | GnssFix | VehicleInfo) -> dict[str, Any]:
    return {
        "boot_id": message.boot_id,
        "sequence": message.sequence,
        "device_time_ns": message.device_time_ns,
        "wall_time_ns": message.wall_time_ns,
    }


def _parse(message: pb.AccelBatch | pb.GnssFix | pb.VehicleInfo, payload: bytes) -> None:
    try:
        message.ParseFromString(payload)
    except DecodeError as error:
        raise ValueError(f"not a {message.DESCRIPTOR.full_name}: {error}") from None
    check_version(message.schema_version)


def _name(channel: pb.AccelChannel) -> str:
    """Return the name of a channel: that of its position if it is one of the four, else its own."""
    if channel.position == pb.SENSOR_POSITION_UNSPECIFIED and channel.name:
        return channel.name
    name = ACCEL_NAMES.get(channel.position)
    if name is None:
        raise ValueError(f"channel at unknown position {int(channel.position)}")
    if channel.name not in ("", name):
        raise ValueError(f"channel {name} has another name, {channel.name[:63]!r}, too")
    return name


def in_order(names: Iterable[str]) -> list[str]:
    """Return channel names in the order of every table: the four first, others alphabetically."""
    there = set(names)
    return [name for name in CHANNELS if name in there] + sorted(there - set(CHANNELS))


def _samples(channel: pb.AccelChannel) -> npt.NDArray[np.float64]:
    """Return the samples of a channel, shape (n,), m/s², as an array that is not writable.

    Encoded again, the samples are contiguous, before the name if there is one, and reading bytes is
    four times as fast as reading one number after the other. The length shows whether an unknown
    field follows them.
    """
    values = channel.acceleration_m_per_s2
    number = len(values)
    encoded = channel.SerializeToString()
    size = 8 * number
    varint_bytes = (size.bit_length() + 6) // 7
    name = len(channel.name.encode())  # at most 127, else the lengths disagree
    behind = _TAG_BYTES + 1 + name if name else 0
    before = (_POSITION_BYTES if channel.position else 0) + _RATE_BYTES + _TAG_BYTES + varint_bytes
    if number and len(encoded) == before + size + behind:
        return np.frombuffer(encoded, _FLOAT64, number, before)
    return np.array(values[:], np.float64)


def _check_identity(boot_id: int, sequence: int) -> None:
    if not 0 <= boot_id <= MAX_BOOT_ID:
        raise ValueError(f"boot_id {boot_id} does not fit 64 bits without sign")
    if not 0 <= sequence <= MAX_SEQUENCE:
        raise ValueError(f"sequence {sequence} is not between 0 and {MAX_SEQUENCE}")


def stamp(message: AccelBatch | GnssFix | VehicleInfo | pb.AccelBatch) -> Stamp:
    """Return the times and the identity of a truck's message."""
    identity = Identity(message.boot_id, message.sequence)
    return Stamp(message.wall_time_ns, message.device_time_ns, identity)


def check_header(message: AccelBatch | GnssFix | VehicleInfo | pb.AccelBatch) -> None:
    """Raise ValueError if the identity or a time of a truck's message is impossible."""
    _check_identity(message.boot_id, message.sequence)
    if not 0 <= message.device_time_ns < 2**63:
        raise ValueError(f"device time {message.device_time_ns} ns is negative or too large")
    check_wall_time(message.wall_time_ns)


def check_channel(name: str, rate_hz: float, samples: int) -> None:
    """Raise ValueError if a channel cannot have `samples` samples at that rate in one batch."""
    check_identifier(name)
    if not 0.0 < rate_hz <= MAX_RATE_HZ:
        raise ValueError(f"{name}: rate {rate_hz} Hz is not between 0 and {MAX_RATE_HZ:.0f}")
    if not samples:
        raise ValueError(f"{name}: no sample")
    # The rounding of n/rate must not refuse a batch of exactly one second.
    if samples > MAX_BATCH_S * rate_hz * (1 + 1e-9) and samples > 1:
        raise ValueError(f"{name}: {samples} samples at {rate_hz} Hz exceed one second")


def _check_accel(batch: AccelBatch) -> None:
    check_header(batch)
    if not batch.channels:
        raise ValueError("no channel")
    if len(batch.channels) > MAX_CHANNELS:
        raise ValueError(f"{len(batch.channels)} channels; at most {MAX_CHANNELS}")
    for name, (rate_hz, samples) in batch.channels.items():
        if samples.ndim != 1:
            raise ValueError(f"{name}: samples of shape {samples.shape}; (n,) is expected")
        check_channel(name, rate_hz, samples.size)
        if not np.abs(samples).max() <= MAX_ACCELERATION_M_PER_S2:  # false for a NaN, too
            raise ValueError(
                f"{name}: a sample is not finite or exceeds {MAX_ACCELERATION_M_PER_S2:.0f} m/s²"
            )


def _check_position(latitude_deg: float, longitude_deg: float, altitude_m: float) -> None:
    _check_range("latitude_deg", latitude_deg, -90.0, 90.0)
    _check_range("longitude_deg", longitude_deg, -180.0, 180.0)
    if not math.isnan(altitude_m):  # NaN: the receiver gives none
        _check_range("altitude_m", altitude_m, -1000.0, 20_000.0)


def _check_gnss(fix: GnssFix) -> None:
    check_header(fix)
    _check_position(fix.latitude_deg, fix.longitude_deg, fix.altitude_m)
    _check_range("speed_m_per_s", fix.speed_m_per_s, -200.0, 200.0)
    if fix.heading_deg is not None:
        _check_range("heading_deg", fix.heading_deg, -360.0, 360.0)
    for name in _GNSS_OPTIONAL[1:]:
        value = getattr(fix, name)
        if value is not None:
            _check_range(name, value, 0.0, 1e6)


def _check_info(info: VehicleInfo) -> None:
    check_header(info)
    check_identifier(info.vehicle_id)
    size = len(info.site_toml.encode())
    if size > MAX_SITE_BYTES:
        raise ValueError(f"site_toml of {size} bytes; at most {MAX_SITE_BYTES}")


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:  # false for NaN too
        raise ValueError(f"{name} {value} is not between {low:g} and {high:g}")
