"""Options of `driveby logger`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from services.common.endpoints import DEFAULT_ENDPOINT, default_endpoint
from services.common.options import (
    config_option,
    flag,
    folder_option,
    id_option,
    number,
    opt,
    output_option,
    site_option,
    tls_option,
)

if TYPE_CHECKING:
    from services.logger.open_files import RotationLimits

_ROOM = "files and disk space"


@dataclass(frozen=True, kw_only=True)
class LoggerSettings:
    """Settings of one run of the logger."""

    config: Path | None = config_option()
    listen: str | None = opt(
        f"address to listen on (default: {DEFAULT_ENDPOINT})", metavar="ENDPOINT"
    )
    tls: Path | None = tls_option()
    insecure: bool = flag(
        "accept other machines without --tls; any session that reaches the address is accepted"
    )
    folder: Path = folder_option("folder of the recordings")
    file: Path | None = output_option("single new file for all messages", "REC.mcap")
    realms: tuple[str, ...] = opt(
        "realm to record, or pattern such as sim-* (*: all); repeatable (default: live)",
        flags=("--realm",),
        default=("live",),
        action="append",
        metavar="REALM",
    )
    site: Path | None = site_option("site file to store in the recordings")
    service_id: str = id_option("logger")
    rotate_minutes: float = opt(
        "start a truck's next file after this many minutes (default: 15; SIGUSR1: at once)",
        number("minutes", low=0.01, high=1e6),
        group=_ROOM,
        default=15.0,
        metavar="MIN",
    )
    rotate_mb: float = opt(
        "start a new file at this size in MB (default: 1000)",
        number("a size in MB", low=0.1, high=1e6),
        group=_ROOM,
        default=1000.0,
        metavar="MB",
    )
    min_free: float = opt(
        "minimum free disk space in MB to start; below it health is not ok, below an eighth of it "
        "recording stops (default: 500)",
        number("a size in MB", low=0, high=1e9),
        group=_ROOM,
        default=500.0,
        metavar="MB",
    )
    budget: float | None = opt(
        "limit of disk space in MB for recordings; beyond it the oldest of those whose "
        "crossings are all identified are deleted (default: delete nothing)",
        number("a size in MB", low=1, high=1e9),
        group=_ROOM,
        metavar="MB",
    )

    @property
    def address(self) -> str:
        """Address of the Zenoh router in this process."""
        return self.listen or default_endpoint(self.tls)

    @property
    def written(self) -> Path:
        """Folder of the recordings; with `file` that of the file."""
        return self.folder if self.file is None else self.file.parent

    @property
    def limits(self) -> "RotationLimits":
        """Limits of a file's age and size, and of free disk space."""
        from services.logger.open_files import RotationLimits

        return RotationLimits(
            age_s=self.rotate_minutes * 60.0,
            bytes=round(self.rotate_mb * 1e6),
            min_free_bytes=round(self.min_free * 1e6),
        )

    @property
    def budget_bytes(self) -> int | None:
        """Size beyond which the oldest identified recordings are deleted."""
        return None if self.budget is None else round(self.budget * 1e6)
