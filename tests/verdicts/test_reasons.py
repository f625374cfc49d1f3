"""Reasons that need no fit, and that no reason is dead."""

from pathlib import Path

import numpy as np
import pytest

from pre_core.physics.simulate import Motion
from schemas.reasons import Reason
from services.identification.result_parts import caveats, longest_outage_s
from tests.verdicts.steady import ENTRY_S, EXIT_S, steady_crossing


def motion(acceleration_m_per_s2: float) -> Motion:
    t = np.linspace(0.0, 9.0, 901)
    speed = 10.0 + acceleration_m_per_s2 * t
    return Motion(10.0 * t, speed, np.full(t.size, acceleration_m_per_s2))


STEADY = np.arange(0.0, 9.0, 0.1)


def test_a_steady_drive_has_no_caveat() -> None:
    assert caveats(steady_crossing(STEADY), motion(0.0)) == []


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_braking_matters_where_the_height_of_the_mass_is_unknown(sign: float) -> None:
    unknown = steady_crossing(STEADY, cg_height_m=None)
    assert caveats(unknown, motion(0.31 * sign)) == [Reason.ACCELERATING_CG_UNKNOWN]
    assert caveats(unknown, motion(0.29 * sign)) == []
    assert caveats(steady_crossing(STEADY, cg_height_m=1.2), motion(0.9 * sign)) == []


@pytest.mark.parametrize(("seconds", "named"), [(1.4, False), (1.7, True), (5.0, True)])
def test_a_receiver_that_fails_on_the_bridge_is_named(seconds: float, *, named: bool) -> None:
    middle = 0.5 * (ENTRY_S + EXIT_S)
    times = STEADY[np.abs(STEADY - middle) > 0.5 * seconds]
    assert caveats(steady_crossing(times), motion(0.0)) == [Reason.POSITION_OUTAGE] * named


def test_an_outage_that_only_touches_the_bridge_counts_whole() -> None:
    """Between the last fix before the entry and the first after the exit."""
    times = STEADY[(STEADY < 1.0) | (STEADY > 3.45)]
    assert longest_outage_s(times, ENTRY_S, EXIT_S) == pytest.approx(2.6)
    before = STEADY[(STEADY < 0.5) | (STEADY > 2.0)]
    assert longest_outage_s(before, ENTRY_S, EXIT_S) == pytest.approx(0.1)
    assert longest_outage_s(np.empty(0), ENTRY_S, EXIT_S) == np.inf


@pytest.mark.parametrize("reason", Reason)
def test_every_reason_is_raised_and_explained(project: Path, reason: Reason) -> None:
    """A code that nothing raises promises a check that does not exist."""
    sources = [path.read_text(encoding="utf-8") for path in (project / "services").rglob("*.py")]
    assert any(f"Reason.{reason.name}" in source for source in sources)
    page = (project / "docs" / "verdicts.md").read_text(encoding="utf-8")
    assert f"| `{reason}` |" in page
