"""The command `driveby catalog`: recordings of a fleet, and crossings in them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.parser import Subcommand
from services.cli.parsing import EXIT_SOMETHING_LOST
from services.common.kinds import CATALOG_CSV, CROSSINGS_CSV
from services.common.naming import count_of
from services.common.options import flag, output_option, positional, site_option

if TYPE_CHECKING:
    from services.catalogue.positions import CatalogScan
    from services.catalogue.row import CatalogRow
    from services.finding.bridges import DetectedCrossing

_MAX_LINES = 40
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class CatalogOptions:
    """Options of `driveby catalog`: a folder of recordings, and the listing."""

    folder: str = positional("folder searched recursively for recordings", metavar="DIR|s3://…")
    verify: bool = flag(
        "read every recording and compare it with its catalogue row, even where size and time agree"
    )
    site: Path | None = site_option(
        "site file whose bridges' crossings are listed, from positions alone"
    )
    csv: Path | None = output_option(
        "CSV file of all crossings (with --site) or recordings; times are Unix times in s",
        "OUT.csv",
        CATALOG_CSV,
        CROSSINGS_CSV,
    )


def _catalog(options: CatalogOptions) -> int:
    from schemas.site_file import load_site
    from services.catalogue.index import update_catalog
    from services.catalogue.positions import crossings_of
    from services.common.files import check_writable, write_atomically
    from services.common.stores import check_folder, folder_at

    if options.csv is not None:
        check_writable(options.csv)
    site = None if options.site is None else load_site(options.site)
    folder = folder_at(options.folder)
    check_folder(folder)
    mended = update_catalog(folder, verify=options.verify)
    for problem in mended.problems:
        print(problem)
    rows = sorted(mended.rows.values(), key=lambda row: (row.first_ns, row.path))
    print(_summary(rows, mended.added, mended.without_row))
    if mended.deleted:
        print(f"{count_of(mended.deleted, 'recording')} deleted by a logger to keep its budget")
    if mended.still_open:
        print(f"{count_of(mended.still_open, 'more recording')} being written")
    table = list(_table_of_rows(rows))
    if site is not None:
        found = crossings_of(folder, rows, site)
        for problem in found.problems:
            print(problem)
        table = list(_table_of_crossings(found.crossings))
        _print_crossings(found)
    if options.csv is not None:
        write_atomically(options.csv, "".join(_csv(line) for line in table))
        print(options.csv)
    return EXIT_SOMETHING_LOST if mended.problems else 0


def _summary(rows: "list[CatalogRow]", added: int, not_counted: int) -> str:
    vehicles = {vehicle for row in rows for vehicle in row.vehicles}
    size = sum(row.size_bytes for row in rows)
    gaps = sum(row.gaps for row in rows)
    left = f", {count_of(not_counted, 'more file')} not counted: see above" if not_counted else ""
    summary = (
        f"{count_of(len(rows), 'recording')} ({added} new to the catalogue{left}), "
        f"{count_of(len(vehicles), 'truck')}, {size / 1e6:.1f} MB, {count_of(gaps, 'gap')}"
    )
    measured = [row for row in rows if row.vehicles]  # recordings of results have none
    if measured:
        begin, end = min(row.first_ns for row in measured), max(row.last_ns for row in measured)
        summary += f", {_time(begin)} to {_time(end)}"
    return summary


def _table_of_rows(rows: "list[CatalogRow]") -> Iterator[tuple[object, ...]]:
    yield (
        *("recording", "vehicles", "first_time", "last_time", "bytes", "messages", "gaps"),
        *("gap_s", "south_deg", "west_deg", "north_deg", "east_deg", "sha256"),
    )
    for row in rows:
        box = ("", "", "", "") if row.box is None else row.box
        times = (row.first_ns / _NS_PER_S, row.last_ns / _NS_PER_S)
        counts = (row.size_bytes, row.messages, row.gaps, row.gap_s)
        yield (row.path, " ".join(row.vehicles), *times, *counts, *box, row.content.hex())


def _table_of_crossings(found: "tuple[DetectedCrossing, ...]") -> Iterator[tuple[object, ...]]:
    yield (
        *("realm", "vehicle", "bridge", "direction", "entry_time", "exit_time", "passage"),
        "recordings",
    )
    for one in found:
        direction = "start_to_end" if one.forward else "end_to_start"
        times = (one.entry_ns / _NS_PER_S, one.exit_ns / _NS_PER_S)
        where = (one.realm, one.vehicle, one.bridge, direction)
        yield (*where, *times, one.passage.value, " ".join(one.recordings))


def _csv(line: tuple[object, ...]) -> str:
    import csv
    import io

    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(line)
    return out.getvalue()


def _print_crossings(found: "CatalogScan") -> None:
    for one in found.crossings[:_MAX_LINES]:
        seconds = (one.exit_ns - one.entry_ns) / _NS_PER_S
        how = f"{seconds:.1f} s on it" if one.passage.value == "through" else one.passage.value
        direction = "start to end" if one.forward else "end to start"
        print(
            f"{_time(one.entry_ns)}  {one.vehicle} over {one.bridge}, {direction}, {how}  "
            f"{' '.join(one.recordings)}"
        )
    if len(found.crossings) > _MAX_LINES:
        print(
            f"… and {count_of(len(found.crossings) - _MAX_LINES, 'more crossing')} (--csv has all)"
        )
    print(
        f"{count_of(len(found.crossings), 'crossing')}; {found.chunks_read} of {found.chunks} "
        f"chunks read from {count_of(found.files_read, 'recording')}"
    )


def _time(time_ns: int) -> str:
    from services.common.language import utc_second

    return utc_second(time_ns / _NS_PER_S)


COMMAND: Final = Subcommand(
    CatalogOptions,
    "driveby catalog recordings --site site.toml",
    _catalog,
)
