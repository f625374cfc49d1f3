"""The quick check of a batch says what decoding it says, whatever the bytes."""

import math
import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from schemas import accel_check, signals
from schemas.accel_check import check_accel
from schemas.proto import driveby_pb2 as pb

TIME_NS = 1_700_000_000_000_000_000
LIMIT = signals.MAX_ACCELERATION_M_PER_S2


def encoded(
    *channels: tuple[int, float, list[float]], names: tuple[str, ...] = (), **header: int
) -> bytes:
    known: dict[str, Any] = {
        "schema_version": 1,
        "boot_id": TIME_NS,
        "sequence": 5,
        "device_time_ns": 7,
    }
    message = pb.AccelBatch(**{**known, "wall_time_ns": TIME_NS, **header})
    for (position, rate_hz, samples), name in zip(
        channels, names or ("",) * len(channels), strict=True
    ):
        message.channels.add(
            position=position,
            rate_hz=rate_hz,
            acceleration_m_per_s2=samples,
            name=name,
        )
    return message.SerializeToString()


def assert_same(payload: bytes) -> None:
    def output_of(check: Callable[[bytes], object]) -> object:
        try:
            return check(payload)
        except ValueError as error:
            return str(error)

    expected = output_of(lambda payload: signals.stamp(signals.decode_accel(payload)))
    assert output_of(check_accel) == expected


BATCH = encoded(*[(position, 1000.0, [0.5] * 50) for position in (1, 2, 3, 4)])
SHORT = encoded((1, 200.0, [0.5] * 10), (3, 200.0, [0.5] * 12))
NAMED = encoded((1, 200.0, [0.5] * 10), (0, 200.0, [0.5] * 12), names=("", "axle_1_left"))
NAMED_LONG = encoded((0, 1000.0, [0.5] * 50), (0, 200.0, [0.5] * 2), names=("a" * 63, "b"))


@st.composite
def edited(draw: st.DrawFn) -> bytes:
    """Return a batch in which bytes have been changed, put in, taken out or repeated."""
    payload = draw(st.sampled_from([BATCH, SHORT, NAMED, NAMED_LONG]))
    for _ in range(draw(st.integers(1, 3))):
        # What stands between the samples is what matters, and most of it is at the beginning.
        first = draw(st.integers(0, min(len(payload), 80)) | st.integers(0, len(payload)))
        last = draw(st.integers(first, min(len(payload), first + 20)))
        new = draw(st.binary(max_size=12) | st.just(payload[first:last] * 2))
        payload = payload[:first] + new + payload[last:]
    return payload


@given(edited())
@example(BATCH)
@example(SHORT)
@example(BATCH + SHORT)
@example(NAMED)
@example(NAMED + BATCH)
@example(NAMED.replace(b"axle_1_left", b"unsprung_fr"))
@example(NAMED.replace(b"axle_1_left", b"Axle_1_left"))
@example(NAMED.replace(b"axle_1_left", b"axle_1_l\xfft"))
@example(NAMED.replace(b"\x22\x0baxle", b"\x22\x0aaxle"))
@example(NAMED.replace(b"\x22\x0baxle", b"\x2a\x0baxle"))
@example(NAMED[:-1])
@example(NAMED_LONG)
@example(BATCH + b"\x10\x01")
@example(BATCH + b"\x3a\x01\x00")
@example(BATCH.replace(b"\x32", b"\x3a", 1))
@example(SHORT.replace(b"\x08\x01\x11", b"\x08\x02\x11", 1))
@example(SHORT.replace(b"\x1a\x50", b"\x1a\xd0\x00", 1))
@example(SHORT.replace(b"\x1a\x50", b"\x1a\x51", 1))
@example(SHORT.replace(b"\x1a\x50", b"\x1a\x48", 1))
@example(SHORT.replace(b"\x32\x5d", b"\x32\x5c", 1))
@example(SHORT.replace(b"\x32\x5d", b"\x32\x5e", 1).replace(b"\x1a\x50", b"\x1a\x51\x00", 1))
@example(BATCH[:-8])
@example(SHORT[:-8])
@example(SHORT[:-1])
@example(b"\x08\x02" + BATCH[2:])
@example(b"\x08\x81\x00" + BATCH[2:])
@example(b"\x08\x01\x10" + b"\xff" * 9 + b"\x7f" + BATCH[12:])
def test_edited_bytes(payload: bytes) -> None:
    assert_same(payload)


