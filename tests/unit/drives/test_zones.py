"""Unknown time zones are refused with a similar name, if there is one."""

import pytest

from services.common.errors import InputError
from services.drives.tables import stamps

KNOWN = {"Europe/Berlin", "Asia/Tokyo", "UTC"}


@pytest.mark.parametrize(
    ("name", "end"),
    [
        ("Nowhere/Berlin", ", did you mean Europe/Berlin? The offset to UTC, as +01:00, works too"),
        ("berlin", ", did you mean Europe/Berlin? The offset to UTC, as +01:00, works too"),
        ("Europe/Tokyo", ", did you mean Asia/Tokyo? The offset to UTC, as +01:00, works too"),
        ("Europe/Berln", ", did you mean Europe/Berlin? The offset to UTC, as +01:00, works too"),
        ("Mars/Base", "; give a name such as Europe/Berlin or the offset to UTC, as +01:00"),
    ],
)
def test_unknown_zone_names_a_similar_one(
    name: str, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stamps, "available_timezones", lambda: KNOWN)
    with pytest.raises(InputError) as caught:
        stamps.zone_of(name, "--zone")
    assert str(caught.value) == f'--zone: no time zone "{name}" is known here{end}'


def test_missing_zone_data_is_named_only_where_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stamps, "available_timezones", set)
    with pytest.raises(InputError, match="this computer has no data of zones"):
        stamps.zone_of("Nowhere/Berlin", "--zone")
