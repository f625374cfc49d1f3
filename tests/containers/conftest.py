"""An engine of containers with the two base images, or one line that says what is missing."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.containers.stack import ROOT, Stack, engine_settings

VERSIONS = ROOT / "docs" / "scripts" / "container_versions.py"


def base_images() -> list[str]:
    base = re.search(r"^ARG BASE=(\S+)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    router = re.search(r"image: (eclipse/zenoh:\S+)", (ROOT / "compose.yaml").read_text())
    assert base is not None
    assert router is not None
    return [base[1], router[1]]


def missing() -> str:
    """Return in one line what the tests lack; empty if nothing."""
    done = subprocess.run(
        [sys.executable, VERSIONS],
        env={**os.environ, **engine_settings()},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        return (
            f"no engine for containers (sh tests/containers/engine.sh start): {done.stderr.strip()}"
        )
    stack = Stack("driveby-none")
    for image in base_images():
        if stack.docker("image", "inspect", image, check=False).code != 0:
            return f"no image {image} for containers: sh tests/containers/images.sh makes it"
    return ""


@pytest.fixture(scope="session")
def engine() -> None:
    """Skip where there is no engine that is new enough, or no base image."""
    why = missing()
    if why:
        pytest.skip(why)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A new folder for copies of volumes."""
    return tmp_path
