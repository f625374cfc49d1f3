"""`driveby view --web` in a real browser without a screen."""

import base64
import contextlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest

from schemas.site_file import load_site
from services.common.errors import FailureError
from services.report.pdf import find_browser
from services.viewer.bridge_view import views_of_bridges
from services.viewer.rerun_file import RerunContent, write_rrd
from tests.unit.viewer.found import results_of, some_crossing
from tests.viewer_screen import pixels
from tests.waiting import LONGEST_S, until

OPTIONS = (
    "--headless=new", "--remote-debugging-pipe", "--no-first-run", "--no-sandbox",
    "--window-size=1400,850", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
)  # fmt: skip


class Browser:
    """A tab of a browser, over the pipe of its debugging protocol."""

    def __init__(self, commands: int, answers: BinaryIO) -> None:
        self._commands, self._answers = commands, answers
        self._last = 0
        tab = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.ask("Target.attachToTarget", targetId=tab, flatten=True)["sessionId"]

    def ask(self, method: str, session: str | None = None, **params: Any) -> dict[str, Any]:
        self._last += 1
        asked = {"id": self._last, "method": method, "params": params}
        if session is not None:
            asked["sessionId"] = session
        os.write(self._commands, json.dumps(asked).encode() + b"\0")
        while True:  # what is no answer is an event
            output = json.loads(self._message())
            if output.get("id") == self._last:
                return dict(output.get("result", {}))

    def open(self, address: str) -> None:
        self.ask("Page.navigate", self._session, url=address)

    def screenshot(self) -> np.ndarray:
        """Height, width and colours; nothing but black while the page is being replaced."""
        taken = self.ask("Page.captureScreenshot", self._session, format="png").get("data")
        return np.zeros((1, 1, 3)) if taken is None else pixels(base64.b64decode(taken))

    def _message(self) -> bytes:
        text = bytearray()
        while (letter := self._answers.read(1)) != b"\0":
            assert letter, "the browser has ended"
            text += letter
        return bytes(text)


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """Skips where there is none."""
    try:
        program = find_browser()
    except FailureError:
        pytest.skip("no browser (Debian: apt install chromium)")
    commands, answers = os.pipe(), os.pipe()
    # The browser reads commands from descriptor 3 and answers on 4.
    shell = f'exec "$@" 3<&{commands[0]} 4>&{answers[1]}'
    arguments = ["bash", "-c", shell, "browser", program, *OPTIONS, "about:blank"]
    arguments.insert(-1, f"--user-data-dir={folder / 'profile'}")
    with subprocess.Popen(
        arguments, pass_fds=(commands[0], answers[1]), stderr=subprocess.DEVNULL
    ) as process:
        os.close(commands[0])
        os.close(answers[1])
        try:
            with os.fdopen(answers[0], "rb") as output:
                yield Browser(commands[1], output)
        finally:
            process.terminate()
            os.close(commands[1])


@contextlib.contextmanager
def served(file: Path, folder: Path) -> Iterator[str]:
    """`driveby view FILE --web`, and the address that it says."""
    # BROWSER: none of the machine's is to open beside ours.
    own = {**os.environ, "HOME": str(folder), "BROWSER": "true", "NO_COLOR": "1"}
    command = [sys.executable, "-m", "driveby", "view", str(file), "--web"]
    log = folder / "viewer.log"
    with log.open("wb") as output:
        process = subprocess.Popen(command, env=own, stdout=output, stderr=output)
    try:
        address = re.compile(r"connect at (http://127\.0\.0\.1:\S+)")
        until(lambda: address.search(log.read_text()) or process.poll() is not None)
        found = address.search(log.read_text())
        assert found, log.read_text()
        yield found[1]
    finally:
        process.terminate()
        process.wait(timeout=LONGEST_S)


@pytest.mark.process
def test_the_bridge_is_seen_in_a_browser(tmp_path: Path, project: Path) -> None:
    site = load_site(project / "docs/site.example.toml")
    found = results_of(site, some_crossing("a"), used="a")
    rrd = tmp_path / "found.rrd"
    overviews = views_of_bridges(found, site)
    write_rrd(rrd, RerunContent({}, found.crossings, site, overviews))
    with browser(tmp_path) as tab, served(rrd, tmp_path) as address:
        tab.open(address)
        weak = np.array([230, 159, 0]) / 255.0
        until(
            lambda: (np.abs(tab.screenshot() - weak).max(axis=2) < 0.05).sum() > 2_000,
            "the bar of element 4",
        )
