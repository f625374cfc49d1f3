"""The command `driveby history`: results over years, and one bridge over time."""

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.alarm_line import alarm_line
from services.cli.parser import Subcommand
from services.cli.parsing import EXIT_SOMETHING_LOST, a_console
from services.common.errors import InputError
from services.common.kinds import HISTORY_CSV, HISTORY_JSON, RERUN
from services.common.language import ENGLISH
from services.common.naming import count_of
from services.common.options import (
    file_option,
    flag,
    history_option,
    opt,
    output_folder_option,
    output_option,
    positional,
    site_option,
)

if TYPE_CHECKING:
    from schemas.results import Results
    from services.history.bridge_history import BridgeHistory, HistoryEntry, StoredBaseline
    from services.history.periods import FusedPeriod, Unit

_ADD = "add"


@dataclass(frozen=True, kw_only=True)
class HistoryOptions:
    """Results to add, or a bridge to show."""

    words: tuple[str, ...] = positional(
        "name of the bridge to show; or add, followed by results files or folders of identify "
        "--into or a worker; if omitted, a table of all bridges is shown",
        nargs="*",
        metavar="BRIDGE | add RESULTS …",
    )
    history: Path = history_option()
    realm: str | None = opt("realm of the bridge, if it is in several (default: the only one)")
    period: "Unit" = opt(
        "length of the periods whose crossings are fused (default: month)",
        default="month",
        choices=("day", "week", "month"),
    )
    site: Path | None = site_option(
        "site file that names the figures' baseline (without it: the first period)"
    )
    temperature: Path | None = file_option(
        "with add: CSV file of temperatures (time_s,temperature_deg_c[,bridge])", "T.csv"
    )
    defer_fusion: bool = flag("with add: postpone fusion until the bridge is first shown")
    csv: Path | None = output_option(
        "CSV file with a row for each period and element", "OUT.csv", HISTORY_CSV
    )
    json: Path | None = output_option("JSON file of periods and alarms", "OUT.json", HISTORY_JSON)
    figures: Path | None = output_folder_option(
        "folder for figures of the bridge over time, as PNG and SVG"
    )
    rrd: Path | None = output_option("Rerun file of EI over time", "OUT.rrd", RERUN)
    view: bool = flag("open EI over time in the Rerun viewer")
    web: bool = flag("open EI over time in the browser")
    sql: str | None = opt("query of the tables crossings and results (DuckDB)", metavar="SELECT …")


def _history(options: HistoryOptions) -> int:
    words = options.words
    if words[:1] == (_ADD,) and len(words) > 1:
        return _add(options, [Path(word) for word in words[1:]])
    if options.temperature is not None:
        raise InputError("--temperature: has no effect without add RESULTS")
    if len(words) > 1:
        raise InputError(f"history: one bridge is expected, or {_ADD} RESULTS …")
    return _show(options, words[0]) if words else _table(options)


def _add(options: HistoryOptions, paths: list[Path]) -> int:
    problems: list[str] = []
    # All of them are checked before any is written.
    sources = [(path, _results_of(path, problems.append)) for path in paths]
    driven: set[HistoryEntry] = set()
    for path, some in sources:
        print(_add_one(options, path, some, driven))
    for problem in problems:
        print(problem)
    if not options.defer_fusion:
        from services.common.progress import steps_bar
        from services.execution.blas import one_blas_thread
        from services.history.bridge_history import prefuse_periods

        unit = options.period
        with steps_bar(f"fusing {unit}s", a_console()) as progress, one_blas_thread():
            prefuse_periods(options.history, driven, unit, print, progress)
    return EXIT_SOMETHING_LOST if problems else 0


def _results_of(path: Path, problem: Callable[[str], object]) -> "Iterable[Results]":
    """Yield the results of a file, or a folder of `identify --into` or workers; else InputError."""
    from schemas.results import load_results
    from services.execution.result_store import files_of, kept_results
    from services.ledger.worker_results import files_of_workers, results_of_workers

    if not path.is_dir():
        return (load_results(path),)
    if files_of(path):
        return kept_results(path, problem)
    if files_of_workers(path):
        return results_of_workers(path, problem)
    raise InputError(
        f"{path}: has no results; HASH.parquet of driveby identify --into or results-TIME.json of "
        "driveby worker (in FOLDER/REALM) are expected"
    )


