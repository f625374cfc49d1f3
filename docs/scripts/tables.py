"""The tables of the pages that follow from code: `python docs/scripts/tables.py` writes them.

A table stands between a line `<!-- table: NAME -->` and a line `<!-- end -->`. Between
`<!-- remedies -->` and `<!-- end -->` only the last column is written: the advice of reports.
"""

import argparse
import re
import tomllib
import types
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from pre_core.parameters import (
    DERIVED_UNITS,
    ELEMENT,
    PLACEMENT_UNITS,
    SCALARS,
    TRUCK,
    ParameterSpec,
)
from schemas import fusion, results, site, site_axle_tables, site_import, site_ros2, site_sensors
from schemas.metrics import METRICS
from schemas.reasons import BRIDGE_REASON_TEXTS, LEFT_OUT_TEXTS, LeftOutReason
from schemas.topics import TOPICS, Topic
from services.cli import main as cli
from services.cli.table import COMMANDS, ListedCommand
from services.common.extras import EXTRAS
from services.common.language import ENGLISH

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
_BLOCK = re.compile(r"(<!-- (?:table: )?([a-z ]+) -->\n)(.*?)(<!-- end -->\n)", re.DOTALL)
"""Blank lines around the table, without which some readers of Markdown show none."""

SUBSCRIBER = """\
import sys
from pathlib import Path
from services.bus.messages import subscribe
from services.common.errors import FailureError, InputError

(endpoint, keys, *tls), results = sys.argv[1:], {}
try:
    for key, message in subscribe(endpoint, keys, tls=Path(tls[0]) if tls else None):
        found = getattr(message, "parameters", {})  # of an estimate; none if it was rejected
        ei = [f"{n} {p.q025:.3g} to {p.q975:.3g}" for n, p in sorted(found.items()) if "EI_" in n]
        if key.stream == "estimate":  # repeats, as after a restart, replace
            results[key.realm, message.crossing_id] = message
            ei.append(f"({len(results)} results)")
        print(key.realm, key.identifier, key.stream, *ei, flush=True)
except (FailureError, InputError) as error:
    sys.exit(str(error))
"""


def written(text: str) -> str:
    """Return a page with its tables as the code has them."""
    return _BLOCK.sub(lambda m: f"{m[1]}\n{_content(m[2], m[3].strip())}\n{m[4]}", text)


def pages() -> dict[Path, str]:
    """Return the pages with tables, as they should be."""
    found = {path: path.read_text("utf-8") for path in sorted(DOCS.glob("*.md"))}
    return {path: written(text) for path, text in found.items() if _BLOCK.search(text)}


