"""Metrics as Prometheus reads them, https://prometheus.io/docs/instrumenting/exposition_formats/."""

import re

import pytest

from schemas.metrics import METRICS, ServiceFigures, exposition

SAMPLE = re.compile(r'([a-z_]+)\{((?:[a-z]+="[^"\\\n]*",?)+)\} ([-+.0-9einfa]+)')


def parsed(text: str) -> dict[str, dict[str, float]]:
    """The samples by metric and labels; each group is whole and has its type before it."""
    assert text.endswith("\n")
    found: dict[str, dict[str, float]] = {}
    typed = ""
    for line in text.splitlines():
        if line.startswith("# TYPE "):
            _, _, typed, kind = line.split()
            assert kind in ("gauge", "counter")
            assert typed not in found
            found[typed] = {}
        elif not line.startswith("# HELP "):
            match = SAMPLE.fullmatch(line)
            assert match is not None, line
            assert match[1] == typed
            assert match[2] not in found[typed]
            found[typed][match[2]] = float(match[3])
    return found


def service(**figures: float) -> ServiceFigures:
    return ServiceFigures("sim-a", "logger", True, 1.5e9, figures)


def test_figures_have_their_names_and_labels() -> None:
    figures = {"dropped": 3.0, "alive/truck-1": 1.0, "alive/truck-2": 0.0, "crossings/good": 7.0}
    found = parsed(exposition([service(**figures)]))
    own = 'realm="sim-a",service="logger"'
    assert found == {
        "driveby_healthy": {own: 1.0},
        "driveby_health_time_seconds": {own: 1.5e9},
        "driveby_messages_dropped_total": {own: 3.0},
        "driveby_truck_connected": {
            f'{own},vehicle="truck-1"': 1.0,
            f'{own},vehicle="truck-2"': 0.0,
        },
        "driveby_crossings_total": {f'{own},verdict="good"': 7.0},
    }


def test_groups_hold_all_services() -> None:
    other = service(queue=2.0)._replace(service="worker", is_well=False)
    found = parsed(exposition([other, service(queue=1.0)]))
    assert list(found["driveby_queue_messages"].values()) == [1.0, 2.0]
    assert list(found["driveby_healthy"].values()) == [1.0, 0.0]


@pytest.mark.parametrize(
    "figure", ["unheard_of", 'alive/"} 1\nevil{a="', "alive/", "crossings/excellent", "alive"]
)
def test_figures_that_are_not_ours_are_left_out(figure: str) -> None:
    found = parsed(exposition([service(**{figure: 1.0})]))
    assert found.keys() == {"driveby_healthy", "driveby_health_time_seconds"}


def test_names_keep_to_the_conventions() -> None:
    assert len({metric.name for metric in METRICS}) == len(METRICS)
    for metric in METRICS:
        assert re.fullmatch(r"driveby(_[a-z]+)+", metric.name)
        assert metric.name.endswith("_total") == (metric.kind == "counter")
        assert bool(metric.label) == metric.figure.endswith("/")


def test_no_service_is_an_empty_page() -> None:
    assert exposition([]) == ""
