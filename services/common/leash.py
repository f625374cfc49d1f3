"""Runs a module as `python -m` does, in a process that ends with the one that started it.

    python -m services.common.leash MODULE ARGUMENT…

Standard input is the leash: a pipe into which nothing is ever written. It ends when the logger
closes it, and when the logger dies, however it dies. A child that lived on would rename recordings
which the next logger is about to read. (Linux can kill a child with its parent by itself, but takes
the thread that started it for the parent.)
"""

import os
import runpy
import signal
import sys
import threading
import time

from services.common.errors import EXIT_INTERRUPTED

_CLEAN_UP_S = 2.0
"""To remove what is half-written; then the process ends in any case."""


def _end_with_standard_input() -> None:
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(_CLEAN_UP_S)
    os._exit(EXIT_INTERRUPTED)


def main(module: str, *arguments: str) -> None:
    """Run the module, whose exit code is that of this process."""
    threading.Thread(target=_end_with_standard_input, name="leash", daemon=True).start()
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
