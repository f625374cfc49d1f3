"""The router of compose.yaml as a process on loopback: `zenohd` itself, in the same version."""

import json
import os
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml

from services.bus.credentials import link_settings
from services.security.certs import PLACE
from tests.builders.compose_file import with_defaults
from tests.containers.stack import ROOT
from tests.waiting import LONGEST_S, until

COMPILED = ROOT / "build" / "containers" / "bin" / "zenohd"
"""Where images.sh leaves it."""
_SERVICES = yaml.safe_load(with_defaults((ROOT / "compose.yaml").read_text()))["services"]
VERSION: str = _SERVICES["router"]["image"].rpartition(":")[2]


def find() -> str | None:
    """Return the path of `zenohd`: from the variable ZENOHD, PATH, or as images.sh compiled it."""
    given = os.environ.get("ZENOHD") or shutil.which("zenohd")
    return given or (str(COMPILED) if COMPILED.exists() else None)


def version_of(program: str) -> str:
    done = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    found = re.search(r"\d+\.\d+\.\d+", done.stdout)
    assert found, done.stdout
    return found[0]


def command_of(service: str, places: dict[str, str]) -> list[str]:
    """Return a service's command of compose.yaml with places of this machine for a container's."""
    words = list(_SERVICES[service]["command"])
    for place, here in places.items():
        words = [word.replace(place, here) for word in words]
    return words


def command(program: str, folder: Path, listen: str, connect: str) -> list[str]:
    """Return the router's command with its volume at `folder` and other addresses.

    The file itself stays as `driveby certs` wrote it: options name its credentials' place.
    """
    places = {PLACE: str(folder), "tls/0.0.0.0:7447": listen, "tls/logger:7447": connect}
    words = command_of("router", places)
    tls = json.dumps(link_settings(folder)["tls"])
    return [program, *words, f"--cfg=transport/link/tls:{tls}"]


@contextmanager
def running(
    program: str, folder: Path, listen: str, connect: str, log: Path, *further: str
) -> Iterator[subprocess.Popen[bytes]]:
    """Run `zenohd` until the block ends; it listens when the block begins."""
    words = [*command(program, folder, listen, connect), *further]
    with listening(words, listen, log) as process:
        yield process


@contextmanager
def listening(words: list[str], listen: str, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run a router's command until the block ends; it listens when the block begins."""
    host, port = listen.partition("/")[2].split(":")
    with log.open("wb") as output:
        process = subprocess.Popen(
            words,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, "RUST_LOG": "info"},
        )

    def listens() -> bool:
        assert process.poll() is None, log.read_text()
        with socket.socket() as probe:
            return probe.connect_ex((host, int(port))) == 0

    try:
        until(listens, "a router that listens")
        yield process
        assert process.poll() is None, log.read_text()
    finally:
        process.terminate()
        process.wait(LONGEST_S)
