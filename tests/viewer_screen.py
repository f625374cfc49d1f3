"""The Rerun viewer without a screen: what it shows of a file, and what it complains about."""

import contextlib
import io
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from rerun.experimental import View, ViewerClient

from services.viewer.view import viewer_arguments, viewer_program
from tests.endpoints import free_port
from tests.waiting import LONGEST_S

_DRIVERS = [Path(root, "vulkan/icd.d") for root in ("/usr/share", "/etc", "/usr/local/share")]


def has_driver() -> bool:
    """Whether there is something to draw with."""
    return any(any(found.glob("*.json")) for found in _DRIVERS if found.is_dir())


@contextlib.contextmanager
def opened(file: Path | str, folder: Path, *, size: str = "1000x700") -> Iterator[ViewerClient]:
    """Open a file, or what a server has, in a viewer of its own, which keeps its settings in
    `folder`; skips without a driver."""
    if not has_driver():
        pytest.skip("no Vulkan driver (Debian: apt install mesa-vulkan-drivers libvulkan1)")
    port = free_port()
    arguments = viewer_arguments(file, web=False)
    arguments[arguments.index("--port") + 1] = str(port)
    arguments += ["--headless", "--renderer=vulkan", f"--window-size={size}"]
    own = {**os.environ, "HOME": str(folder), "XDG_CONFIG_HOME": str(folder / "config")}
    subprocess.run([viewer_program(), "analytics", "disable"], env=own, check=True)
    with subprocess.Popen(arguments, env=own, stderr=subprocess.DEVNULL) as viewer:
        try:
            yield _connected(port)
        finally:
            viewer.terminate()


def _connected(port: int) -> ViewerClient:
    """The viewer once it shows a recording."""
    deadline = time.monotonic() + LONGEST_S
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            if client.get_state().views:
                client.get_blueprint()
                return client
        except Exception:
            if time.monotonic() > deadline:
                raise
        assert time.monotonic() < deadline, "the viewer shows nothing"
        time.sleep(0.2)


def open_tab(client: ViewerClient, *names: str) -> None:
    """Bring tabs to the front whose names begin so, those of containers and those of views."""
    blueprint = client.get_blueprint().blueprint
    containers = {
        path: parts["ContainerBlueprint"]
        for path, parts in blueprint.items()
        if "ContainerBlueprint" in parts
    }

    def called(path: str) -> str:
        parts = blueprint[f"/{path}"]
        return str(next(iter(parts.values())).get("display_name", ""))

    for name in names:
        hit = False
        for container in containers.values():
            inside = container.get("contents", [])  # a name, where there is one
            for child in [inside] if isinstance(inside, str) else inside:
                if container["container_kind"] == "Tabs" and called(child).startswith(name):
                    container["active_tab"], hit = child, True
        assert hit, f"no tab {name}"
    client.set_blueprint(blueprint, of="recording")


def picture(client: ViewerClient, view: View | None = None) -> bytes:
    """A screenshot, as PNG, once two that follow each other are the same."""
    deadline = time.monotonic() + LONGEST_S
    chosen = None if view is None else view.view_id
    seen: list[bytes] = []
    # A viewer draws the frame that it was asked for, and what it loads comes some frames later.
    while len(seen) < 6 or seen[-1] != seen[-4]:
        assert time.monotonic() < deadline, "the viewer does not come to rest"
        time.sleep(0.1)
        seen.append(client.take_screenshot(chosen))
    return seen[-1]


def pixels(png: bytes) -> np.ndarray:
    """Height, width and red, green, blue from 0 to 1."""
    return np.asarray(imread(io.BytesIO(png))[:, :, :3])


def view_named(client: ViewerClient, name: str) -> View:
    """The view whose name begins so."""
    views = client.get_state().views
    found = [view for view in views if view.name.startswith(name)]
    assert found, f"no view {name}, only {[view.name for view in views]}"
    return found[0]


def complaints(client: ViewerClient) -> list[str]:
    """What views say that they cannot show, and warnings of the viewer but for tiles of maps and a
    processor that draws."""
    reports = [f"{v.name}: {report}" for v in client.get_state().views for report in v.reports]
    logs = [
        entry.message
        for entry in client.get_logs()
        if entry.level in ("WARN", "ERROR")
        and not entry.target.startswith(("walkers", "egui_wgpu"))
        and "Software rasterizer" not in entry.message
    ]
    return reports + logs
