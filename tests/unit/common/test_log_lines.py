"""One line of JSON for each record, with its subject in fields."""

import io
import json
import logging
from typing import Any

import pytest

from services.common.log_lines import JsonFormatter, about


def written(log: Any, fields: dict[str, str]) -> dict[str, Any]:
    out = io.StringIO()
    handler = logging.StreamHandler(out)
    handler.setFormatter(JsonFormatter(fields))
    logger = logging.Logger("services.x")
    logger.addHandler(handler)
    log(logger)
    [line] = out.getvalue().splitlines()
    found: dict[str, Any] = json.loads(line)
    return found


def test_subject_is_in_fields() -> None:
    fields = about(vehicle="truck-1", crossing="truck-1.b.1", verdict="good")
    line = written(lambda log: log.info("%s: fine", 1, extra=fields), {"realm": "sim-a"})
    assert line.pop("time") > 0
    assert line == {
        "level": "info",
        "logger": "services.x",
        "message": "1: fine",
        "realm": "sim-a",
        "vehicle": "truck-1",
        "crossing": "truck-1.b.1",
        "verdict": "good",
    }


def test_own_fields_come_before_those_of_the_process() -> None:
    line = written(lambda log: log.info("x", extra=about(realm="sim-b")), {"realm": "sim-a"})
    assert line["realm"] == "sim-b"


def test_several_lines_and_a_traceback_stay_one_line() -> None:
    def fail(log: logging.Logger) -> None:
        try:
            raise ValueError("of\ntwo lines")
        except ValueError:
            log.exception("a\nb")

    line = written(fail, {})
    assert line["message"] == "a\nb"
    assert line["traceback"].startswith("Traceback") and "two lines" in line["traceback"]  # noqa: PT018


@pytest.mark.parametrize("name", ["realm", "vehicle", "bridge", "crossing", "verdict"])
def test_unknown_subject_is_absent(name: str) -> None:
    assert about(**{name: ""}) == {}
