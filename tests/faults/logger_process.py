"""The logger as a process: `python logger_process.py LISTEN FOLDER`."""

import logging
import os
import sys
from pathlib import Path
from typing import Any

from zenoh import ext

from services.bus import subscription
from services.logger import run as logger
from services.logger.settings import LoggerSettings
from tests.parent import die_with_parent

FORGETFUL_ENV = "DRIVEBY_TEST_FORGETFUL"
"""If set, nothing that was missed comes by Zenoh: only the spools of trucks have it."""


def forget_publishers() -> None:
    """Subscribe as Zenoh does to a publisher that it has forgotten.

    An advanced subscriber forgets one that was silent for an hour, and no setting changes that
    time. It asks for no history then, notices no gap and recovers nothing. Our own queries to the
    caches of publishers are left out too.
    """
    advanced = ext.declare_advanced_subscriber

    def plain(session: Any, where: str, handler: Any, **_: object) -> Any:
        return advanced(session, where, handler)

    ext.declare_advanced_subscriber = plain
    subscription._GAP_TRIES = 0


def main(listen: str, folder: str) -> int:
    logging.basicConfig(level=logging.INFO, stream=sys.stderr)
    return logger.run(
        LoggerSettings(listen=listen, folder=Path(folder), file=None, realms=("*",), site=None),
        ready=lambda: print("ready", flush=True),
    )


if __name__ == "__main__":
    die_with_parent()
    if os.environ.get(FORGETFUL_ENV):
        forget_publishers()
    sys.exit(main(*sys.argv[1:]))
