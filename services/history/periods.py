"""A bridge's history by periods: the crossings of each fused as `driveby fuse` does it.

What was fused of a period is kept in `fused/realm=R/bridge=B/HASH.json`, called by the crossings
and the program that fused them: a period to which nothing was added is not fused again.
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
from services.history.archive import EDITION, Kept, usable_of
from services.recordings.recording import program_version

Unit = Literal["day", "week", "month"]
UNITS: tuple[Unit, ...] = ("day", "week", "month")
PER_YEAR: dict[Unit, float] = {"day": 365.25, "week": 52.18, "month": 12.0}


class FusedPeriod(NamedTuple):
    """A bridge in one period; times in s since 1970 UTC."""

    begin_s: float
    end_s: float
    crossings: int
    """That there were, whatever their verdicts."""
    vehicles: tuple[str, ...]
    temperature_deg_c: float | None
    """Mean of those crossings of which it is known."""
    state: BridgeResult | None
    """None where no crossing gave numbers."""


def begin_of(time_s: float, unit: Unit) -> float:
    """When the period began in which a time is, UTC; weeks begin on Monday."""
    day = datetime.fromtimestamp(time_s, UTC).replace(hour=0, minute=0, second=0, microsecond=0)
    if unit == "week":
        day -= timedelta(days=day.weekday())
    elif unit == "month":
        day = day.replace(day=1)
    return day.timestamp()


def end_of(begin_s: float, unit: Unit) -> float:
    """When the period that begins then is over."""
    days = {"day": 1, "week": 7, "month": 32}[unit]
    later = datetime.fromtimestamp(begin_s, UTC) + timedelta(days=days)
    return later.replace(day=1).timestamp() if unit == "month" else later.timestamp()


def period_name(begin_s: float, unit: Unit) -> str:
    """Return how a period is called: its month, or the day on which it begins."""
    return f"{datetime.fromtimestamp(begin_s, UTC):{'%Y-%m' if unit == 'month' else '%Y-%m-%d'}}"


def by_period(crossings: Iterable[Kept], unit: Unit) -> list[tuple[float, list[Kept]]]:
    """Crossings, in order of their entries, by the beginnings of their periods."""
    grouped = groupby(crossings, key=lambda one: begin_of(one.entry_s, unit))
    return [(begin, list(some)) for begin, some in grouped]


def mean_temperature(crossings: Iterable[Kept]) -> float | None:
    """Of those of which it is known; None if of none."""
    known = [one.temperature_deg_c for one in crossings if one.temperature_deg_c is not None]
    return sum(known) / len(known) if known else None


def fused_periods(
    folder: Path,
    realm: str,
    bridge: str,
    crossings: Iterable[Kept],
    unit: Unit,
    say: Callable[[str], None] = lambda problem: None,
) -> list[FusedPeriod]:
    """All periods that have crossings, in their order; `say` is told of crossings left out."""
    cache = folder / "fused" / f"realm={realm}" / f"bridge={bridge}"
    found = []
    for begin_s, some in by_period(crossings, unit):
        found.append(
            FusedPeriod(
                begin_s,
                end_of(begin_s, unit),
                len(some),
                tuple(sorted({one.vehicle for one in some})),
                mean_temperature(some),
                _fused(cache, bridge, some, say),
            )
        )
    return found


def _fused(
    cache: Path, bridge: str, crossings: list[Kept], say: Callable[[str], None]
) -> BridgeResult | None:
    told = " ".join(one.content for one in crossings)
    name = hashlib.sha256(f"{EDITION} {program_version()} {told}".encode()).hexdigest()[:20]
    path = cache / f"{name}.json"
    try:
        return BridgeResult.model_validate_json(path.read_bytes())
    except (OSError, ValidationError):
        pass  # not fused yet, or what is there was cut off
    # Kernels are slow to import, and mostly there is nothing to fuse.
    from services.identification.bridge_state import Counted, Fusing, count_in, state_of

    some = []
    for one in crossings:
        try:
            some.append(usable_of(one))
        except ValueError as error:
            say(f"{one.crossing_id}: left out: {' '.join(str(error).split())[:120]}")
    counted = count_in(Counted(), [one for one in some if one is not None])
    state = state_of(counted, bridge, Fusing(threads=IdentificationSettings().threads))
    if state is not None:
        try:
            make_folder(cache)
            write_atomically(path, state.model_dump_json())
        except (InputError, FailureError) as error:  # a history that one may only read
            say(f"what was fused is not kept: {error}")
    return state
