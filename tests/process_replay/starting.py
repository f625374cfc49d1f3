"""How tests start services as processes: types of the fixtures, and the logger."""

import subprocess
from collections.abc import Callable
from pathlib import Path

Process = subprocess.Popen[str]
Start = Callable[..., Process]
"""Takes a room and the arguments of its `run`."""
End = Callable[[Process], None]


def start_logger(start: Start, endpoint: str, file: Path | None, **arguments: object) -> Process:
    """A logger of every realm that writes one file, unless the arguments say otherwise."""
    folder = None if file is None else file.parent
    settings = {"realms": ["*"], "site": None, "folder": folder} | arguments
    return start("services.logger", listen=endpoint, file=file, **settings)
