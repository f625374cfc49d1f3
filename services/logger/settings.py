"""Settings of the logger; no library is imported."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from services.logger.writer import RotationLimits


@dataclass(frozen=True, kw_only=True)
class LoggerSettings:
    """Settings of one run of the logger."""

    listen: str
    """Address of the Zenoh router in this process, e.g. `tcp/127.0.0.1:7447`."""
    folder: Path
    """Folder of the recordings `REALM/DATE/VEHICLE-TIME.mcap`."""
    file: Path | None = None
    """Single new file for all messages, instead of those in `folder`."""
    realms: Sequence[str] = ("live",)
    """Recorded realms: names, or beginnings followed by `*` (`sim-*`; `*`: every one)."""
    site: Path | None = None
    """Site file whose text is stored in every recording."""
    service_id: str = "logger"
    tls: Path | None = None
    """Folder of credentials, see `open_session`."""
    insecure: bool = False
    """Whether to listen to other machines without credentials."""
    limits: "RotationLimits | None" = None
    """Start of the next file of a truck, and free space of the disk; None: the usual ones."""
    budget_bytes: int | None = None
    """Size beyond which the oldest identified recordings are deleted."""

    @property
    def written(self) -> Path:
        """Folder that is written to."""
        return self.folder if self.file is None else self.file.parent
