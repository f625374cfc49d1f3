"""Settings of a played truck and of the ROS 2 gateway."""

from dataclasses import dataclass
from pathlib import Path

from services.truck.spool import DEFAULT_BUDGET_BYTES


@dataclass(frozen=True, kw_only=True)
class TruckSettings:
    """A recording and the bus on which it is played as a truck that drives now."""

    recording: Path
    """Recording, or a folder of CSV files with a `site`."""
    endpoint: str
    realm: str
    speed: float = 1.0
    """Speed of the publication over real time, never of the data; 0: as fast as possible."""
    vehicle: str | None = None
    """One of several vehicles."""
    tls: Path | None = None
    """Folder of its credentials, see `open_session`."""
    spool: Path | None = None
    """Folder that keeps every message until a logger has it, see `services.truck.spool`."""
    spool_budget_bytes: int = DEFAULT_BUDGET_BYTES
    site: Path | None = None
    skip_gaps: bool = False
    """Whether silences between runs are skipped; they stay in the data."""


@dataclass(frozen=True, kw_only=True)
class GatewaySettings:
    """A router of ROS 2, the truck behind it, and the bus to which its data are published."""

    ros: str
    """Address of the router of ROS 2."""
    endpoint: str
    realm: str
    site: Path
    """Site file with the topics of the truck (`[ros2]`)."""
    vehicle: str | None = None
    """One of several trucks."""
    tls: Path | None = None
    spool: Path | None = None
    """Folder that keeps every message until a logger has it, see `services.truck.spool`."""
    spool_budget_bytes: int = DEFAULT_BUDGET_BYTES
