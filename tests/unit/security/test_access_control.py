"""Who may hear and say alarms of bridges."""

import pytest
import zenoh

from schemas.topics import key
from services.bus.credentials import Subject
from services.security.access_control import published_by, read_by

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
def test_alarms_are_heard_by_who_looks_and_said_by_who_judges(
    role: str, hears: bool, says: bool
) -> None:
    subject = Subject(role, "x")
    assert (meets(read_by(subject)), meets(published_by(subject))) == (hears, says)
