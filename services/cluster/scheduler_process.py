"""The scheduler below `driveby cluster`: Dask's own, which ends with that command only.

    python -m services.common.leash services.cluster.scheduler_process ARGUMENT…

The arguments are those of `dask scheduler`. Dask's scheduler ends with exit code 0 on SIGTERM and
SIGINT, when any client asks for it (`Client.shutdown`) and after the time-out `idle-timeout` of its
configuration, and each of them is a line at level INFO that nobody sees. Here a client is refused,
and the cause of any end stands in the file that the environment names (`CAUSE_FILE`).
"""

import os
import signal
from pathlib import Path
from typing import Any, Final

CAUSE_FILE: Final = "DRIVEBY_CLUSTER_CAUSE_FILE"
"""Name of the environment variable with the path of the file for the cause of the end."""
_BY_SIGNAL: Final = "signal-"
"""Dask's reasons begin so where a signal is the cause; its number follows."""


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
    """Write the cause of the end; the first one, as Dask closes what it has closed once more."""
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
