"""Processes that a test starts and ends."""

import signal
import subprocess

from tests.waiting import LONGEST_S


def stop(process: subprocess.Popen[str]) -> str:
    """End a service as a patient operator would; return its log. It must end well."""
    process.send_signal(signal.SIGTERM)
    _, log = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0, log
    return log