def _add_one(
    options: HistoryOptions, path: Path, some: "Iterable[Results]", driven: "set[HistoryEntry]"
) -> str:
    """Add a file or a folder, record the positions of its crossings, and return a summary."""
    from services.history.add_summary import AddSummary, summed
    from services.history.bridge_history import HistoryEntry
    from services.history.history_store import add_results
    from services.history.temperatures import nearest_row_s, no_match, temperatures_of

    parts, warm, nearest_s = [], set[str](), math.inf
    for results in some:
        known = {}
        if options.temperature is not None:
            known = temperatures_of(options.temperature, results.crossings)
            if not known:
                away_s = nearest_row_s(options.temperature, results.crossings)
                nearest_s = min(nearest_s, away_s)
        parts.append(add_results(options.history, results, known))
        warm.update(known)
        driven.update(
            HistoryEntry(one.realm, one.bridge, one.entry_time) for one in results.crossings
        )
    total = summed(parts)
    of = f" of {', '.join(total.bridges)}" if total.bridges else ""
    newer = f", {len(total.replaced)} replaced" if total.replaced else ""
    before = f", {len(total.known)} there already" if total.known else ""
    beside = f", {len(warm)} with a temperature" if options.temperature is not None else ""
    if options.temperature is not None and not warm and total != AddSummary():
        beside += f": {no_match(options.temperature, nearest_s)}"
    return f"{path}: {count_of(len(total.added), 'crossing')}{of} added{newer}{before}{beside}"


def _table(options: HistoryOptions) -> int:
    from services.history.sql import overview, query

    answer = (
        overview(options.history) if options.sql is None else query(options.history, options.sql)
    )
    for problem in answer.problems:
        print(problem)
    rows = [answer.columns, *(tuple(map(str, row)) for row in answer.rows)]
    widths = [max(len(row[n]) for row in rows) for n in range(len(answer.columns))]
    for row in rows:
        line = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join(line).rstrip())
    return 0


def _show(options: HistoryOptions, bridge: str) -> int:
    from services.common.files import check_writable, write_atomically
    from services.common.progress import steps_bar
    from services.execution.blas import one_blas_thread
    from services.history.bridge_history import bridge_history
    from services.history.history_store import realm_of

    for path in (options.csv, options.json, options.rrd):
        if path is not None:
            check_writable(path)
    folder = options.history
    realm = realm_of(folder, bridge, options.realm)
    unit = options.period
    with steps_bar(f"fusing {unit}s", a_console()) as progress, one_blas_thread():
        past = bridge_history(folder, realm, bridge, unit, print, progress=progress)
    if not past.periods:
        raise InputError(f"{folder}: no crossing of {bridge} can be read")
    if options.site is not None:
        past = past._replace(baseline=_baseline(options.site, bridge))
    for line in _lines(past):
        print(line)
    if options.csv is not None:
        write_atomically(options.csv, "".join(_csv(past.periods)))
    if options.json is not None:
        write_atomically(options.json, _json(past))
    written = [path for path in (options.csv, options.json) if path is not None]
    for path in (*written, *_drawn(options, past)):
        print(path)
    if options.view or options.web:
        from services.viewer.rerun_history import view_history

        return view_history(past, web=options.web)
    return 0


def _baseline(site: Path, bridge: str) -> "StoredBaseline | None":
    """Return the baseline that a site file names for a bridge; None if it names none."""
    from schemas.site_file import load_site
    from services.history.bridge_history import StoredBaseline
    from services.viewer.baseline import named_baseline

    try:
        known = load_site(site).bridge(bridge)
    except KeyError:
        raise InputError(f"{site}: has no bridge {bridge}") from None
    estimate, name = named_baseline(known, site.parent, required=True)
    if estimate is None or name is None:
        return None
    return StoredBaseline(name, tuple(estimate.mean.tolist()))


