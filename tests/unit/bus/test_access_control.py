"""Who may hear and say alarms of bridges and events of gateways."""

import pytest
import zenoh

from schemas.topics import gateway_service, key
from services.bus.access_control import published_by, read_by
from services.bus.credentials import Subject

ALARM = zenoh.KeyExpr(key("live", "bridge", "bridge-1", "alarm"))


def meets(expressions: list[str]) -> bool:
    return any(zenoh.KeyExpr(one).includes(ALARM) for one in expressions)


@pytest.mark.parametrize(
    ("role", "hears", "says"),
    [
        ("viewer", True, False),
        ("worker", True, True),
        ("logger", True, False),
        ("truck", False, False),
    ],
)
def test_roles_publish_and_read_alarms_as_granted(role: str, hears: bool, says: bool) -> None:
    subject = Subject(role, "x")
    assert (meets(read_by(subject)), meets(published_by(subject))) == (hears, says)


def test_truck_publishes_events_of_its_own_gateway_only() -> None:
    output = published_by(Subject("truck", "truck-1"))
    events = [expression for expression in output if expression.endswith("/event")]
    assert events == [key("live", "service", "gateway-truck-1", "event").replace("live", "*")]
    assert gateway_service("x" * 63) == f"gateway-{'x' * 55}"
