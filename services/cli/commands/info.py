"""The command `driveby info`: contents of recordings, for people and as JSON."""

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from services.cli.parser import Subcommand
from services.common.errors import InputError
from services.common.naming import count_of
from services.common.options import flag, positional, site_option

if TYPE_CHECKING:
    from schemas.site import Site
    from services.catalogue.contents import Gap, RecordingSummary, SampleGaps, TruckSummary
    from services.finding.bridges import DetectedCrossing

_NS_PER_S: Final = 1_000_000_000  # schemas.signals has it too, and takes numpy to import
_MAX_LINES: Final = 20
"""Maximum number of gaps and crossings of a recording in the listing."""


_NEXT_FILE_NS: Final = 5 * _NS_PER_S
"""Longest time between two recordings that each hold a part of a crossing."""


@dataclass(frozen=True, kw_only=True)
class InfoOptions:
    """Recordings to summarise."""

    paths: tuple[Path, ...] = positional(
        "recordings, or folders searched recursively for recordings",
        Path,
        nargs="+",
        metavar="REC.mcap|DIR",
    )
    site: Path | None = site_option("site file of the bridges (default: that of each recording)")
    json: bool = flag("print the summary as JSON")


def _info(options: InfoOptions) -> int:
    from schemas.site_file import load_site
    from services.catalogue.contents import summarise_recording
    from services.common.progress import reading_bar
    from services.recordings.merge import recordings_in

    site = None if options.site is None else load_site(options.site)
    found: list[RecordingSummary] = []
    unreadable: dict[Path, str] = {}
    recordings = list(recordings_in(options.paths))
    with reading_bar("reading", recordings) as next_file:
        for path in recordings:
            try:
                found.append(summarise_recording(path, site, progress=next_file()))
            except InputError as error:
                if path in options.paths:  # the other files of a folder are still of interest
                    raise
                unreadable[path] = str(error).removeprefix(f"{path}: ")
    if options.json:
        content = [as_json(one) for one in found]
        content += [{"path": str(path), "error": error} for path, error in unreadable.items()]
        print(json.dumps({"recordings": content}, indent=1, ensure_ascii=False))
        return 0
    if len(found) == 1 and not unreadable:
        print("\n".join(lines_of(found[0])))
    else:
        _print_table(found, unreadable)
    return 0


def as_json(one: "RecordingSummary") -> dict[str, Any]:
    """Return the complete summary of a recording; times are seconds since 1970 UTC."""
    about, info = one.info.about, one.info
    return {
        "path": str(one.path),
        "size_bytes": one.size_bytes,
        "program": about.get("program"),
        "version": about.get("version"),
        "begin": one.first_ns / _NS_PER_S,
        "end": one.last_ns / _NS_PER_S,
        "is_closed": info.end is not None,
        "is_cut_off": info.truncated,
        "damaged_places": info.damaged_chunks,
        "messages": info.messages,
        "site": None if one.site is None else _site_as_json(one.site),
        "site_error": one.site_error,
        "trucks": [
            {
                "realm": truck.realm,
                "vehicle": truck.vehicle,
                "boots": truck.boots,
                "begin": truck.first_ns / _NS_PER_S,
                "end": truck.last_ns / _NS_PER_S,
                "streams": {name: s._asdict() for name, s in truck.streams.items()},
                "channel_rates_hz": truck.channel_rates_hz,
                "sample_gaps": truck.sample_gaps._asdict(),
            }
            for truck in one.trucks
        ],
        "gaps": [
            {
                "vehicle": gap.vehicle,
                "stream": gap.stream,
                "begin": gap.begin_ns / _NS_PER_S,
                "end": gap.end_ns / _NS_PER_S,
            }
            for gap in one.gaps
        ],
        "crossings": [
            {
                "realm": passing.realm,
                "vehicle": passing.vehicle,
                "bridge": passing.bridge,
                "direction": _direction(passing).replace(" ", "_"),
                "entry_time": passing.entry_ns / _NS_PER_S,
                "exit_time": passing.exit_ns / _NS_PER_S,
                "passage": passing.passage.value.replace(" ", "_"),
            }
            for passing in one.passings
        ],
    }


def _site_as_json(site: "Site") -> dict[str, Any]:
    return {
        "vehicles": [vehicle.id for vehicle in site.vehicles],
        "bridges": [
            {
                "id": bridge.id,
                "owner_id": bridge.owner_id,
                "span_m": bridge.span_m,
                "elements": bridge.elements,
            }
            for bridge in site.bridges
        ],
    }


