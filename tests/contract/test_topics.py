"""The topic table: what it says of keys, messages and identifiers, whatever it is asked."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from schemas.messages import MESSAGES, descriptors, message_class
from schemas.topics import (
    TOPICS,
    Key,
    check_identifier,
    check_realm,
    check_realms,
    key,
    parse_key,
    selector,
    topic,
)

IDENTIFIERS = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,62}", fullmatch=True)
REALMS = st.one_of(
    st.just("live"),
    st.builds("{}-{}".format, st.sampled_from(["replay", "sim", "import"]), IDENTIFIERS),
)


def test_the_streams_are_those_of_the_contract() -> None:
    assert {(row.owner, row.stream) for row in TOPICS} == {
        ("vehicle", "accel"),
        ("vehicle", "gnss"),
        ("vehicle", "location"),
        ("vehicle", "info"),
        ("vehicle", "alive"),
        ("bridge", "crossing"),
        ("bridge", "estimate"),
        ("bridge", "state"),
        ("bridge", "alarm"),
        ("service", "health"),
        ("service", "progress"),
        ("service", "event"),
        ("service", "durable"),
    }
    assert len({(row.owner, row.stream) for row in TOPICS}) == len(TOPICS)


def test_vehicle_data_results_and_events_are_logged() -> None:
    logged = {row.stream for row in TOPICS if row.logged}
    expected = {"accel", "gnss", "location", "info", "crossing", "estimate", "state", "event"}
    assert logged == expected | {"alarm"}
    assert {row.stream for row in TOPICS if row.latched} == {"info", "state", "alarm", "durable"}
    # A logged message that may be dropped or outrun its cache at once would be a silent loss.
    assert all(row.delivery == "reliable" and row.cache >= 1 for row in TOPICS if row.logged)


def test_the_cache_bridges_minutes() -> None:
    for row in TOPICS:
        if row.logged and row.nominal_rate_hz is not None:
            assert row.cache / row.nominal_rate_hz >= 300


@pytest.mark.parametrize("name", MESSAGES)
def test_every_message_has_a_class_and_self_contained_descriptors(name: str) -> None:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    assert message_class(name).DESCRIPTOR.full_name == name
    files = descriptor_pb2.FileDescriptorSet.FromString(descriptors(name))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:  # raises where an import does not stand before its user
        pool.Add(file)
    rebuilt = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    assert rebuilt().SerializeToString() == b""


def test_no_other_message() -> None:
    with pytest.raises(ValueError, match="no message"):
        message_class("driveby.v1.Nonsense")


@given(REALMS, st.sampled_from(TOPICS), IDENTIFIERS)
def test_a_key_can_be_taken_apart_and_put_together(realm: str, row: object, name: str) -> None:
    owner, stream = row[0], row[1]  # type: ignore[index]
    text = key(realm, owner, name, stream)
    assert parse_key(text) == Key(realm, owner, name, stream)
    assert key(*parse_key(text)) == text


@given(st.text())
def test_any_text_is_a_key_or_a_value_error(text: str) -> None:
    try:
        parsed = parse_key(text)
    except ValueError:
        return
    assert key(*parsed) == text


@given(
    st.text(
        alphabet=st.sampled_from("abz09_-/.*$@#?\x00\n é" + "A"),
        max_size=80,
    )
)
def test_identifiers_are_safe_as_keys_and_file_names(text: str) -> None:
    safe = set("abcdefghijklmnopqrstuvwxyz0123456789_-")
    try:
        check_identifier(text)
    except ValueError:
        ok = 0 < len(text) <= 63 and set(text) <= safe and text[0] not in "_-"
        assert not ok
    else:
        assert 0 < len(text) <= 63
        assert set(text) <= safe
        assert text[0] not in "_-"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "driveby/v1/live/vehicle/truck-1",
        "driveby/v1/live/vehicle/truck-1/accel/x",
        "/driveby/v1/live/vehicle/truck-1/accel",
        "driveby/v2/live/vehicle/truck-1/accel",
        "driveby/v1/life/vehicle/truck-1/accel",
        "driveby/v1/replay-/vehicle/truck-1/accel",
        "driveby/v1/live/vehicle/../accel",
        "driveby/v1/live/vehicle/*/accel",
        "driveby/v1/live/vehicle/truck-1\n/accel",
        "driveby/v1/live/vehicle/truck-1/accel\n",
        "driveby/v1/live/vehicle/Truck/accel",
        "driveby/v1/live/vehicle/truck-1/state",
        "driveby/v1/live/bridge/b/accel",
        "driveby/v1/live/vehicle/" + "a" * 10_000 + "/accel",
    ],
)
def test_what_is_no_key(text: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]{1,400}$"):
        parse_key(text)


def test_realms() -> None:
    assert check_realm("sim-demo") == "sim-demo"
    for text in ("", "sim", "sim-", "live2", "live\n", "replay-../x", "sim-A"):
        with pytest.raises(ValueError, match="realm"):
            check_realm(text)


def test_selector() -> None:
    assert selector("live", "vehicle") == "driveby/v1/live/vehicle/*/*"
    assert selector(None, "bridge", "estimate") == "driveby/v1/*/bridge/*/estimate"


def test_unknown_topic_says_which_there_are() -> None:
    with pytest.raises(ValueError, match=r"vehicle/speed.*vehicle/accel"):
        topic("vehicle", "speed")


@pytest.mark.parametrize(
    ("pattern", "within", "without"),
    [
        ("live", ["live"], ["sim-a", "replay-live"]),
        ("sim-a", ["sim-a"], ["sim-ab", "live"]),
        ("sim-*", ["sim-a", "sim-night-1"], ["live", "import-sim-a"]),
        ("replay-night*", ["replay-night", "replay-night-2"], ["replay-day", "live"]),
        ("*", ["live", "sim-a", "import-x", "replay-y"], []),
    ],
)
def test_a_pattern_of_realms_is_a_key_expression(
    pattern: str, within: list[str], without: list[str]
) -> None:
    expression = zenoh.KeyExpr(selector(check_realms(pattern), "vehicle"))
    for realm in within + without:
        where = zenoh.KeyExpr(key(realm, "vehicle", "truck-1", "accel"))
        assert expression.includes(where) == (realm in within), realm


@pytest.mark.parametrize("text", ["", "**", "x*", "sim-A*", "sim-*-a", "*live", "live-*", "si"])
def test_what_is_no_pattern_of_realms(text: str) -> None:
    with pytest.raises(ValueError, match="must be live, replay-NAME, sim-NAME or import-NAME"):
        check_realms(text)
