"""Settings of the worker, for its parser too: no library is imported."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from services.execution.hang_watchdog import LIMIT_S

RECORDINGS_DAYS: Final = 2.0
"""Age in days up to which recordings are scanned; older crossings need a request."""


@dataclass(frozen=True, kw_only=True)
class WorkerSettings:
    """Settings of one run of the worker."""

    endpoint: str
    realm: str
    site: Path
    folder: Path
    """Folder of the results, in a folder of the realm."""
    file: Path | None = None
    """Single new file for the results, instead of one in `folder`."""
    method: str
    service_id: str
    tls: Path | None = None
    """Folder of credentials, see `open_session`."""
    processes: int = 1
    """Number of processes, each of which identifies one crossing at a time."""
    limit_s: float = LIMIT_S
    """Processor time in s after which an identification is ended."""
    certificates: Path | None = None
    """Folder of validation records, by default one in `folder`."""
    validate: bool | None = None
    """Whether crossings wait for a validation record; None: in realm `live` only."""
    recordings: Path | None = None
    """Folder of the logger's recordings, by default `folder`."""
    recordings_days: float = RECORDINGS_DAYS
    """Age in days of the oldest recordings that are read; 0: none."""

    @property
    def records_are_required(self) -> bool:
        """Whether a crossing waits for a validation record of its truck and bridge."""
        return self.realm == "live" if self.validate is None else self.validate
