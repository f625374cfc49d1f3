"""A truck out of radio that drives on: all that its spool keeps arrives when it is back.

SILENT_MINUTES=70 gives the time, a multiple of ten, because the truck crosses every ten minutes.
After an hour of silence Zenoh forgets a publisher. The link ends in the first crossing and is back
in the last one.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from schemas.events import EventKind, decode_event
from services.recordings.recording import read_messages
from tests.containers.recorded import check_complete
from tests.containers.stack import Faults, Stack, gone_at_the_end, until

MINUTES = int(os.environ.get("SILENT_MINUTES", "10"))
CROSSINGS = MINUTES // 10 + 1
pytestmark = [pytest.mark.containers, pytest.mark.timeout(60 * MINUTES + 3600)]
APART_S = 600
OVERRIDE = f"""
services:
  router: {{ ports: !reset [] }}
  simulation:
    command:
      - simulate
      - --scenario=6
      - --site=/site.toml
      - --noise=25
      - --gps-noise
      - --runs={CROSSINGS}
      - --force
      - --output=recordings/compose.mcap
"""


@pytest.fixture
def stack(engine: None, tmp_path: Path) -> Iterator[Stack]:
    override = tmp_path / "runs.yaml"
    override.write_text(OVERRIDE)
    with gone_at_the_end(Stack(f"driveby-silent-{MINUTES}", override)) as made:
        yield made


def test_truck_back_after_a_long_silence_loses_nothing(stack: Stack, folder: Path) -> None:
    stack.make("up")
    until(lambda: "truck-1 in realm sim-compose connected" in stack.log("logger"), "the truck")
    Faults(stack, 1).strike("truck", "cut off", 60.0 * MINUTES)
    until(lambda: stack.has_ended("truck"), "the end of the drive")
    back_s = time.time()
    copies = iter(range(10_000))

    def is_spool_empty() -> bool:
        taken = stack.take("spool", folder / f"spool-{next(copies)}")
        return not list(taken.rglob("*.spool"))

    def results() -> list[dict[str, Any]]:
        found = stack.results(folder / f"results-{next(copies)}")
        return [one for one in found if one["entry_time"] < back_s]

    while not is_spool_empty():  # a busy machine confirms later than a truck waits
        print(stack.log("truck"))
        stack.docker("start", stack.name("truck"))
        time.sleep(APART_S / 10)
        stack.docker("stop", stack.name("truck"))
    until(lambda: len(results()) >= CROSSINGS, "a result for each crossing")
    found = sorted(results(), key=lambda one: float(one["entry_time"]))
    assert [one["verdict"] for one in found] == ["good"] * CROSSINGS, found
    begins = [one["entry_time"] for one in found]
    assert [round(begin - begins[0], -1) for begin in begins] == [
        APART_S * n for n in range(CROSSINGS)
    ]
    taken = stack.take("recordings", folder / "recordings")
    check_complete(taken)
    messages = [one for path in taken.rglob("*.mcap") for one in read_messages(path)]
    events = [decode_event(one.payload) for one in messages if one.key.stream == "event"]
    assert [event for event in events if event.kind == EventKind.LOST] == []
    late_s = [
        (one.publish_time_ns - one.log_time_ns) * 1e-9
        for one in messages
        if one.key.stream == "accel"
    ]
    assert max(late_s) > 60.0 * (MINUTES - 1)
    print(f"\n{MINUTES} minutes of silence, {CROSSINGS} crossings, {len(late_s)} messages of accel")
    print(f"{sum(late > APART_S / 2 for late in late_s)} of them fetched from the spool")
    print(stack.log("logger"), stack.log("truck"))
