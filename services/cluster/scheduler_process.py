"""Scheduler process of `driveby cluster`: Dask's own, which ends with that command only.

    python -m services.common.child_process services.cluster.scheduler_process ARGUMENT…

The arguments are those of `dask scheduler`. Dask's scheduler ends with exit code 0 on SIGTERM and
SIGINT, at the request of any client (`Client.shutdown`) and after the time-out `idle-timeout` of
its configuration, each of which is a line at level INFO that is not shown. Here a client is
refused, and the cause of any end is written to the file that the environment names (`CAUSE_FILE`).
"""

import os
import signal
from pathlib import Path
from typing import Any, Final

CAUSE_FILE: Final = "DRIVEBY_CLUSTER_CAUSE_FILE"
"""Name of the environment variable with the path of the file for the cause of the end."""
_BY_SIGNAL: Final = "signal-"
"""Beginning of Dask's reasons where a signal is the cause; its number follows."""


def main() -> None:
    """Run Dask's command with a scheduler that records why it ends."""
    from distributed import Scheduler
    from distributed.cli import dask_scheduler

    class LastingScheduler(Scheduler):  # type: ignore[misc]  # Dask's classes have no types
        """A scheduler that no client ends, and that records the cause of its end."""

        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            self.handlers["terminate"] = _refuse

        async def close(self, timeout: float | None = None, reason: str = "unknown") -> None:
            """Record the cause, then end as Dask does."""
            _record(reason)
            await super().close(timeout=timeout, reason=reason)

    dask_scheduler.Scheduler = LastingScheduler
    dask_scheduler.main()


def _refuse(**_: object) -> None:
    raise PermissionError("the scheduler of driveby cluster ends with that command only")


def _record(reason: str) -> None:
    """Write the first cause of the end: Dask closes twice."""
    path = Path(os.environ[CAUSE_FILE])
    if not path.exists():
        path.write_text(_cause(reason))


def _cause(reason: str) -> str:
    """Return Dask's reason in words."""
    if not reason.startswith(_BY_SIGNAL):
        return reason
    return f"{signal.Signals(int(reason.removeprefix(_BY_SIGNAL))).name} from outside"


if __name__ == "__main__":
    main()
