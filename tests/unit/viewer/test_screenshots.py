"""The pictures of docs/output.md, and that they can still be made."""

import re
from pathlib import Path

import numpy as np
import pytest

from services.cli import main as cli
from services.common.errors import FailureError
from services.report.pdf import find_browser
from tests import screenshots
from tests.viewer_screen import has_driver, pixels


def test_every_picture_is_there_small_and_named_on_the_page(project: Path) -> None:
    page = (project / "docs/output.md").read_text()
    shots = [shot.name for shot in (*screenshots.SHOTS, *screenshots.OF_SHARED.values())]
    others = ["view-live", "view-live-result", "watch", "report", *screenshots.PICTURES]
    for name in shots + others:
        assert (screenshots.FOLDER / f"{name}.png").stat().st_size < screenshots.MAX_BYTES
        assert f"(images/{name}.png)" in page
    shown = re.findall(r"\(images/([\w-]+)\.png\)", page)
    assert {name for name in shown if name.startswith("view-")} < {*shots, *others}


@pytest.mark.slow
@pytest.mark.process
def test_every_picture_can_be_made_and_shows_something(tmp_path: Path) -> None:
    if not has_driver():
        pytest.skip("no Vulkan driver (Debian: apt install mesa-vulkan-drivers libvulkan1)")
    screenshots.make_files(tmp_path)
    for shot in screenshots.SHOTS:
        taken = pixels(screenshots.smaller(screenshots.take(shot, tmp_path)))
        lit = (np.abs(taken - taken[-1, -1]).max(axis=2) > 0.2).mean()
        assert lit > 0.02, shot.name


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize(("name", "has_weak"), [("d3_edge", True), ("d9_everything", False)])
def test_bridges_of_many_crossings_can_be_shown(
    shared: Path, tmp_path: Path, name: str, has_weak: bool
) -> None:
    assert screenshots.SHARED.is_relative_to(shared)
    if not has_driver():
        pytest.skip("no Vulkan driver (Debian: apt install mesa-vulkan-drivers libvulkan1)")
    (which,) = (one for one in screenshots.OF_SHARED if one.startswith(name))
    taken = pixels(screenshots.smaller(screenshots.take_shared(which, tmp_path)))
    assert (taken.min(axis=2) > 0.95).mean() > 0.3  # the white picture of the bridge
    weak = np.abs(taken - np.array([230, 159, 0]) / 255.0).max(axis=2) < 0.05
    # The weak element's bar; of the many its neighbours and it are not resolved.
    assert weak.mean() > 0.002 if has_weak else not weak.any()


@pytest.mark.slow
@pytest.mark.process
def test_the_picture_of_the_demo_can_be_made_and_names_the_weak_element(tmp_path: Path) -> None:
    kept = screenshots.FOLDER / "demo.png"
    assert kept.stat().st_size < screenshots.MAX_BYTES
    taken = pixels(screenshots.smaller(screenshots.take_demo(tmp_path)))
    assert taken.shape == pixels(kept.read_bytes()).shape
    orange = np.abs(taken - np.array([230, 159, 0]) / 255.0).max(axis=2) < 0.05
    assert orange.mean() > 0.005


@pytest.mark.slow
@pytest.mark.process
def test_the_report_can_be_photographed_and_names_the_weak_element(tmp_path: Path) -> None:
    try:
        find_browser()
    except FailureError:
        pytest.skip("no browser (Debian: apt install chromium)")
    assert (screenshots.FOLDER / "report.png").stat().st_size < screenshots.MAX_BYTES
    outputs = ["--json", str(tmp_path / "good.json")]
    assert cli.main(["identify", str(screenshots.SAMPLE), *outputs]) == 0
    taken = pixels(screenshots.smaller(screenshots.take_report(tmp_path)))
    box = np.array([0xFD, 0xF0, 0xD5]) / 255.0  # of a finding that names an element
    assert (np.abs(taken - box).max(axis=2) < 0.02).mean() > 0.03


@pytest.mark.slow
@pytest.mark.process
def test_the_live_pictures_can_be_made(tmp_path: Path) -> None:
    if not has_driver():
        pytest.skip("no Vulkan driver (Debian: apt install mesa-vulkan-drivers libvulkan1)")
    taken = screenshots.take_live(tmp_path)
    assert set(taken) == {"view-live", "view-live-result"}
    weak = np.array([230, 159, 0]) / 255.0
    assert all(screenshots.smaller(png) for png in taken.values())
    # The weak element, at the right, is there after the drive; lines of the body are orange, too.
    right = [pixels(png)[:, 900:] for png in taken.values()]
    seen = [(np.abs(side - weak).max(axis=2) < 0.1).sum() for side in right]
    assert seen[0] == 0 < 50 < seen[1]


@pytest.mark.process
def test_the_terminal_can_be_drawn(tmp_path: Path) -> None:
    try:
        find_browser()
    except FailureError:
        pytest.skip("no browser (Debian: apt install chromium)")
    drawn = pixels(screenshots.smaller(screenshots.take_terminal(tmp_path, columns=80)))
    yellow = np.array([0.8, 0.7, 0.25])
    assert (np.abs(drawn - yellow).max(axis=2) < 0.15).sum() > 200  # the weak element's bars