values = st.sampled_from([0.5, LIMIT, 1.001 * LIMIT, math.nan])
rates = st.sampled_from([1000.0, 20.0, 50_000.0, 50_001.0, 0.0, -1.0, math.nan])


@given(
    st.lists(
        st.tuples(
            st.integers(0, 5), rates, st.tuples(values, st.sampled_from([0, 1, 14, 15, 16, 50]))
        ),
        max_size=4,
    )
)
@example([(1, 1000.0, (0.5, 50))] * 2)
@example([(5, 1000.0, (0.5, 50))])
@example([(1, 20.0, (0.5, 50))])
def test_any_channels(channels: list[tuple[int, float, tuple[float, int]]]) -> None:
    assert_same(encoded(*[(place, rate, [v] * n) for place, rate, (v, n) in channels]))


@given(
    st.lists(
        st.tuples(
            st.integers(0, 2),
            st.sampled_from(
                ["", "a", "sprung_front", "sprung_rear", "Front", "ü", "a" * 63, "a" * 64]
            ),
        ),
        max_size=4,
    )
)
@example([(1, "sprung_front")])
@example([(0, "sprung_front"), (1, "")])
def test_any_names(channels: list[tuple[int, str]]) -> None:
    names = tuple(name for _, name in channels)
    assert_same(encoded(*[(place, 200.0, [0.5] * 10) for place, _ in channels], names=names))


@pytest.mark.parametrize("number", [signals.MAX_CHANNELS, signals.MAX_CHANNELS + 1])
def test_channels_are_bounded(number: int) -> None:
    names = tuple(f"a{k}" for k in range(number))
    payload = encoded(*[(0, 200.0, [0.5])] * number, names=names)
    assert_same(payload)
    assert (accel_check._stamp_if_usual(payload) is None) == (number > signals.MAX_CHANNELS)


@pytest.mark.parametrize("payload", [BATCH, SHORT, NAMED, NAMED_LONG])
def test_named_channels_are_of_the_usual_form(payload: bytes) -> None:
    assert accel_check._stamp_if_usual(payload) is not None


@pytest.mark.parametrize("boot_id", [0, 1, 2**64 - 1])
@pytest.mark.parametrize("sequence", [0, 1, 2**32 - 1, 2**32])
@pytest.mark.parametrize("device_time_ns", [-1, 0, 1, 2**63 - 1])
@pytest.mark.parametrize("wall_time_ns", [0, 1, TIME_NS, -TIME_NS])
def test_any_header(boot_id: int, sequence: int, device_time_ns: int, wall_time_ns: int) -> None:
    header = {
        "boot_id": boot_id,
        "sequence": sequence,
        "device_time_ns": device_time_ns,
        "wall_time_ns": wall_time_ns,
    }
    assert_same(encoded((1, 1000.0, [0.5] * 50), names=(), **header))


@pytest.mark.parametrize("place", [0, 49, 50, 199])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.001 * LIMIT, -1.001 * LIMIT])
def test_one_bad_sample_anywhere(place: int, value: float) -> None:
    samples = [0.5] * 200
    samples[place] = value
    parts = [(n + 1, 1000.0, samples[50 * n : 50 * n + 50]) for n in range(4)]
    payload = encoded(*parts)
    assert struct.pack("<d", value) in payload
    with pytest.raises(ValueError, match="is not finite or exceeds"):
        check_accel(payload)


@pytest.mark.parametrize("number", [1, 2, 14, 16, 50, 100, 2000])
def test_usual_batches_are_not_taken_apart(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Or the check would be as slow as if it were not there."""
    monkeypatch.setattr(accel_check, "decode_accel", lambda _: pytest.fail("taken apart"))
    stamp = check_accel(encoded((1, 2000.0, [0.5] * number), (4, 2000.0, [-LIMIT] * number)))
    assert stamp == (TIME_NS, 7, (TIME_NS, 5))
