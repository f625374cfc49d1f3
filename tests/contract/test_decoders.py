"""Decoders take any bytes: a message or a ValueError of one line, never anything else."""

import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import events, signals
from schemas.messages import check_stamp, decode
from schemas.proto import driveby_pb2 as pb
from schemas.topics import TOPICS, Topic, topic

TIME_NS = 1_700_000_000_000_000_000
BATCH = signals.AccelBatch(
    1,
    2,
    3,
    TIME_NS,
    {name: signals.AccelChannel(1000.0, np.arange(50.0)) for name in signals.CHANNELS},
)
FIX = signals.GnssFix(1, 2, 3, TIME_NS, 52.5, 13.4, 34.0, 10.0, 359.0, 0.5, 1.0, 0.05)
INFO = signals.VehicleInfo(1, 2, 3, TIME_NS, "truck-1", "[vehicle]\n")
EVENT = events.Event(events.EventKind.GAP, TIME_NS, "text", "truck-1", "accel", 1, 2, 3, 2)
VALID = {
    "accel": signals.encode_accel(BATCH),
    "gnss": signals.encode_gnss(FIX),
    "location": signals.encode_location(FIX),
    "info": signals.encode_info(INFO),
    "event": events.encode_event(EVENT),
}
WITH_MESSAGE = [row for row in TOPICS if row.message]

finite = st.floats(-1e4, 1e4)
u64 = st.integers(0, 2**64 - 1)
headers = st.tuples(
    u64,
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**63 - 1),
    st.integers(signals.EARLIEST_WALL_TIME_NS, signals.LATEST_WALL_TIME_NS - 1),
)


def one_line(call: Callable[[], Any]) -> None:
    refused = ""
    try:
        call()
    except ValueError as error:
        refused = str(error)
    assert "\n" not in refused


@given(st.sampled_from(WITH_MESSAGE), st.binary(max_size=300))
def test_any_bytes(row: Topic, payload: bytes) -> None:
    one_line(lambda: check_stamp(row, payload))
    one_line(lambda: decode(row.message, payload))


@given(st.sampled_from(sorted(VALID)), st.data())
def test_valid_bytes_with_one_changed_or_cut_off(stream: str, data: st.DataObject) -> None:
    payload = bytearray(VALID[stream])
    at = data.draw(st.integers(0, len(payload) - 1))
    payload[at] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    row = topic("service" if stream == "event" else "vehicle", stream)
    one_line(lambda: check_stamp(row, bytes(payload)))
    one_line(lambda: check_stamp(row, bytes(payload[:cut])))


@given(
    headers,
    st.dictionaries(
        st.sampled_from([*signals.CHANNELS, "axle_1_left", "a" * 63]),
        st.tuples(
            st.floats(100.0, signals.MAX_RATE_HZ), st.lists(finite, min_size=1, max_size=100)
        ),
        min_size=1,
    ),
)
def test_accel_round_trip(
    header: tuple[int, int, int, int], channels: dict[str, tuple[float, list[float]]]
) -> None:
    batch = signals.AccelBatch(
        *header,
        {name: signals.AccelChannel(rate, np.array(v)) for name, (rate, v) in channels.items()},
    )
    again = signals.decode_accel(signals.encode_accel(batch))
    assert again[:4] == batch[:4]
    assert set(again.channels) == set(batch.channels)
    for name, channel in batch.channels.items():
        assert again.channels[name].rate_hz == channel.rate_hz
        np.testing.assert_array_equal(again.channels[name].samples, channel.samples)


def test_the_four_channels_travel_as_before_names() -> None:
    """Bytes of a batch that the first version wrote: a position, a rate, one sample."""
    channel = b"\x08\x03\x11" + struct.pack("<d", 200.0) + b"\x1a\x08" + struct.pack("<d", 0.5)
    old = b"\x08\x01\x10\x01\x18\x02\x20\x03\x28" + _varint(TIME_NS) + b"\x32\x15" + channel
    batch = signals.decode_accel(old)
    assert batch.channels["unsprung_front"].samples.tolist() == [0.5]
    assert signals.encode_accel(batch) == old


def test_a_channel_has_one_name() -> None:
    message = pb.AccelBatch.FromString(VALID["accel"])
    message.channels[0].name = "axle_1_left"
    with pytest.raises(ValueError, match="sprung_front has another name, 'axle_1_left'"):
        signals.decode_accel(message.SerializeToString())


def test_a_batch_of_too_many_channels_is_refused() -> None:
    channel = signals.AccelChannel(200.0, np.array([0.5]))
    names = [f"a{k}" for k in range(signals.MAX_CHANNELS + 1)]
    batch = signals.AccelBatch(1, 2, 3, TIME_NS, dict.fromkeys(names, channel))
    with pytest.raises(ValueError, match="33 channels; at most 32"):
        signals.encode_accel(batch)


def _varint(number: int) -> bytes:
    parts = []
    while number >= 0x80:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*parts, number])


