"""Keys and attachments of rmw_zenoh."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.drives.ros2_messages import IMU
from services.truck.rmw_zenoh import Attachment, decode_attachment, key_expression, type_and_hash
from tests.ros2 import attachment

GID = bytes(range(16))
SENT_NS = 1_700_000_000_123_456_789


def test_an_attachment_is_two_numbers_and_an_array_as_zenoh_serialises_them() -> None:
    written = attachment(258, SENT_NS, GID)
    assert len(written) == 33
    assert written == (258).to_bytes(8, "little") + SENT_NS.to_bytes(8, "little") + b"\x10" + GID
    assert decode_attachment(written) == Attachment(258, SENT_NS, GID)
    longer = bytes(range(24))
    assert decode_attachment(attachment(1, SENT_NS, longer)).publisher == longer


@pytest.mark.parametrize(
    "wrong",
    [None, b"", bytes(16), bytes(17), attachment(1, SENT_NS, GID)[:-1],
     attachment(1, SENT_NS, GID) + b"x", attachment(1, SENT_NS, bytes(25)), bytes(1000)],
)  # fmt: skip
def test_what_is_none_is_refused(wrong: bytes | None) -> None:
    with pytest.raises(ValueError, match="attachment"):
        decode_attachment(wrong)


@given(st.binary(max_size=60))
def test_any_bytes_are_decoded_or_refused(anything: bytes) -> None:
    try:
        found = decode_attachment(anything)
    except ValueError:
        return
    assert attachment(*found) == anything


def test_a_topic_is_in_the_key_without_its_slash_at_the_begin() -> None:
    assert key_expression(3, "/imu/front/data") == "3/imu/front/data/*/*"
    key = f"3/imu/front/data/{IMU.dds_name}/{IMU.hash}"
    assert type_and_hash(key) == ("sensor_msgs::msg::dds_::Imu_", IMU.hash)
    for wrong in ("", "0/imu", "0/imu/x", "a/" * 400):
        with pytest.raises(ValueError, match="DOMAIN/TOPIC/TYPE/HASH"):
            type_and_hash(wrong)
