"""Announcements of services on standard output, in the form of their log."""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial


def announcement(options: argparse.Namespace, line: str) -> Callable[[], None]:
    """Return a function that prints that a service is ready, in the form of its log."""
    if options.log_format != "json":
        return partial(print, line, flush=True)

    def announce() -> None:
        record = {"time": time.time(), "level": "info", "logger": "driveby", "message": line}
        print(json.dumps(record | subject_of(options)), flush=True)

    return announce


def subject_of(options: argparse.Namespace) -> dict[str, str]:
    """Return the fields of a log that hold for all lines of a process (`SUBJECT_FIELDS`)."""
    given = {"service": "id", "realm": "realm", "vehicle": "vehicle"}
    found = {name: getattr(options, option, None) for name, option in given.items()}
    return {name: value for name, value in found.items() if isinstance(value, str)}