def lines_of(one: "RecordingSummary") -> Iterator[str]:
    """Yield the lines of one recording's summary."""
    seconds = (one.last_ns - one.first_ns) / _NS_PER_S
    yield f"{one.path}"
    yield f"  {_size(one.size_bytes)}, {_state(one)}"
    if not one.info.messages:
        yield "  no messages"
        return
    yield f"  {_day(one.first_ns)} {_time(one.first_ns)} to {_end(one)} UTC, {_length(seconds)}"
    if one.site is not None:
        bridges = ", ".join(
            f"{b.id} ({b.owner_id + ', ' if b.owner_id else ''}{b.span_m:g} m, "
            f"{b.elements} elements)"
            for b in one.site.bridges
        )
        vehicles = ", ".join(vehicle.id for vehicle in one.site.vehicles)
        yield f"  site: {vehicles} over {bridges}"
    else:
        yield f"  site: {one.site_error or 'none stored in it; crossings are not known'}"
    for truck in one.trucks:
        yield from _lines_of_truck(truck)
    others = Counter(
        {
            name.split("/", 3)[3]: number
            for name, number in one.info.messages.items()
            if "/vehicle/" not in name
        }
    )
    for name, number in sorted(others.items()):
        yield f"{name}: {count_of(number, 'message')}"
    silences = ("silence of more than a second", "silences of more than a second")
    yield from _some(silences, one.gaps, map(_line_of_gap, one.gaps))
    if one.site is not None:
        yield from _some(
            ("crossing", "crossings"), one.passings, map(_line_of_passing, one.passings)
        )


def _lines_of_truck(truck: "TruckSummary") -> Iterator[str]:
    seconds = (truck.last_ns - truck.first_ns) / _NS_PER_S
    boots = f", {truck.boots} runs" if truck.boots > 1 else ""
    yield f"{truck.vehicle} in realm {truck.realm}: {_length(seconds)}{boots}"
    for name, stream in truck.streams.items():
        rate = f", {stream.rate_hz:.3g} a second" if stream.rate_hz is not None else ""
        missing = f", {stream.missing} missing" if stream.missing else ""
        yield f"  {name}: {count_of(stream.messages, 'message')}{rate}{missing}"
        if name == "accel" and truck.channel_rates_hz:
            rates = truck.channel_rates_hz
            if len(set(rates.values())) == 1:
                yield f"    {', '.join(rates)}: {next(iter(rates.values())):g} Hz"
            else:
                yield "    " + ", ".join(f"{c} {rate:g} Hz" for c, rate in rates.items())
            yield f"    {_gaps_in_words(truck.sample_gaps)}"


def _gaps_in_words(gaps: "SampleGaps") -> str:
    if not gaps.number:
        return "no gaps in the samples"
    return (
        f"{count_of(gaps.number, 'gap')} in the samples, {gaps.total_s:.3g} s in all, the "
        f"longest {gaps.longest_s:.3g} s; one on a bridge rejects the crossing (gap_on_bridge)"
    )


def _some(
    what: tuple[str, str], all_of_them: "tuple[object, ...]", lines: Iterable[str]
) -> Iterator[str]:
    """Yield the number of things, named in singular and plural, and their first lines."""
    number = len(all_of_them)
    yield f"{number or 'no'} {what[number != 1]}"
    for _, line in zip(range(_MAX_LINES), lines, strict=False):
        yield f"  {line}"
    if number > _MAX_LINES:
        yield f"  … and {number - _MAX_LINES} more (--json has all)"


def _line_of_gap(gap: "Gap") -> str:
    seconds = (gap.end_ns - gap.begin_ns) / _NS_PER_S
    return f"{_time(gap.begin_ns)}  {gap.vehicle} {gap.stream}: nothing for {seconds:.1f} s"


def _line_of_passing(passing: "DetectedCrossing") -> str:
    seconds = (passing.exit_ns - passing.entry_ns) / _NS_PER_S
    through = passing.passage.value == "through"
    how = f"{seconds:.1f} s on it" if through else passing.passage.value
    return (
        f"{_day(passing.entry_ns)} {_time(passing.entry_ns)}  {passing.vehicle} over "
        f"{passing.bridge}, {_direction(passing)}, {how}"
    )


