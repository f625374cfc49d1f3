"""Steps of the worker's loop, with stand-ins for the parts that they call."""

import logging
import queue
import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest

from services.worker.loop import Loop


def test_stop_logs_once_what_is_finished(caplog: pytest.LogCaptureFixture) -> None:
    """Crossings that are finished take up to minutes, in which an operator reads this line."""
    caplog.set_level(logging.INFO)
    execution = SimpleNamespace(running=["a", "b"], waiting=3)
    certificates = SimpleNamespace(end=lambda: None)
    service: Any = SimpleNamespace(engine=None, execution=execution, certificates=certificates)
    loop = Loop(service, cast(Any, queue.Queue()), threading.Event())
    loop.hurry()
    loop.hurry()
    assert caplog.messages == ["stopping: finishing 5 crossings; a second signal ends at once"]
