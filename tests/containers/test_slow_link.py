"""A link of 1 Mbit/s with 0.3 s of delay and 2 % of loss each way: the truck's, then the worker's.

Another truck drives elsewhere meanwhile, over a good link.
"""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.events import EventKind, decode_event
from services.cli import main as cli
from services.recordings.recording import read_messages
from tests.containers.recorded import check_complete, drives_of
from tests.containers.stack import ROOT, Stack, gone_at_the_end, until

pytestmark = [pytest.mark.containers, pytest.mark.timeout(3600)]

DELAY_S, LOSS, BITS_PER_S = 0.3, 0.02, 1e6
OVERRIDE = f"""
services:
  certs:
    command: [certs, certs, --trucks, "truck-1,truck-2", --host, router, logger]
  link:
    image: driveby
    pull_policy: never
    entrypoint: [python, /slow_link.py, "{DELAY_S}", "{LOSS}", "{BITS_PER_S}"]
    init: true
    user: "0:0"
    cap_drop: [ALL]
    cap_add: [NET_ADMIN, NET_RAW]
    devices: [/dev/net/tun]
    sysctls: {{ net.ipv4.conf.all.rp_filter: 1 }}
    networks: [NETWORK]
    volumes: [{ROOT}/tests/containers/slow_link.py:/slow_link.py:ro]
    healthcheck: {{ test: [CMD, test, -e, /sys/class/net/slow0], interval: 1s }}
  SLOW:
    network_mode: service:link
    networks: !reset null
    depends_on:
      link: {{ condition: service_healthy }}
  truck-2:
    extends: {{ file: {ROOT}/compose.yaml, service: truck }}
    build: !reset null
    command:
      - truck
      - other.mcap
      - --endpoint=tls/router:7447
      - --tls=/etc/driveby/tls
      - --realm=sim-compose
      - --spool=spool
    volumes:
      - OTHER:/app/other.mcap:ro
      - spool-2:/app/spool
      - {{ type: volume, source: certs, target: /etc/driveby/tls, volume: {{ subpath: truck-2 }} }}
volumes:
  spool-2:
"""


def drive_elsewhere(folder: Path) -> Path:
    """Write the drive of another truck over another bridge, a degree further north."""
    site, drive = folder / "site.toml", folder / "other.mcap"
    text = (ROOT / "docs" / "site.example.toml").read_text().replace('"truck-1"', '"truck-2"')
    site.write_text(re.sub(r"(latitude_deg = )36", r"\g<1>37", text))
    assert cli.main(["simulate", "--scenario=1", "--site", str(site), "-o", str(drive)]) == 0
    return drive


@pytest.fixture(params=["truck", "worker"])
def stack(engine: None, folder: Path, request: pytest.FixtureRequest) -> Iterator[Stack]:
    slow = request.param
    text = OVERRIDE.replace("OTHER", str(drive_elsewhere(folder))).replace("SLOW", slow)
    text = text.replace("NETWORK", {"truck": "trucks", "worker": "services"}[slow])
    path = folder / "compose.yaml"
    path.write_text(text)
    with gone_at_the_end(Stack(f"driveby-slow-{slow}", path)) as made:
        yield made


def test_slow_link_loses_nothing_and_holds_up_nobody(stack: Stack, folder: Path) -> None:
    began_s = time.monotonic()
    stack.make("up")
    stack.compose("up", "--detach", "truck-2")
    until(lambda: stack.has_ended("truck-2"), "the end of the other drive")
    assert stack.state("truck-2")["ExitCode"] == 0, stack.log("truck-2")
    copies = iter(range(10_000))

    def is_spool_empty() -> bool:
        until(lambda: stack.has_ended("truck"), "the end of the drive")
        taken = stack.take("spool", folder / f"spool-{next(copies)}")
        return not list(taken.rglob("*.spool"))

    while not is_spool_empty():  # another drive, that offers what is left of the first
        print(f"\n{stack.log('truck')}")
        stack.docker("start", stack.name("truck"))
    taken = stack.take("recordings", folder / "recordings")
    check_complete(taken)
    check_complete(taken, "truck-2")
    events = [
        decode_event(message.payload)
        for path in taken.rglob("*.mcap")
        for message in read_messages(path)
        if message.key.stream == "event"
    ]
    assert [event for event in events if event.kind == EventKind.LOST] == []
    drives = drives_of(taken)

    def results() -> list[dict]:  # type: ignore[type-arg]
        return stack.results(folder / f"results-{next(copies)}")

    until(lambda: len(results()) >= len(drives), "a result for each drive")
    found = results()
    assert len(found) == len(drives)
    for drive in drives.values():
        [one] = [one for one in found if drive.begin_s <= one["entry_time"] <= drive.end_s]
        assert one["verdict"] == "good", one["reasons"]
    print(f"\n{len(drives)} drives, {time.monotonic() - began_s:.0f} s")
    print("\n".join(sorted({str(event) for event in events})))
