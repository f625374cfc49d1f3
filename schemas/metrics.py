"""Metrics for Prometheus: the figures of `health` messages under names that do not change.

Text of exposition format 0.0.4, https://prometheus.io/docs/instrumenting/exposition_formats/.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Final, NamedTuple

from schemas.results import VERDICTS
from schemas.topics import check_identifier

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"


class Metric(NamedTuple):
    """A metric of a figure; every sample has the labels `realm` and `service`."""

    figure: str
    """Figure of `health`; one that ends in `/` is followed by a name, the value of `label`."""
    name: str
    kind: str
    text: str
    label: str = ""


METRICS: Final = (
    Metric("", "driveby_healthy", "gauge", "1: the service is well and its health is recent"),
    Metric("", "driveby_health_time_seconds", "gauge", "Unix time of the latest health"),
    Metric("received", "driveby_messages_received_total", "counter", "messages received"),
    Metric("accepted", "driveby_messages_accepted_total", "counter", "messages accepted"),
    Metric("refused", "driveby_messages_refused_total", "counter", "malformed messages refused"),
    Metric("duplicates", "driveby_messages_duplicate_total", "counter", "messages received again"),
    Metric("recovered", "driveby_messages_recovered_total", "counter", "messages fetched later"),
    Metric("lost", "driveby_messages_lost_total", "counter", "messages that no truck has any more"),
    Metric(
        "dropped",
        "driveby_messages_dropped_total",
        "counter",
        "messages dropped",
    ),
    Metric("written", "driveby_messages_durable_total", "counter", "messages on disk"),
    Metric("missing", "driveby_messages_missing", "gauge", "messages missing now"),
    Metric(
        "gone", "driveby_messages_gone", "gauge", "messages of deleted files, not received again"
    ),
    Metric("to_fetch", "driveby_messages_to_fetch", "gauge", "messages to fetch from spools"),
    Metric("rate_per_s", "driveby_messages_per_second", "gauge", "messages received per second"),
    Metric("queue", "driveby_queue_messages", "gauge", "messages received and not processed"),
    Metric("queue_bytes", "driveby_queue_bytes", "gauge", "memory of the queue"),
    Metric("lag_s", "driveby_lag_seconds", "gauge", "longest delay since the last health"),
    Metric(
        "durable_lag_s",
        "driveby_durable_lag_seconds",
        "gauge",
        "longest time from receipt to disk since the last health",
    ),
    Metric("files", "driveby_open_files", "gauge", "recordings being written"),
    Metric("disk_free_bytes", "driveby_disk_free_bytes", "gauge", "free disk space"),
    Metric("trucks_alive", "driveby_trucks_connected", "gauge", "connected trucks"),
    Metric("alive/", "driveby_truck_connected", "gauge", "1: the truck is connected", "vehicle"),
    Metric(
        "clock_offset_s/",
        "driveby_truck_clock_offset_seconds",
        "gauge",
        "logger's clock minus the truck's",
        "vehicle",
    ),
    Metric(
        "clock_drift_ppm/",
        "driveby_truck_clock_drift_ppm",
        "gauge",
        "drift of the clock offset",
        "vehicle",
    ),
    Metric("identifying", "driveby_crossings_identifying", "gauge", "crossings being identified"),
    Metric(
        "identifying_longest_s",
        "driveby_crossing_identifying_longest_seconds",
        "gauge",
        "longest current identification",
    ),
    Metric(
        "waiting_for_process",
        "driveby_crossings_waiting_for_process",
        "gauge",
        "crossings that wait for a process",
    ),
    Metric(
        "waiting_for_certificate",
        "driveby_crossings_waiting_for_validation",
        "gauge",
        "crossings that wait for a site validation",
    ),
    Metric(
        "waiting_in_recordings",
        "driveby_crossings_waiting_in_recordings",
        "gauge",
        "crossings that wait in recordings",
    ),
    Metric("crossings/", "driveby_crossings_total", "counter", "results", "verdict"),
)
"""All metrics; counters begin at 0 when the service starts."""

HEALTHY, HEALTH_TIME = METRICS[:2]


class ServiceFigures(NamedTuple):
    """The latest `health` of a service."""

    realm: str
    service: str
    is_well: bool
    """Whether it is well, and its health recent; if not recent, `figures` is empty."""
    time_s: float
    figures: Mapping[str, float]


def exposition(services: Iterable[ServiceFigures]) -> str:
    """Return the text of all metrics of the services; other figures are omitted."""
    known = sorted(services, key=lambda one: (one.realm, one.service))
    lines: list[str] = []
    for metric in METRICS:
        samples = [line for service in known for line in _samples(metric, service)]
        if samples:
            lines += [
                f"# HELP {metric.name} {metric.text}",
                f"# TYPE {metric.name} {metric.kind}",
                *samples,
            ]
    return "".join(f"{line}\n" for line in lines)


def _samples(metric: Metric, service: ServiceFigures) -> Iterator[str]:
    labels = f'realm="{service.realm}",service="{service.service}"'
    for value, more in _values(metric, service):
        yield f"{metric.name}{{{labels}{more}}} {value!r}"


def _values(metric: Metric, service: ServiceFigures) -> Iterator[tuple[float, str]]:
    """Yield the values of a metric with the text of its own label."""
    if metric is HEALTHY:
        yield float(service.is_well), ""
    elif metric is HEALTH_TIME:
        yield service.time_s, ""
    elif not metric.label:
        if metric.figure in service.figures:
            yield float(service.figures[metric.figure]), ""
    else:
        for figure, value in sorted(service.figures.items()):
            begin, slash, name = figure.partition("/")
            if begin + slash == metric.figure and _is_name(metric, name):
                yield float(value), f',{metric.label}="{name}"'


def _is_name(metric: Metric, name: str) -> bool:
    """Return whether a name from the bus may be the value of a label."""
    if metric.label == "verdict":
        return name in VERDICTS
    try:
        return bool(check_identifier(name))
    except ValueError:
        return False
