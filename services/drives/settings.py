"""Options of `driveby import`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from services.common.kinds import IMPORT_MAP, PNG
from services.common.options import (
    file_option,
    flag,
    force_option,
    opt,
    output_option,
    positional,
    recording_option,
    site_option,
)

_TABLES: Final = "CSV tables of data loggers"


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Options of `driveby import`: files of a drive, how to read them, and outputs."""

    sources: tuple[Path, ...] = positional(
        "a folder with accel_NN.csv and gps_NN.csv, one such pair, a comma2k19 segment, "
        "or a recording of ROS 2 (a rosbag2 folder, .mcap, .db3)",
        Path,
        nargs="+",
        metavar="DIR | ACCEL.csv GPS.csv | ROS",
    )
    site: Path = site_option(
        "site file of truck and bridges; stored in the recording", required=True
    )
    vehicle: str | None = opt(
        "identifier of the site's vehicle that drove, needed if there are several", metavar="ID"
    )
    realm: str | None = opt(
        "NAME of the realm import-NAME, which the drives of one campaign share (default: name in "
        "[import] of the site file, else drives)",
        metavar="NAME",
    )
    preview: bool = flag(
        "print the guesses, the first rows and the curves as interpreted, and write nothing",
        group=_TABLES,
    )
    picture: Path | None = output_option(
        "figure of the first run as interpreted; writes no recording",
        "OUT.png",
        PNG,
        group=_TABLES,
    )
    write_map: Path | None = output_option(
        "file for the guessed column map, to read with --map", "MAP.toml", IMPORT_MAP, group=_TABLES
    )
    map: Path | None = file_option(
        "column map (files, columns, units, times) to read the tables with",
        "MAP.toml",
        group=_TABLES,
    )
    yes: bool = flag("accept guesses that change values (units, signs, gravity)", group=_TABLES)
    zone: str | None = opt(
        "time zone of times without one: UTC, +01:00, Europe/Berlin", group=_TABLES
    )
    start: str | None = opt(
        "start of times that count from 0, as ISO 8601 with a zone", group=_TABLES, metavar="TIME"
    )
    output: Path | None = recording_option()
    force: bool = force_option()

    @property
    def writes_no_recording(self) -> bool:
        """Whether the drive is only shown, as interpreted."""
        return self.preview or self.picture is not None or self.write_map is not None