def _print_table(found: "list[RecordingSummary]", unreadable: dict[Path, str]) -> None:
    """Print a line for each file, its name last, as names are long."""
    rows = [("from (UTC)", "length", "trucks", "crossings", "gaps", "size", "state", "recording")]
    for one in sorted(
        found,
        key=lambda summarise_recording: (summarise_recording.first_ns, summarise_recording.path),
    ):
        begin = f"{_day(one.first_ns)} {_time(one.first_ns)[:8]}"
        rows.append(
            (
                begin if one.info.messages else "—",
                _length((one.last_ns - one.first_ns) / _NS_PER_S),
                ", ".join(sorted({truck.vehicle for truck in one.trucks})) or "—",
                "not known" if one.site is None else str(len(one.passings)),
                str(_number_of_gaps(one)),
                _size(one.size_bytes),
                _state(one),
                str(one.path),
            )
        )
    widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]) - 1)]
    for *cells, name in rows:
        aligned = (cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
        print("  ".join([*aligned, name]))
    for path, error in unreadable.items():
        print(f"{path}: {error}")
    for line in _same_starts(found):
        print(line)
    trucks = {truck.vehicle for one in found for truck in one.trucks}
    crossings = _number_of_crossings(found)
    counts = [
        count_of(len(found) + len(unreadable), "recording"),
        _size(sum(one.size_bytes for one in found)),
        count_of(len(trucks), "truck"),
        count_of(crossings, "crossing"),
    ]
    print(", ".join(counts))


def _same_starts(found: "list[RecordingSummary]") -> Iterator[str]:
    """Yield a line for each truck whose recordings differ and begin at the same time."""
    sizes: dict[tuple[str, str, int], Counter[int]] = {}
    for one in found:
        for truck in one.trucks:
            name = (truck.realm, truck.vehicle, truck.first_ns)
            sizes.setdefault(name, Counter())[one.size_bytes] += 1
    for (_, vehicle, first_ns), of in sizes.items():
        if len(of) > 1:
            yield (
                f"{vehicle}: {of.total()} recordings start at {_day(first_ns)} {_time(first_ns)}; "
                "if they are different drives, identify counts only the first one"
            )


def _number_of_crossings(found: "list[RecordingSummary]") -> int:
    """Return the number of crossings; one in several recordings, or cut by them, counts once."""
    by_truck: dict[tuple[str, str, str, bool], list[DetectedCrossing]] = {}
    for one in (passing for summary in found for passing in summary.passings):
        name = (one.realm, one.vehicle, one.bridge, one.forward)
        by_truck.setdefault(name, []).append(one)
    return sum(
        sum(not _is_same(*pair) for pair in pairwise(sorted(of_truck, key=attrgetter("entry_ns"))))
        + 1
        for of_truck in by_truck.values()
    )


def _is_same(earlier: "DetectedCrossing", later: "DetectedCrossing") -> bool:
    """Return whether two recordings hold the same crossing, or the later one its rest."""
    from services.finding.stays import Passage, are_one

    return are_one(earlier.entry_ns, earlier.exit_ns, later.entry_ns, later.exit_ns) or (
        earlier.passage is Passage.ENDS_ON_BRIDGE
        and later.passage is Passage.BEGINS_ON_BRIDGE
        and later.entry_ns - earlier.exit_ns < _NEXT_FILE_NS
    )


def _number_of_gaps(one: "RecordingSummary") -> int:
    """Return the number of gaps in samples, and of silences of other streams."""
    silences = sum(gap.stream != "accel" for gap in one.gaps)
    return silences + sum(truck.sample_gaps.number for truck in one.trucks)


def _state(one: "RecordingSummary") -> str:
    places = one.info.damaged_chunks
    damage = f", {count_of(places, 'damaged place')}" if places else ""
    if one.info.truncated:
        return f"being written or cut off{damage}"
    return damage.removeprefix(", ") or "complete"


def _direction(passing: "DetectedCrossing") -> str:
    return "start to end" if passing.forward else "end to start"


def _end(one: "RecordingSummary") -> str:
    same_day = _day(one.first_ns) == _day(one.last_ns)
    return _time(one.last_ns) if same_day else f"{_day(one.last_ns)} {_time(one.last_ns)}"


def _day(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / _NS_PER_S, UTC).strftime("%Y-%m-%d")


def _time(time_ns: int) -> str:
    moment = datetime.fromtimestamp(time_ns / _NS_PER_S, UTC)
    return f"{moment:%H:%M:%S}.{moment.microsecond // 100_000}"


def _length(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60.0)
    hours, minutes = divmod(int(minutes), 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02.0f} s" if minutes else f"{rest:.1f} s"


def _size(size_bytes: int) -> str:
    for unit, bytes_ in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size_bytes >= bytes_:
            return f"{size_bytes / bytes_:.3g} {unit}"
    return f"{size_bytes} B"


COMMAND: Final = Subcommand(
    InfoOptions,
    "driveby info recordings/sample/crossing.mcap",
    _info,
)
