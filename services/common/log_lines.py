"""Log lines of commands and services: their two forms, and the fields of the JSON form.

A line of JSON names its subject in fields, so that an operator can filter without parsing text. A
logging call gives the fields that its line is about: `log.info("…", extra=about(vehicle=name))`.
Fields that hold for all lines of a process, such as its realm, are given to `configure_logging`.
"""

import json
import logging
from collections.abc import Mapping
from typing import Final

SUBJECT_FIELDS: Final = ("service", "realm", "vehicle", "bridge", "crossing", "verdict")
"""Fields of a line of JSON on its subject; each is absent where it is unknown."""

progress_log: Final = logging.getLogger("driveby.progress")
"""Logger of the progress of long commands, which shows it even where only warnings are logged."""


def about(
    *,
    realm: str | None = None,
    vehicle: str | None = None,
    bridge: str | None = None,
    crossing: str | None = None,
    verdict: str | None = None,
) -> dict[str, str]:
    """Return the `extra` argument of a logging call for a line on this subject."""
    fields = {
        "realm": realm,
        "vehicle": vehicle,
        "bridge": bridge,
        "crossing": crossing,
        "verdict": verdict,
    }
    return {name: value for name, value in fields.items() if value}


class JsonFormatter(logging.Formatter):
    """A formatter of one JSON object per record, on one line.

    `time` (Unix, s), `level`, `logger` and `message` are always there; then come the fields of
    `SUBJECT_FIELDS`, `figures` of a service's health, and `traceback`.
    """

    def __init__(self, fields: Mapping[str, str]) -> None:
        """Take the fields that hold for all records unless a record has its own."""
        super().__init__()
        self._fields = fields

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line."""
        line: dict[str, object] = {
            "time": round(record.created, 6),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        for name in SUBJECT_FIELDS:
            if value := getattr(record, name, self._fields.get(name)):
                line[name] = value
        if hasattr(record, "figures"):
            line["figures"] = record.figures
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def configure_logging(form: str, level: int, fields: Mapping[str, str]) -> None:
    """Log to standard error, as `text` or `json`, from a level on."""
    handler = logging.StreamHandler()
    handler.setFormatter(
        JsonFormatter(fields)
        if form == "json"
        else logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s")
    )
    progress_log.setLevel(logging.INFO)
    logging.basicConfig(level=level, handlers=[handler], force=True)
