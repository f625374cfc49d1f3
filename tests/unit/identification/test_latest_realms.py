"""Realm of the state of a bridge that was crossed in several."""

import logging

import pytest

from services.identification.usable import (
    FusableCrossing,
    RecentCrossings,
    add_crossings,
    latest_realms,
)


def _crossings(*entries_s: float) -> RecentCrossings:
    some = [FusableCrossing(s, s + 5.0, f"crossing-{s}", "good", {}, None) for s in entries_s]
    return add_crossings(RecentCrossings(), some)


def test_last_crossing_decides_and_the_others_are_named(
    caplog: pytest.LogCaptureFixture,
) -> None:
    counted = {
        ("z-first", "bridge-1"): _crossings(10.0, 20.0),
        ("a-last", "bridge-1"): _crossings(30.0),
        ("b-none", "bridge-1"): RecentCrossings(),
        ("z-first", "bridge-2"): _crossings(5.0),
    }
    with caplog.at_level(logging.WARNING):
        assert latest_realms(counted) == {"bridge-1": "a-last", "bridge-2": "z-first"}
    (line,) = caplog.messages
    assert line.startswith(
        "bridge-1: has crossings of realms a-last, z-first; only those of a-last are fused; "
    )
