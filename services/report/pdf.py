"""Conversion of an HTML file to PDF, by an installed browser without a screen."""

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from services.common.errors import FailureError
from services.common.files import write_atomically
from services.common.progress import Steps, no_step_progress

_BROWSERS = (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome",
    "microsoft-edge", "brave-browser",
)  # fmt: skip
_TIMEOUT_S = 120.0
_USUAL_S, _USUAL_S_PER_BYTE = 1.5, 0.7e-6
"""Usual time of printing in s: the browser reports no progress."""
_POLL_S = 0.1


def find_browser() -> str:
    """Return the first installed browser; FailureError with advice if there is none."""
    for name in _BROWSERS:
        found = shutil.which(name)
        if found is not None:
            return found
    raise FailureError(
        "--pdf needs Chromium, Chrome or Edge, none is installed (Debian: apt install chromium); "
        "or open the HTML file in any browser and print it"
    )


def write_pdf(html: Path, pdf: Path, browser: str, progress: Steps = no_step_progress) -> None:
    """Print an HTML file; FailureError if the browser does not.

    `progress` is called with the milliseconds passed, and the usual ones.
    """
    with tempfile.TemporaryDirectory(prefix="driveby-pdf-") as folder:
        printed = Path(folder) / "report.pdf"
        command = [
            browser,
            "--headless",
            "--disable-gpu",
            "--no-first-run",
            "--no-pdf-header-footer",
            f"--user-data-dir={folder}/profile",
            f"--print-to-pdf={printed}",
            # Its sandbox does not start for root; the page has no scripts, and may load nothing.
            *(["--no-sandbox"] if os.geteuid() == 0 else []),
            html.absolute().as_uri(),
        ]
        try:
            code = _run(command, _USUAL_S + _USUAL_S_PER_BYTE * html.stat().st_size, progress)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise FailureError(f"{pdf}: {browser} did not print it: {error}") from error
        if not printed.is_file() or not printed.read_bytes().startswith(b"%PDF"):
            raise FailureError(
                f"{pdf}: {browser} ended with {code} and printed nothing; the report is in {html}"
            )
        write_atomically(pdf, printed.read_bytes())


def _run(command: list[str], usual_s: float, progress: Steps) -> int:
    """Return the exit code; subprocess.TimeoutExpired for a command that does not end."""
    began, usual_ms = time.monotonic(), round(1e3 * usual_s)
    nowhere = subprocess.DEVNULL
    with subprocess.Popen(command, stdout=nowhere, stderr=nowhere) as process:
        try:
            while (passed_s := time.monotonic() - began) < _TIMEOUT_S:
                progress(min(round(1e3 * passed_s), usual_ms), usual_ms)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    return process.wait(timeout=_POLL_S)
        finally:
            process.kill()  # it has no effect on an ended process
    raise subprocess.TimeoutExpired(command, _TIMEOUT_S)
