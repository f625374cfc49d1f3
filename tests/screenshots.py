"""The pictures of the README and of docs/output.md.

python -m tests.screenshots [NAME …]

From recordings/sample and the demo; two from crossings that are not in the repository. Needs a
Vulkan driver, be it one that draws with the processor (Debian: mesa-vulkan-drivers), and for the
report and the terminal a browser (Debian: chromium).
"""

import contextlib
import io
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from rerun.experimental import ViewerClient
from rich.console import Console

from schemas.site_file import load_site
from schemas.topics import Message
from services.cli import main as cli
from services.cli.watch_page import page
from services.recordings.recording import read_messages, read_site
from services.recordings.writer import write_recording
from services.report.pdf import find_browser
from services.viewer.view import convert
from tests.endpoints import free_endpoint, free_port
from tests.unit.cli.watching import NOW_NS, NOW_S, Listened, a_fleet
from tests.viewer_screen import complaints, has_driver, open_tab, opened, picture, pixels
from tests.waiting import LONGEST_S, until

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "recordings/sample/crossing.mcap"
FOLDER = ROOT / "docs/images"
MAX_BYTES = 150_000


class Shot(NamedTuple):
    """A picture: of which file, with which tabs in front, and where the front axle is."""

    name: str
    file: str
    tabs: tuple[str, ...]
    chainage_mm: int | None


SHOTS = (
    Shot("view-recording", "recording.rrd", ("Recording",), None),
    Shot("view-bridge", "good.rrd", ("Bridge",), 15_000),
    Shot("view-crossing", "good.rrd", ("2026-01-01",), 15_000),
    Shot("view-posterior", "good.rrd", ("2026-01-01", "Posterior and", "Map"), 15_000),
    Shot("view-left-over", "suspect.rrd", ("2026-01-01", "Residuals", "Map"), 15_000),
    Shot("view-suspect", "suspect.rrd", ("2026-01-01",), 9_000),
    Shot("view-rejected", "rejected.rrd", ("2026-01-01",), None),
)

PICTURES = {
    "picture-bridge": "good/bridge-1.png",
    "picture-suspect": "suspect/truck-1.*.png",
    "picture-rejected": "rejected/truck-1.*.png",
}
"""Pictures of `identify --figures`."""
SHARED = ROOT.parent / "shared/crossings"
"""Crossings of an independent simulator, which are not in the repository."""
OF_SHARED = {
    "d3_edge_damage_4_runs": Shot("view-four", "four.rrd", ("Bridge",), 15_000),
    "d9_everything_16_runs": Shot("view-many", "many.rrd", ("Bridge",), 15_000),
}


def main() -> int:
    if not has_driver():
        print(
            "no Vulkan driver (Debian: apt install mesa-vulkan-drivers libvulkan1)", file=sys.stderr
        )
        return 1
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        takers: dict[str, Callable[[], bytes]] = {
            shot.name: partial(take, shot, folder) for shot in SHOTS
        }
        takers["report"] = partial(take_report, folder)
        for shown, pattern in PICTURES.items():
            takers[shown] = partial(take_picture, folder, pattern)
        of_sample = set(takers)
        takers["demo"] = partial(take_demo, folder)
        takers["watch"] = partial(take_terminal, folder, columns=108)
        if SHARED.is_dir():
            takers |= {
                shot.name: partial(take_shared, of, folder) for of, shot in OF_SHARED.items()
            }
        chosen = sys.argv[1:] or [*takers, "view-live"]
        if of_sample & set(chosen):
            make_files(folder)
        for wanted in chosen:
            both = take_live(folder) if wanted == "view-live" else {wanted: takers[wanted]()}
            for shown, taken in both.items():
                path = FOLDER / f"{shown}.png"
                path.write_bytes(smaller(taken))
                print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e3:.0f} kB")
    return 0


