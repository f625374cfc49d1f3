"""Options of `driveby identify` and `driveby fuse`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from services.common.kinds import ARRAYS, NETCDF, RERUN, RESULTS
from services.common.options import (
    CERTIFICATES,
    baseline_option,
    fuse_suspect_option,
    method_option,
    opt,
    output_folder_option,
    output_option,
    positional,
    seed_option,
    site_option,
    source,
    validations_option,
    whole,
)

_MANY: Final = "many crossings"


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions:
    """Options of `driveby identify`: recordings, search and outputs."""

    recordings: tuple[Path | str, ...] = positional(
        "recordings, also as s3://…; with --into also folders of them",
        source,
        nargs="+",
        metavar="REC.mcap",
    )
    site: Path | None = site_option("site file (default: the site stored in the recording)")
    method: str = method_option()
    json: Path | None = output_option("JSON file of the results", "OUT.json", RESULTS)
    rrd: Path | None = output_option("Rerun file of the results", "OUT.rrd", RERUN)
    draws: Path | None = output_option(
        "file of the posterior draws of method pre (.nc: for ArviZ)",
        "OUT.npz|OUT.nc",
        ARRAYS,
        NETCDF,
    )
    figures: Path | None = output_folder_option(
        "folder for figures of every crossing and bridge, as PNG and SVG"
    )
    baseline: Path | None = baseline_option()
    fuse_suspect: bool = fuse_suspect_option()
    validations: Path | None = validations_option(
        f"folder of the validation records that results name (default: {CERTIFICATES})"
    )
    seed: int = seed_option()
    into: Path | None = output_folder_option(
        "folder that receives each result once it is computed; repeat the command to resume. "
        "Unreadable input is listed and skipped (exit code 3)",
        group=_MANY,
    )
    scheduler: str | None = opt(
        "number of processes on this machine (default N: one for each processor), or "
        "address of a Dask cluster; the results are the same",
        group=_MANY,
        metavar="processes|processes:N|tcp://…|tls://…",
    )
    batch: int | None = opt(
        "number of crossings in one task of a cluster (default: 50)",
        whole("a number of crossings", 1, 200),
        group=_MANY,
        metavar="N",
    )
    reconnect_timeout: int | None = opt(
        "seconds to wait for a lost scheduler or for workers (default: 300)",
        whole("seconds", 1, 86_400),
        group=_MANY,
        metavar="S",
    )
    tls: Path | None = opt(
        "credentials for the client of a Dask cluster", Path, group=_MANY, metavar="FOLDER"
    )

    @property
    def search_method(self) -> str:
        """Name of the method in settings and results."""
        return self.method.replace("-", "_")


@dataclass(frozen=True, kw_only=True)
class FuseOptions:
    """Options of `driveby fuse`: results to fuse, and outputs."""

    results: tuple[Path, ...] = positional(
        "results files to fuse", Path, nargs="+", metavar="RESULTS.json"
    )
    json: Path | None = output_option(
        "JSON file of all crossings and the fused estimates", "OUT.json", RESULTS
    )
    baseline: Path | None = baseline_option()
    fuse_suspect: bool = fuse_suspect_option()
    site: Path | None = site_option(
        "site file of the bridges (default: that of a recording in the results' folder)"
    )
    validations: Path | None = validations_option(
        f"folder of validation records (default: {CERTIFICATES})"
    )
