"""The logger as a process: `python logger_process.py LISTEN FOLDER`."""

import logging
import sys
from pathlib import Path

from services import logger
from tests.parent import die_with_parent


def main(listen: str, folder: str) -> int:
    logging.basicConfig(level=logging.INFO, stream=sys.stderr)
    return logger.run(
        listen=listen,
        folder=Path(folder),
        file=None,
        realms=("*",),
        site=None,
        ready=lambda: print("ready", flush=True),
    )


if __name__ == "__main__":
    die_with_parent()
    sys.exit(main(*sys.argv[1:]))
