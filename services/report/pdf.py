"""An HTML file as PDF, by a browser that is installed and draws without a screen."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from services.common.errors import FailureError
from services.common.files import write_atomically

_BROWSERS = (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome",
    "microsoft-edge", "brave-browser",
)  # fmt: skip
_TIMEOUT_S = 120.0


def find_browser() -> str:
    """The first browser that there is; FailureError with a way out if there is none."""
    for name in _BROWSERS:
        found = shutil.which(name)
        if found is not None:
            return found
    raise FailureError(
        "--pdf needs Chromium, Chrome or Edge, none is installed (Debian: apt install chromium); "
        "without --pdf, open the HTML file in any browser and print it"
    )


def write_pdf(html: Path, pdf: Path, browser: str) -> None:
    """Print an HTML file; FailureError if the browser does not."""
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
            done = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise FailureError(f"{pdf}: {browser} did not print it: {error}") from error
        if not printed.is_file() or not printed.read_bytes().startswith(b"%PDF"):
            raise FailureError(
                f"{pdf}: {browser} ended with {done.returncode} and printed nothing; the report is "
                f"in {html}"
            )
        write_atomically(pdf, printed.read_bytes())
