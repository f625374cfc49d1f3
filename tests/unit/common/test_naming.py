"""Names of crossings, which are written by one room and read by others."""

from datetime import UTC, datetime

import pytest

from services.common.naming import entry_in_name, name_of_crossing


@pytest.mark.parametrize("milliseconds", [0, 7, 999])
def test_entry_is_read_from_the_name_that_is_written(milliseconds: int) -> None:
    entry = datetime(2026, 2, 28, 23, 59, 59, 1000 * milliseconds, tzinfo=UTC)
    name = name_of_crossing("truck-1", "bridge.2", entry.timestamp() + 4e-4)
    assert name == f"truck-1.bridge.2.20260228T235959.{milliseconds:03d}Z"
    assert entry_in_name(name) == entry


@pytest.mark.parametrize("name", ["", "truck-1.bridge-1", "truck-1.bridge-1.20260228T235959Z"])
def test_other_names_have_no_entry(name: str) -> None:
    assert entry_in_name(name) is None