def _content(name: str, old: str) -> str:
    return _remedies(old) if name == "remedies" else TABLES[name]()


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    columns = list(head)
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _code(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


# Commands and extras

_PAGES = {
    "alarm": "history.md#alarms",
    "catalog": "recordings.md#catalogue-of-a-fleet-driveby-catalog",
    "certs": "security.md",
    "check": "survey.md#is-everything-in-order",
    "cluster": "cluster.md",
    "export": "recordings.md#tables-and-maps-driveby-export",
    "fuse": "fusion.md",
    "gateway": "truck.md#ros-2",
    "health": "containers.md#watch",
    "history": "history.md",
    "identify": "engineer.md",
    "import": "recordings.md#tables-of-data-loggers-driveby-import",
    "info": "recordings.md",
    "logger": "logger.md",
    "recover": "logger.md#after-a-crash",
    "replay": "recordings.md#replay-a-drive-driveby-replay",
    "report": "output.md#report",
    "simulate": "survey.md#which-truck",
    "survey": "survey.md",
    "truck": "truck.md",
    "validate": "validation.md",
    "view": "output.md#viewer",
    "watch": "output.md#terminal-driveby-watch",
    "worker": "worker.md",
}
"""Where a command is explained."""


def _parsers() -> tuple[argparse.ArgumentParser, Any]:
    whole = cli.whole_parser()
    (commands,) = [a for a in whole._actions if isinstance(a, argparse._SubParsersAction)]
    return whole, commands


def _options(one: argparse.ArgumentParser) -> list[str]:
    """Return the long names of the options that the help shows."""
    shown = [a for a in one._actions if a.help != argparse.SUPPRESS and a.option_strings]
    return sorted({a.option_strings[-1] for a in shown})


def commands() -> str:
    """Return every command with its summary, its options, what it needs and its page."""
    whole, found = _parsers()
    summaries = {a.dest: a.help or "" for a in found._choices_actions}
    common = _options(whole)
    rows = []
    for name, one in found.choices.items():
        own = _code(option for option in _options(one) if option not in common)
        link = f"[{_PAGES[name].split('.')[0]}]({_PAGES[name]})" if name in _PAGES else ""
        rows.append((f"`driveby {name}`", summaries[name], own, _needed(COMMANDS[name]), link))
    every = [set(one._option_string_actions) for one in found.choices.values()]
    shared = _code(option for option in common if all(option in one for one in every))
    head = ("command", "purpose", "options", "[extras](install.md)", "page")
    return f"{_table(head, rows)}\nEvery command also takes {shared}.\n"


def _needed(needs: ListedCommand) -> str:
    always = " ".join(f"`{extra}`" for extra in needs.always)
    by_extras: dict[tuple[str, ...], list[str]] = {}
    for option, extras in needs.by_option.items():
        by_extras.setdefault(tuple(extras), []).append(f"--{option.replace('=', ' ')}")
    more = (
        f"{_code(options)}: {' '.join(f'`{e}`' for e in extras)}"
        for extras, options in by_extras.items()
    )
    return "; ".join([one for one in (always, *more) if one]) or "–"


_FOR = {
    "none": "bus, recordings, CSV import and export, credentials",
    "identify": "computation: identify, simulate, check, plan, fuse, compare",
    "view": "the Rerun viewer and its files, figures, reports",
    "history": "results over years, alarms, catalogues, Parquet; remote folders through fsspec",
    "ros2": "recordings of ROS 2 and the gateway",
    "s3": "addresses such as s3://bucket/fleet, with `history`",
    "cluster": "a Dask cluster, with `identify`",
    "notebook": "tables and datasets in [Python](python.md)",
}


def extras() -> str:
    """Return every extra with its packages."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    packages = {"none": project["dependencies"]}
    packages |= {extra: project["optional-dependencies"][extra] for extra in EXTRAS}
    rows = [
        (
            name if name == "none" else f"`{name}`",
            ", ".join(sorted({re.split(r"[^\w-]", one)[0] for one in requirements})),
            _FOR[name],
        )
        for name, requirements in packages.items()
    ]
    return _table(("extra", "packages", "for"), [*rows, ("`all`", "all of these", "")])


# Topics


def streams() -> str:
    """Return the table of topics."""
    head = ("stream", "message", "logged", "latched", "per second", "delivery", "kept", "at most")
    return _table((*head, "content"), (_stream(row) for row in TOPICS))


def _stream(row: Topic) -> tuple[str, ...]:
    rate = row.nominal_rate_hz
    per_second = "on occasion" if rate is None else f"{rate:g}" if rate >= 1 else "1 a minute"
    return (
        f"`{row.owner}/…/{row.stream}`",
        f"`{row.message}`" if row.message else "(a liveliness token)",
        "yes" if row.logged else "no",
        "yes" if row.latched else "no",
        per_second,
        row.delivery,
        f"{row.cache}" if row.message else "",
        f"{row.max_bytes // 1024} KiB" if row.message else "",
        row.description,
    )


def subscriber() -> str:
    """Return the subscriber as a block of code."""
    return f"```python\n{SUBSCRIBER}```\n"


# Site file

_SITE: tuple[tuple[str, type[BaseModel]], ...] = (
    ("[vehicle]", site.Vehicle),
    ("[[vehicle.axles]]", site_axle_tables.Axle),
    ("[[vehicle.bogies]]", site_axle_tables.Bogie),
    ("[[vehicle.sensors]]", site_sensors.PlacedSensor),
    ("[bridge]", site.Bridge),
    ("[sensor]", site.Sensor),
    ("[receiver]", site.Receiver),
    ("[[ros2]]", site_ros2.Ros2),
    ("[ros2.imu] CHANNEL", site_ros2.RosImu),
    ("[import]", site_import.Import),
)


def site_keys() -> str:
    """Return every key of a site file, by table, with its default."""
    rows = []
    for name, model in _SITE:
        fields = {(f.alias or key): f for key, f in model.model_fields.items()}
        needed = [key for key, f in fields.items() if f.is_required()]
        optional = [f"`{key}`{_default(f)}" for key, f in fields.items() if key not in needed]
        rows.append((f"`{name}`", _code(needed) or "–", ", ".join(optional) or "–"))
    return _table(("table", "required", "optional (default)"), rows)


def _default(field: FieldInfo) -> str:
    value = field.default
    if isinstance(value, tuple):
        value = value[0] if value and len(set(value)) == 1 else None
    if isinstance(value, bool):
        return f" ({str(value).lower()})"
    if isinstance(value, int | float):
        return f" ({value:g})"
    return f" ({value})" if isinstance(value, str) else ""


# Results

_RESULTS: tuple[tuple[str, type[BaseModel]], ...] = (
    ("a file", results.Results),
    ("`crossings`", results.CrossingResult),
    ("a parameter or derived quantity, in its `unit`", results.Parameter),
    ("`prior`", results.Prior),
    ("`covariance`", results.Covariance),
    ("`derived`", results.Derived),
    ("`road`", results.RoadResult),
    ("`mismatch`", results.RoadMismatch),
    ("`fusion_likelihood`", fusion.FusionLikelihood),
    ("`footprints`: contact patches", fusion.AxleFootprint),
    ("`bridges`", results.BridgeResult),
    ("`EI_1` … (N·m²), `level`, `thirds` (relative to nominal) of a bridge", results.ElementState),
    ("`tracks`", results.Track),
    ("`crossings_left_out`", results.LeftOut),
)
_UNITS = (
    ("_m_per_km", "m/km"),
    ("_m_per_s", "m/s"),
    ("_per_m", "1/m"),
    ("_m3", "m³"),
    ("_hz", "Hz"),
    ("_time", "s"),
    ("created", "s"),
    ("_m", "m"),
)


def result_fields() -> str:
    """Return every field of a results file, with its unit and whether it may be null."""
    rows = []
    for name, model in _RESULTS:
        fields = [
            f"`{key}`{_unit(key)}{'?' if _may_be_null(f) else ''}"
            for key, f in model.model_fields.items()
        ]
        rows.append((name, ", ".join(fields)))
    return _table(("object", "fields (unit); ? may be null"), rows)


def _unit(name: str) -> str:
    return next((f" ({unit})" for end, unit in _UNITS if name.endswith(end)), "")


def _may_be_null(field: FieldInfo) -> bool:
    kinds = (Union, types.UnionType)
    return get_origin(field.annotation) in kinds and type(None) in get_args(field.annotation)


def parameters() -> str:
    """Return every estimated parameter with its unit and its key in the site file."""
    rows = [(f"`{p.name}`", p.unit, f"{_site_key(p)}{_which(p)}") for p in SCALARS]
    rows.append((f"`{ELEMENT.name}_1` …", ELEMENT.unit, f"`{ELEMENT.key}`"))
    rows += [(f"`{name}`", unit, "derived") for name, unit in DERIVED_UNITS.items()]
    rows += [(f"`{name}`", unit, _PLACEMENT[name]) for name, unit in PLACEMENT_UNITS.items()]
    return _table(("name", "unit", "quantity"), rows)


_PLACEMENT = {
    "wheelbase_m": "`wheelbase_m`; of a tandem, distance of its axles",
    "position_offset_m": "slow error of the receiver",
}
_NOT_IN_SITE_FILE = {
    "support_rotational_stiffness_nm_per_rad": "rotational restraint",
    "support_compliance_m_per_n": "bearing compliance",
    "torsional_flexibility_per_n": "e²/(GJ)",
}
"""Quantities, by their key, of which a site file has only the spread."""


def _site_key(row: ParameterSpec) -> str:
    """Return where the site file has the quantity of a parameter, or its name."""
    if row.key in _NOT_IN_SITE_FILE:
        return _NOT_IN_SITE_FILE[row.key]
    return "`[[vehicle.bogies]]` `shares`" if row.key == "tandem_share" else f"`{row.key}`"


def _which(row: ParameterSpec) -> str:
    """Return which of a pair of quantities a parameter is; empty if there is one only."""
    if sum(one.key == row.key for one in SCALARS) == 1:
        return ""
    return f", {(('front', 'rear') if row.part == TRUCK else ('start', 'end'))[row.pair_index]}"


# Reasons


def bridge_reasons() -> str:
    """Return the reasons of fused states, and of excluded crossings."""
    rows = [(f"`{code}`", text) for code, text in BRIDGE_REASON_TEXTS.items()]
    whole = {
        LeftOutReason.SUSPECT: "Its verdict is suspect.",
        LeftOutReason.NOT_FUSED: "This method's results are not fused.",
    }
    rows += [
        (f"`{code}` (excluded)", whole.get(LeftOutReason(code), f"It {text}."))
        for code, text in LEFT_OUT_TEXTS.items()
    ]
    return _table(("reason", "meaning"), rows)


def _remedies(old: str) -> str:
    def row(found: re.Match[str]) -> str:
        advice = ENGLISH.advice[found[1]]
        paper = ENGLISH.remedy(found[1], "least_squares")
        if paper != advice:
            advice += f" With the paper's methods, {paper[0].lower()}{paper[1:]}"
        return f"| `{found[1]}` | {found[2]} | {advice} |\n"

    pattern = r"^\| `(\w+)` \| (.+) \|(?: [^|\n]*)\|\n"
    return re.sub(pattern, row, f"{old}\n", flags=re.MULTILINE)


def metrics() -> str:
    """Return every metric for Prometheus."""
    rows = (
        (f"`{one.name}`", one.kind, one.text, f"`{one.label}`" if one.label else "")
        for one in METRICS
    )
    return _table(("metric", "kind", "meaning", "label"), rows)


TABLES: dict[str, Callable[[], str]] = {
    "bridge reasons": bridge_reasons,
    "commands": commands,
    "extras": extras,
    "metrics": metrics,
    "parameters": parameters,
    "result fields": result_fields,
    "site keys": site_keys,
    "streams": streams,
    "subscriber": subscriber,
}


def main() -> None:
    """Write the tables of all pages."""
    for path, text in pages().items():
        path.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
