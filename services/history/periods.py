"""Periods of a bridge's history: the crossings of each, fused as by `driveby fuse`.

The fused state of a period is stored in `fused/realm=R/bridge=B/HASH.json`, named by the crossings
and the program that fused them, so an unchanged period is not fused again.
"""

import hashlib
from collections.abc import Callable, Iterable
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path
from typing import Literal, NamedTuple

from pydantic import ValidationError

from schemas.results import BridgeResult
from schemas.settings import IdentificationSettings
from services.common.errors import FailureError, InputError
from services.common.files import make_folder, write_atomically
from services.common.progress import Steps, no_step_progress
from services.history.history_store import FORMAT_VERSION, HistoryRow, fusable_of
from services.recordings.recording import program_version

Unit = Literal["day", "week", "month"]
PER_YEAR: dict[Unit, float] = {"day": 365.25, "week": 52.18, "month": 12.0}


class FusedPeriod(NamedTuple):
    """A bridge in one period; times in s since 1970 UTC."""

    begin_s: float
    end_s: float
    crossings: int
    """Number of crossings, whatever their verdicts."""
    vehicles: tuple[str, ...]
    temperature_deg_c: float | None
    """Mean over the crossings with a known temperature."""
    state: BridgeResult | None
    """Fused state; None without usable crossings."""


def begin_of(time_s: float, unit: Unit) -> float:
    """Return the beginning of the period of a time, UTC; weeks begin on Monday."""
    day = datetime.fromtimestamp(time_s, UTC).replace(hour=0, minute=0, second=0, microsecond=0)
    if unit == "week":
        day -= timedelta(days=day.weekday())
    elif unit == "month":
        day = day.replace(day=1)
    return day.timestamp()


def end_of(begin_s: float, unit: Unit) -> float:
    """Return the end of the period that begins at a time."""
    days = {"day": 1, "week": 7, "month": 32}[unit]
    later = datetime.fromtimestamp(begin_s, UTC) + timedelta(days=days)
    return later.replace(day=1).timestamp() if unit == "month" else later.timestamp()


def period_name(begin_s: float, unit: Unit) -> str:
    """Return the name of a period: its month, or the day on which it begins."""
    return f"{datetime.fromtimestamp(begin_s, UTC):{'%Y-%m' if unit == 'month' else '%Y-%m-%d'}}"


def by_period(crossings: Iterable[HistoryRow], unit: Unit) -> list[tuple[float, list[HistoryRow]]]:
    """Group crossings, in order of their entries, by the beginnings of their periods."""
    grouped = groupby(crossings, key=lambda one: begin_of(one.entry_s, unit))
    return [(begin, list(some)) for begin, some in grouped]


def mean_temperature(crossings: Iterable[HistoryRow]) -> float | None:
    """Return the mean of the known temperatures; None if none is known."""
    known = [one.temperature_deg_c for one in crossings if one.temperature_deg_c is not None]
    return sum(known) / len(known) if known else None


def fused_periods(
    folder: Path,
    realm: str,
    bridge: str,
    crossings: Iterable[HistoryRow],
    unit: Unit,
    warn: Callable[[str], None] = lambda problem: None,
    progress: Steps = no_step_progress,
) -> list[FusedPeriod]:
    """Return all periods that have crossings, in order; call `warn` with excluded crossings.

    `progress` is called after each period.
    """
    cache = folder / "fused" / f"realm={realm}" / f"bridge={bridge}"
    found: list[FusedPeriod] = []
    periods = by_period(crossings, unit)
    for begin_s, some in periods:
        found.append(
            FusedPeriod(
                begin_s,
                end_of(begin_s, unit),
                len(some),
                tuple(sorted({one.vehicle for one in some})),
                mean_temperature(some),
                _fused(cache, bridge, some, warn),
            )
        )
        progress(len(found), len(periods))
    return found


def _fused(
    cache: Path, bridge: str, crossings: list[HistoryRow], warn: Callable[[str], None]
) -> BridgeResult | None:
    names = " ".join(one.content for one in crossings)
    name = hashlib.sha256(f"{FORMAT_VERSION} {program_version()} {names}".encode()).hexdigest()[:20]
    path = cache / f"{name}.json"
    try:
        return BridgeResult.model_validate_json(path.read_bytes())
    except (OSError, ValidationError):
        pass  # not fused yet, or the file was truncated
    # Kernels are slow to import, and usually there is nothing to fuse.
    from services.identification.bridge_state import (
        FusionSettings,
        RecentCrossings,
        add_crossings,
        state_of,
    )

    some = []
    for one in crossings:
        try:
            some.append(fusable_of(one))
        except ValueError as error:
            warn(f"{one.crossing_id}: left out: {' '.join(str(error).split())[:120]}")
    counted = add_crossings(RecentCrossings(), [one for one in some if one is not None])
    state = state_of(counted, bridge, FusionSettings(threads=IdentificationSettings().threads))
    if state is not None:
        try:
            make_folder(cache)
            write_atomically(path, state.model_dump_json())
        except (InputError, FailureError) as error:  # the history may be read-only
            warn(f"cannot store the fused state: {error}")
    return state