def _drawn(options: HistoryOptions, past: "BridgeHistory") -> Iterator[Path]:
    """Draw the requested figures."""
    if options.figures is not None:
        from services.common.files import make_folder
        from services.viewer.history_figure import history_figure

        make_folder(options.figures)
        for form in ("png", "svg"):
            path = options.figures / f"{past.bridge}-history.{form}"
            history_figure(path, past)
            yield path
    if options.rrd is not None:
        from services.viewer.rerun_history import write_history

        write_history(options.rrd, past)
        yield options.rrd


def _lines(past: "BridgeHistory") -> Iterator[str]:
    from services.common.language import utc_day
    from services.history.bridge_history import statements

    bridge, realm, unit, periods, alarms = past[:5]
    number = sum(one.crossings for one in periods)
    yield (
        f"{bridge} in realm {realm}: {count_of(number, 'crossing')} in "
        f"{count_of(len(periods), unit)}; EI in GN·m², ± half of the 95 % interval"
    )
    elements = max((len(p.state.elements) for p in periods if p.state), default=0)
    names = "".join(f"{f'EI_{n + 1}':>15}" for n in range(elements))
    yield f"{unit:<10}  crossings    °C  verdict {names}"
    for one in periods:
        warm = "     " if one.temperature_deg_c is None else f"{one.temperature_deg_c:5.1f}"
        used = 0 if one.state is None else len(one.state.crossings_used)
        head = f"{utc_day(one.begin_s)}  {used:>3} of {one.crossings:<3} {warm}"
        if one.state is None or not one.state.elements:
            yield f"{head}  no crossing could be used"
            continue
        cells = "".join(
            f"{e.mean / 1e9:7.2f} ± {(e.q975 - e.q025) / 2e9:<5.2f}"
            for e in one.state.elements.values()
        )
        yield f"{head}  {one.state.verdict:<8} {cells}"
    for alarm in alarms:
        yield alarm_line(alarm)
    for statement in statements(past):
        yield statement.text
    if past.comparison is not None:
        yield ENGLISH.text("change.to_state")


def _csv(periods: "Sequence[FusedPeriod]") -> Iterator[str]:
    yield (
        "begin_time,end_time,element,mean_nm2,std_nm2,q025_nm2,q975_nm2,verdict,crossings_used,"
        "crossings,temperature_deg_c\n"
    )
    for one in periods:
        if one.state is None:
            continue
        warm = "" if one.temperature_deg_c is None else f"{one.temperature_deg_c:.2f}"
        rest = f"{one.state.verdict},{len(one.state.crossings_used)},{one.crossings},{warm}"
        for name, e in one.state.elements.items():
            values = f"{e.mean:.6g},{e.std:.6g},{e.q025:.6g},{e.q975:.6g}"
            yield f"{one.begin_s:.0f},{one.end_s:.0f},{name},{values},{rest}\n"


def _json(past: "BridgeHistory") -> str:
    bridge, realm, unit, periods, alarms, watch, comparison, _ = past
    fields = {
        "bridge": bridge,
        "realm": realm,
        "period": unit,
        "created": time.time(),
        "periods": [
            {
                "begin_time": one.begin_s,
                "end_time": one.end_s,
                "crossings": one.crossings,
                "vehicles": one.vehicles,
                "temperature_deg_c": one.temperature_deg_c,
                "state": None if one.state is None else one.state.model_dump(mode="json"),
            }
            for one in periods
        ],
        "alarms": [alarm.model_dump(mode="json") for alarm in alarms],
        "watch": {
            "state": watch.state,
            "text": watch.sentence,
            "record": None if watch.record is None else watch.record.model_dump(mode="json"),
        },
        "comparison": None
        if comparison is None
        else {
            "first_begin_time": comparison.first_s,
            "last_begin_time": comparison.last_s,
            "elements": {
                f"EI_{one.element}": {"ratio": one.ratio, "q025": one.low, "q975": one.high}
                for one in comparison.changes
            },
        },
    }
    return json.dumps(fields, indent=1) + "\n"


COMMAND: Final = Subcommand(
    HistoryOptions,
    "driveby history add drive.json --history history && "
    "driveby history bridge-1 --history history",
    _history,
)
