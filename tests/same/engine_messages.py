"""Feed a recording to a tree's engine and write every message that it yields.

    python tests/same/engine_messages.py REC.mcap METHOD OUT.jsonl

Runs with the packages of the tree to be compared (`PYTHONPATH`); its own tests provide the class
`WorkingEngine`, which stays while the engine behind it is rebuilt.
"""

import json
import sys
from pathlib import Path
from typing import Any

from schemas.results import ResultHeader
from schemas.settings import IdentificationSettings
from schemas.site_file import parse_site
from services.recordings.recording import read_messages, read_site
from tests.working_engine import WorkingEngine

SETTINGS = {"random_walk": {"steps": 60}}
"""Fewer steps than a user takes: every part of a step is run within a few of them."""


def main(recording: Path, method: str, out: Path) -> None:
    """Write a line for each output and one for the bridges' states at the end."""
    site = read_site(recording)
    assert site is not None
    settings = IdentificationSettings.model_validate({"method": method} | SETTINGS.get(method, {}))
    header = ResultHeader("0", 0.0, "0" * 16, settings.model_dump(mode="json"), settings.seed)
    engine = WorkingEngine(parse_site(site, str(recording)), settings, header)
    lines: list[dict[str, Any]] = []

    def keep(after: int | None, outputs: Any) -> None:
        for output in outputs:
            result = None if output.result is None else output.result.model_dump(mode="json")
            payload = output.payload.hex()
            key = "/".join(output.key)
            lines.append({"after": after, "key": key, "payload": payload, "result": result})

    for number, message in enumerate(read_messages(recording)):
        if message.key.owner == "vehicle":
            keep(number, engine.feed(message.key, message.payload))
    keep(None, engine.finish())
    bridges = {name: one.model_dump(mode="json") for name, one in engine.bridges().items()}
    lines.append({"bridges": bridges, "unknown": sorted(engine.unknown_vehicles)})
    out.write_text("".join(json.dumps(line) + "\n" for line in lines))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