def make_files(folder: Path) -> None:
    """The sample as it was recorded, as it is identified, and with noise declared too large."""
    convert(SAMPLE, folder / "recording.rrd")
    toml = read_site(SAMPLE)
    assert toml is not None
    louder = folder / "louder.toml"
    louder.write_text(re.sub(r"(?m)^noise_density_.*$", "noise_density_ug_per_rthz = 60.0", toml))
    for name, options in (("good", ()), ("suspect", ("--site", str(louder)))):
        outputs = ["--rrd", f"{folder / name}.rrd", "--json", f"{folder / name}.json"]
        outputs += ["--figures", str(folder / name)]
        assert cli.main(["identify", str(SAMPLE), *outputs, *options]) == 0
    write_recording(folder / "gap.mcap", with_a_gap(), site_toml=toml, reason="a gap")
    rejected = str(folder / "rejected.rrd")
    figures = ["--figures", str(folder / "rejected")]
    assert cli.main(["identify", str(folder / "gap.mcap"), "--rrd", rejected, *figures]) == 0


def with_a_gap() -> Iterator[Message]:
    """The sample without the accelerations of 0.3 s while the truck is on the bridge."""
    messages = list(read_messages(SAMPLE))
    times = [one.log_time_ns for one in messages if one.key.stream == "accel"]
    middle = times[len(times) // 2]
    for one in messages:
        if one.key.stream != "accel" or abs(one.log_time_ns - middle) > 150_000_000:
            yield one


def take_picture(folder: Path, pattern: str) -> bytes:
    """The picture that `identify --figures` wrote."""
    (path,) = folder.glob(pattern)
    return path.read_bytes()


def take_shared(name: str, folder: Path) -> bytes:
    """The bridge of the four or the sixteen crossings of one truck."""
    source, shot = SHARED / name, OF_SHARED[name]
    drive = str(folder / f"{name}.mcap")
    imported = ["import", str(source), "--site", str(source / "site.toml"), "-o", drive]
    assert cli.main(imported) == 0
    assert cli.main(["identify", drive, "--rrd", str(folder / shot.file)]) == 0
    return take(shot, folder)


def take_demo(folder: Path) -> bytes:
    """The picture that the demo leaves."""
    assert cli.main(["demo", "--out", str(folder / "demo")]) == 0
    return (folder / "demo/demo.png").read_bytes()


def take(shot: Shot, folder: Path, size: str = "1400x850") -> bytes:
    """A screenshot as PNG; AssertionError if the viewer complains of anything."""
    with opened(folder / shot.file, folder, size=size) as viewer:
        open_tab(viewer, *shot.tabs)
        if shot.chainage_mm is not None:
            viewer.set_time("chainage_mm", sequence=shot.chainage_mm, play_state="paused")
        else:
            viewer.set_time(play_state="paused")
        taken = picture(viewer)
        output = complaints(viewer)
        assert not output, output
        return taken


def take_report(folder: Path, size: str = "794,1084") -> bytes:
    """The top of the sample's report as a browser shows it, as wide as A4 at 96 pixels an inch."""
    html = folder / "report.html"
    site = folder / "site.toml"
    site.write_text(read_site(SAMPLE) or "")
    found = ["report", str(folder / "good.json"), "--site", str(site), "-o", str(html)]
    assert cli.main(found) == 0
    # Where the picture was made is of no interest.
    html.write_text(html.read_text().replace(f"{Path.cwd()}/", ""))
    return browsed(html, folder, size)


def browsed(page: Path, folder: Path, size: str) -> bytes:
    """A file as a browser shows it in a window of that size, as PNG."""
    png = folder / f"{page.stem}.png"
    options = ["--headless", "--disable-gpu", "--no-first-run", "--hide-scrollbars"]
    options += [f"--user-data-dir={folder / 'profile'}", f"--window-size={size}"]
    options += ["--no-sandbox"] if os.geteuid() == 0 else []
    command = [find_browser(), *options, f"--screenshot={png}", page.absolute().as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=LONGEST_S)
    return png.read_bytes()


def take_live(folder: Path, size: str = "1400x850") -> dict[str, bytes]:
    """`driveby view live` while the sample is driven, and when its result is there, as PNG."""
    endpoint, port = free_endpoint(), free_port()
    site = ["--site", str(ROOT / "docs/site.example.toml")]
    bus = ["--endpoint", endpoint, "--realm", "sim-first"]
    recorded = ["--listen", endpoint, "--realm", "*", "--folder", str(folder / "recordings")]
    found = [*bus, *site, "--folder", str(folder / "recordings")]
    with (
        running(folder, "logger", *recorded),
        running(folder, "worker", *found) as worker,
        running(folder, "view", "live", "--serve", "--port", str(port), *bus, *site),
    ):
        until(lambda: "ready, " in worker.read_text(), "the worker")
        with running(folder, "truck", str(SAMPLE), *bus):
            address = f"rerun+http://127.0.0.1:{port}/proxy"
            with opened(address, folder, size=size) as viewer:
                shows(viewer, ON_THE_BRIDGE, 300)
                driving = viewer.take_screenshot()
                shows(viewer, GOOD, 1500)
                answered = viewer.take_screenshot()
                output = complaints(viewer)
                assert not output, output
    return {"view-live": driving, "view-live-result": answered}


ON_THE_BRIDGE, GOOD = (0, 114, 178), (0, 158, 115)
"""Red, green and blue of two lanes; what is not looked at is drawn darker."""


def shows(viewer: ViewerClient, colour: tuple[int, int, int], fewest: int) -> None:
    """Wait until the lane of the crossing, at the left below the plots, has a colour."""

    def is_seen() -> bool:
        seen = pixels(viewer.take_screenshot())
        lanes = seen[3 * seen.shape[0] // 4 :, : 3 * seen.shape[1] // 5]
        wanted = 0.8 * np.array(colour) / 255.0
        return bool((np.abs(lanes - wanted).max(axis=2) < 0.06).sum() > fewest)

    until(is_seen, f"the colour {colour}")


@contextlib.contextmanager
def running(folder: Path, *arguments: str) -> Iterator[Path]:
    """A command as a process; what it says is in the file."""
    log = folder / f"{arguments[0]}.log"
    command = [sys.executable, "-m", "driveby", *arguments]
    own = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env=own)
    try:
        yield log
    finally:
        process.terminate()
        process.wait(timeout=LONGEST_S)


def take_terminal(folder: Path, columns: int, lines: int = 36) -> bytes:
    """A made-up morning on the page of `driveby watch`, as PNG, drawn by a browser."""
    shown = Console(record=True, width=columns, file=io.StringIO(), force_terminal=True)
    listened = Listened(alive={"truck-1", "truck-2"})
    watched = a_fleet(load_site(ROOT / "docs/site.example.toml"))
    where = "realm live at tcp/127.0.0.1:7447"
    shown.print(
        page(watched, where, listened, now_s=NOW_S, now_ns=NOW_NS, width=columns, height=lines)
    )
    svg = shown.export_svg(title="driveby watch")
    # Rich's font is on the internet: a browser may take its picture before that has answered.
    svg = re.sub(r"@font-face\s*{.*?}", "", svg, flags=re.DOTALL)
    width, height = (float(size) for size in re.findall(r'viewBox="0 0 (\S+) (\S+)"', svg)[0])
    drawn = folder / "terminal.svg"
    drawn.write_text(svg)
    return browsed(drawn, folder, f"{math.ceil(width)},{math.ceil(height)}")


def smaller(png: bytes) -> bytes:
    """With 128 colours, which is all that lines and words need."""
    written = io.BytesIO()
    # The median cut alone merges small patches of different colours; k-means parts them again.
    few = Image.open(io.BytesIO(png)).convert("RGB")
    few = few.quantize(128, kmeans=1, dither=Image.Dither.NONE)
    few.save(written, "png", optimize=True)
    assert len(written.getvalue()) < MAX_BYTES, f"{len(written.getvalue())} bytes"
    return written.getvalue()


if __name__ == "__main__":
    sys.exit(main())