@given(
    headers,
    st.floats(-90, 90),
    st.floats(-180, 180),
    st.floats(-200, 200),
    st.none() | st.floats(0, 360),
    st.none() | st.floats(0, 100),
)
def test_gnss_round_trip(
    header: tuple[int, int, int, int],
    latitude: float,
    longitude: float,
    speed: float,
    heading: float | None,
    accuracy: float | None,
) -> None:
    fix = signals.GnssFix(
        *header, latitude, longitude, 12.5, speed, heading, accuracy, accuracy, None
    )
    assert signals.decode_gnss(signals.encode_gnss(fix)) == fix
    assert signals.check_location(signals.encode_location(fix)) == fix.wall_time_ns


def test_location_has_the_position_for_a_map() -> None:
    location: Any = decode("foxglove.LocationFix", signals.encode_location(FIX))
    assert (location.latitude, location.longitude, location.altitude) == (52.5, 13.4, 34.0)
    assert location.heading == pytest.approx(math.radians(359.0))
    assert list(location.position_covariance) == [0.25, 0, 0, 0, 0.25, 0, 0, 0, 1.0]


def test_info_and_event_round_trip() -> None:
    assert signals.decode_info(VALID["info"]) == INFO
    assert events.decode_event(VALID["event"]) == EVENT


@given(u64, st.integers(0, 2**32 - 1))
def test_identity_round_trip(boot_id: int, sequence: int) -> None:
    attachment = signals.encode_identity(boot_id, sequence)
    assert len(attachment) == 16
    assert signals.decode_identity(attachment) == (boot_id, sequence)


@given(st.none() | st.binary(max_size=40))
def test_any_attachment(attachment: bytes | None) -> None:
    one_line(lambda: signals.decode_identity(attachment))


def changed(**fields: Any) -> bytes:
    message = pb.AccelBatch.FromString(VALID["accel"])
    for name, value in fields.items():
        setattr(message, name, value)
    return message.SerializeToString()


def with_channel(**fields: Any) -> bytes:
    message = pb.AccelBatch.FromString(VALID["accel"])
    for name, value in fields.items():
        if name == "acceleration_m_per_s2":
            message.channels[0].ClearField(name)
            message.channels[0].acceleration_m_per_s2.extend(value)
        else:
            setattr(message.channels[0], name, value)
    return message.SerializeToString()


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\xff\xff", "not a driveby.v1.AccelBatch"),
        (b"", "schema version 0"),
        (changed(schema_version=2), "schema version 2"),
        (changed(wall_time_ns=0), "time 0 ns"),
        (changed(wall_time_ns=1_700_000_000), "2000 and 2200"),
        (changed(device_time_ns=-1), "device time -1"),
        (changed(sequence=2**40), "sequence"),
        (with_channel(rate_hz=0.0), "rate 0.0 Hz"),
        (with_channel(rate_hz=-1.0), "rate -1.0 Hz"),
        (with_channel(rate_hz=math.nan), "rate nan Hz"),
        (with_channel(rate_hz=1e9), "rate 1000000000.0 Hz"),
        (with_channel(rate_hz=10.0), "exceed one second"),
        (with_channel(position=0), "unknown position 0"),
        (with_channel(position=77), "unknown position 77"),
        (with_channel(position=2), "sprung_rear is there twice"),
        (with_channel(acceleration_m_per_s2=[]), "no sample"),
        (with_channel(acceleration_m_per_s2=[0.0, math.nan]), "not finite"),
        (with_channel(acceleration_m_per_s2=[math.inf]), "not finite"),
        (with_channel(acceleration_m_per_s2=[9806.65e3]), "exceeds"),
    ],
)
def test_impossible_accelerations(payload: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        signals.decode_accel(payload)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("latitude_deg", 90.1),
        ("latitude_deg", math.nan),
        ("longitude_deg", -180.1),
        ("altitude_m", math.inf),
        ("speed_m_per_s", math.nan),
        ("heading_deg", 1000.0),
        ("horizontal_accuracy_m", -1.0),
        ("speed_accuracy_m_per_s", math.nan),
    ],
)
def test_impossible_fixes_are_neither_read_nor_written(field: str, value: float) -> None:
    message = pb.GnssFix.FromString(VALID["gnss"])
    setattr(message, field, value)
    with pytest.raises(ValueError, match=field):
        signals.decode_gnss(message.SerializeToString())
    with pytest.raises(ValueError, match=field):
        signals.encode_gnss(signals.GnssFix(**{**FIX._asdict(), field: value}))


def test_unknown_altitude_is_nan_and_never_zero() -> None:
    fix = signals.decode_gnss(signals.encode_gnss(FIX._replace(altitude_m=math.nan)))
    assert math.isnan(fix.altitude_m)
    location: Any = decode("foxglove.LocationFix", signals.encode_location(fix))
    assert math.isnan(location.altitude)
    assert signals.check_location(signals.encode_location(fix)) == FIX.wall_time_ns


def test_too_large() -> None:
    row = topic("vehicle", "gnss")
    with pytest.raises(ValueError, match="vehicle/gnss: 4097 bytes; at most 4096"):
        check_stamp(row, b"\x00" * 4097)


def test_importing_signals_is_cheap() -> None:
    """Whoever only reads batches need not load foxglove's schemas, Zenoh or Pydantic."""
    import subprocess
    import sys

    code = "import sys, schemas.signals; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    modules = set(loaded.stdout.split())
    assert not {"zenoh", "pydantic", "foxglove_schemas_protobuf", "mcap", "rerun"} & modules
