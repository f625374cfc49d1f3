"""The command `driveby worker`."""

from typing import Final

from services.cli.parser import Announce, ServiceCommand
from services.worker.settings import WorkerSettings


def _worker(asked: WorkerSettings, announce: Announce) -> int:
    from services.worker.run import run

    return run(asked, announce(f"ready, waiting for crossings in realm {asked.realm}"))


COMMAND: Final = ServiceCommand(
    WorkerSettings,
    "driveby worker --site site.toml",
    _worker,
)
