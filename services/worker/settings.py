"""Options of `driveby worker`."""

from dataclasses import dataclass
from pathlib import Path

from services.common.endpoints import BusOptions
from services.common.options import (
    config_option,
    endpoint_option,
    flag,
    folder_option,
    id_option,
    method_option,
    number,
    opt,
    output_option,
    realm_option,
    site_option,
    tls_option,
    validations_option,
    whole,
)
from services.execution.hang_watchdog import LIMIT_S

_VALIDATION = "validation"


@dataclass(frozen=True, kw_only=True)
class WorkerSettings(BusOptions):
    """Settings of one run of the worker."""

    config: Path | None = config_option()
    endpoint: str | None = endpoint_option()
    tls: Path | None = tls_option()
    realm: str = realm_option()
    site: Path = site_option("site file of trucks and bridges", required=True)
    folder: Path = folder_option("folder of the results")
    file: Path | None = output_option(
        "single new file for the results, with a .json next to it", "RESULTS.mcap"
    )
    method: str = method_option()
    processes: int = opt(
        "number of processes that identify crossings, one at a time each (default: 1)",
        whole("processes", 1, 256),
        default=1,
        metavar="N",
    )
    limit_s: float = opt(
        "CPU time limit per crossing in s; beyond it the crossing is retried once (default: 900)",
        number("seconds", low=1, high=1e6),
        flags=("--cpu-limit",),
        default=LIMIT_S,
        metavar="S",
    )
    service_id: str = id_option("worker")
    validate_first: bool = flag(
        "identify only crossings whose truck and bridge have passed a site validation by "
        "simulation (always so in realm live)",
        alternatives=_VALIDATION,
    )
    skip_validation: bool = flag(
        "identify in realm live without site validation", alternatives=_VALIDATION
    )
    certificates: Path | None = validations_option(
        "folder of validation records (default: certificates in --folder)"
    )
    recordings: Path | None = opt(
        "folder of the logger's recordings, for crossings that trucks no longer send "
        "(default: --folder)",
        Path,
        metavar="DIR",
    )
    recordings_days: float = opt(
        "age in days of the oldest recordings for backfill (default: 2; 0: none)",
        number("days", low=0, high=3650),
        default=2.0,
        metavar="DAYS",
    )

    @property
    def search_method(self) -> str:
        """Name of the method in settings and results."""
        return self.method.replace("-", "_")

    @property
    def records_are_required(self) -> bool:
        """Whether a crossing waits for a validation record of its truck and bridge."""
        return self.validate_first or (self.realm == "live" and not self.skip_validation)
