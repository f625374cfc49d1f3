"""Earlier measurements of a bridge: the baseline, and surveys that a report combines."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from schemas.results import CrossingResult, Results
from schemas.site import Bridge
from services.identification.comparison import Estimate, estimate_of_state
from services.ledger.baselines import read_baseline, state_in
from services.viewer.baseline import baseline_path

DAY_S = 86_400.0
PAUSE_DAYS = 14.0
"""Pause in days that separates two surveys: in less a bridge seldom changes."""
_SEASONS = ("winter", "spring", "summer", "autumn")


class EarlierMeasurement(NamedTuple):
    """The earlier measurement that a bridge is compared with."""

    name: str
    """Name of its results file."""
    estimate: Estimate
    verdict: str
    crossings: tuple[CrossingResult, ...]
    """Crossings that it includes, in order of time, as far as its file has them."""
    used: frozenset[str] = frozenset()
    """Ids of all crossings that it includes."""
    excluded: int = 0
    """Number of crossings of the bridge that it does not include, whatever their verdict."""


class NamedResults(NamedTuple):
    """Results, and the name of their file."""

    path: Path
    results: Results


class SurveyFile(NamedTuple):
    """The crossings of a bridge in one results file: its first and last entry in s since 1970."""

    name: str
    first_s: float
    last_s: float


class CombinedSurveys(NamedTuple):
    """Two surveys that one state combines."""

    earlier_s: float
    """Last entry of the earlier survey in s since 1970 UTC; `later_s` is the first of the later."""
    later_s: float
    command: str | None
    """Command that compares them; None if their results are in one file."""
    site_file: str | None
    """Name of the site file that was given; the command needs it, too."""


def before_of(
    bridge: Bridge, given: Path | NamedResults | None, results: Path, site_folder: Path | None
) -> EarlierMeasurement | None:
    """Return the baseline: the given one, or that of the site file."""
    if given is None:
        given = baseline_path(
            bridge, site_folder or results.parent, required=site_folder is not None
        )
        if given is None:
            return None
    name, stored = given if isinstance(given, tuple) else (given, read_baseline(given))
    state = state_in(name, stored, bridge)
    used = (one for one in stored.crossings if one.crossing_id in state.crossings_used)
    crossings = tuple(sorted(used, key=lambda crossing: crossing.entry_time))
    ids = frozenset(state.crossings_used)
    of_bridge = [one for one in stored.crossings if one.bridge == bridge.id]
    excluded = max(state.crossings_left_out_count, len(of_bridge) - len(crossings))
    return EarlierMeasurement(
        name.name, estimate_of_state(state), state.verdict or "good", crossings, ids, excluded
    )


def combined_surveys(
    files: Sequence[SurveyFile], crossings: Sequence[CrossingResult], site_file: Path | None = None
) -> CombinedSurveys | None:
    """Return the last pause between surveys among the crossings of a state; None without one."""
    times = sorted(crossing.entry_time for crossing in crossings)
    pauses = [one for one in pairwise(times) if one[1] - one[0] >= PAUSE_DAYS * DAY_S]
    if not pauses:
        return None
    earlier_s, later_s = pauses[-1]
    earlier = [file for file in files if file.last_s <= earlier_s]
    later = [file for file in files if file.first_s >= later_s]
    command = None
    if earlier and later and len(earlier) + len(later) == len(files):
        baseline = max(earlier, key=lambda file: file.last_s)
        names = [file.name for file in sorted(later, key=lambda file: file.first_s)]
        site = [] if site_file is None else ["--site", site_file.name]
        command = shlex.join(["driveby", "report", *names, "--baseline", baseline.name, *site])
    return CombinedSurveys(
        earlier_s, later_s, command, None if site_file is None else site_file.name
    )


def days_between(earlier_s: float, later_s: float) -> int:
    """Return the rounded number of days between two times in s."""
    return round(abs(later_s - earlier_s) / DAY_S)


def season_of(time_s: float, latitude_deg: float) -> str:
    """Return the meteorological season of a time in s since 1970, by the hemisphere."""
    quarter = datetime.fromtimestamp(time_s, UTC).month % 12 // 3
    return _SEASONS[quarter if latitude_deg >= 0.0 else (quarter + 2) % 4]
