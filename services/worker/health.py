"""The worker's `health`, and its line of the log for each result."""

import logging
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import NamedTuple

from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult, verdict_line
from services.common.log_lines import about
from services.common.naming import count_of, first_of
from services.execution.dispatch import CrossingExecutor
from services.identification.engine import Engine
from services.worker.backfill import Backfill, WaitingCounts

_log = logging.getLogger(__name__)
_LONGEST_NOTE = 1000
_MAX_NAMED = 3
_CAUSES = {
    "for_process": "for a process",
    "for_validation": "for a site validation",
    "for_data": "for missing samples or for the recording to end",
}
"""Causes by the fields of `WaitingCounts`."""


class QueueLag(NamedTuple):
    """Messages received and not yet processed."""

    messages: int
    lag_s: float
    """Longest wait in s of a message since the last health message."""
    refused: int = 0
    """Number of invalid messages refused since the start."""


class Workload(NamedTuple):
    """Counts of unidentified crossings; running times are left out, as they always change."""

    running: tuple[str, ...]
    waiting: int
    waiting_for_certificate: int
    in_recordings: WaitingCounts
    unknown_vehicles: tuple[str, ...] = ()
    """Trucks that drive and are not in the site file."""


def workload(engine: Engine, execution: CrossingExecutor, source: Backfill | None) -> Workload:
    """Return the counts of unidentified crossings."""
    waiting = {pair: len(names) for pair, names in engine.waiting().items()}
    ready = sum(number for pair, number in waiting.items() if engine.is_certified(pair))
    return Workload(
        tuple(one.crossing_id for one in execution.running),
        execution.waiting + ready,
        sum(waiting.values()) - ready,
        WaitingCounts() if source is None else source.waiting,
        tuple(sorted(engine.unknown_vehicles)),
    )


def log_result(result: CrossingResult) -> None:
    """Log the result of a crossing."""
    fields = about(
        realm=result.realm,
        vehicle=result.vehicle,
        bridge=result.bridge,
        crossing=result.crossing_id,
        verdict=result.verdict,
    )
    _log.info("%s: %s", result.crossing_id, verdict_line(result), extra=fields)


def publish_health(
    publish: Callable[[bytes], object],
    service_id: str,
    execution: CrossingExecutor,
    behind: QueueLag,
    load: Workload,
    *,
    verdicts: Mapping[str, int],
    note: str,
) -> None:
    """Publish `health`; `verdicts` are the results of this run, `note` why crossings wait."""
    running = execution.running
    now_s = time.time()
    notes = [f"identifying {name} since {_clock(now_s - s)} UTC" for name, s in running]
    waiting = count_of(load.waiting, "crossing")
    notes += [f"{waiting} waiting for a process"] if load.waiting else []
    recorded = load.in_recordings._asdict().items()
    notes += [
        f"{count_of(n, 'crossing')} in recordings waiting {_CAUSES[cause]}"
        for cause, n in recorded
        if n
    ]
    notes += [f"refused {count_of(behind.refused, 'invalid message')}"] if behind.refused else []
    notes += [note] if note else []
    if load.unknown_vehicles:
        named = first_of(load.unknown_vehicles, _MAX_NAMED)
        notes.append(f"not in the site file, so without results: {named}")
    figures = {
        "queue": float(behind.messages),
        "lag_s": behind.lag_s,
        "refused": float(behind.refused),
        "identifying": float(len(running)),
        "identifying_longest_s": max((one.seconds for one in running), default=0.0),
        "waiting_for_process": float(load.waiting),
        "waiting_for_certificate": float(load.waiting_for_certificate),
        "waiting_in_recordings": float(load.in_recordings.total),
    } | {f"crossings/{verdict}": float(number) for verdict, number in verdicts.items()}
    health = pb.Health(
        schema_version=1,
        time_ns=round(1e9 * now_s),
        service=service_id,
        ok=True,
        figures=figures,
        note="; ".join(notes)[:_LONGEST_NOTE],
    )
    publish(health.SerializeToString())


def _clock(time_s: float) -> str:
    """Return the time of day of an event, which stays true while the message is kept."""
    return f"{datetime.fromtimestamp(time_s, UTC):%H:%M:%S}"
