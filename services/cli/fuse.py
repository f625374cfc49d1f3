"""`driveby fuse`: one estimate of each bridge from stored results."""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from schemas.results import (
    BridgeResult,
    Crossing,
    Header,
    Results,
    load_results,
    results,
    results_json,
)
from schemas.settings import IdentificationSettings
from services.cli.bridge_table import print_bridge
from services.common.errors import InputError
from services.common.files import check_writable, write_atomically
from services.common.progress import Parts, Steps, parts_bar, steps_bar
from services.identification.bridge_state import (
    Counted,
    Fusing,
    count_in,
    state_of,
    usable,
    with_common_shares,
)
from services.recordings.recording import program_version

if TYPE_CHECKING:
    from rich.console import Console


class _Elements(NamedTuple):
    id: str
    lengths_m: tuple[float, ...]
    nominal_flexural_rigidity_nm2: tuple[float, ...]


def fuse_command(
    *,
    paths: list[Path],
    json_path: Path | None,
    baseline: Path | None,
    fuse_suspect: bool,
    console: "Console",
) -> int:
    """Fuse all crossings of the results, each once, print every bridge and write it if asked to.

    Of a crossing that several files hold the newest result counts. InputError: a file that is no
    results file, results without a crossing that could be fused, or of several realms.
    """
    if json_path is not None:
        check_writable(json_path)
    with steps_bar("reading", console) as progress:
        files = sorted(_loaded(paths, progress), key=lambda one: one.created)
    crossings = {c.crossing_id: c for one in files for c in one.crossings}
    again = sum(len(one.crossings) for one in files) - len(crossings)
    if again:
        console.print(
            f"{again} result{'s' if again > 1 else ''} of crossings that another file has too: the "
            "newest counts",
            highlight=False,
        )
    realms = sorted({crossing.realm for crossing in crossings.values()})
    if len(realms) > 1:
        raise InputError(f"{paths[0]}: crossings of {', '.join(realms)}; fuse one realm at a time")
    stored = {} if baseline is None else load_results(baseline).bridges
    fusing = Fusing(stored, fuse_suspect, IdentificationSettings().threads)
    ordered = sorted(crossings.values(), key=lambda crossing: crossing.entry_time)
    names = sorted({crossing.bridge for crossing in ordered})
    of_bridges = {name: [one for one in ordered if one.bridge == name] for name in names}
    elements_of = {name: _elements(name, of) for name, of in of_bridges.items()}
    for name, elements in elements_of.items():
        if baseline is not None and elements is not None and name in fusing.baselines:
            _check_baseline(baseline, fusing.baselines[name], elements)
    with parts_bar("fusing bridge", len(names), console) as report:
        states = {name: _state(name, of, fusing, report) for name, of in of_bridges.items()}
    found: dict[str, BridgeResult] = {}
    for name, state in states.items():
        elements = elements_of[name]
        if state is None or elements is None:
            number = len(of_bridges[name])
            console.print(f"{name}: none of {number} crossings can be fused", highlight=False)
            continue
        if found:
            console.print()
        found[name] = state
        print_bridge(console, elements, state)
    if not found:
        raise InputError(f"{paths[0]}: no crossing that could be fused; identify with method pre")
    if json_path is not None:
        last = files[-1]
        header = Header(program_version(), time.time(), last.site_hash, last.settings, last.seed)
        every = results(header, with_common_shares(ordered, found), found)
        write_atomically(json_path, results_json(every))
    return 0


def _state(
    name: str, crossings: list[Crossing], fusing: Fusing, report: Parts
) -> BridgeResult | None:
    counts = [one for one in map(usable, crossings) if one is not None]
    state = state_of(count_in(Counted(), counts), name, fusing, partial(report, name))
    report(name, "done", 1.0)
    return state


def _loaded(paths: list[Path], progress: Steps) -> Iterator[Results]:
    """The files, by their sizes as they are read."""
    sizes = [path.stat().st_size if path.is_file() else 0 for path in paths]
    for path in paths:
        if path.suffix == ".mcap":
            raise InputError(
                f"{path}: is a recording, results are expected: "
                f"driveby identify {path} --json RESULTS.json makes them"
            )
    for number, path in enumerate(paths):
        progress(sum(sizes[:number]), sum(sizes))
        yield load_results(path)


def _check_baseline(path: Path, baseline: BridgeResult, elements: _Elements) -> None:
    stored, now = len(baseline.elements), len(elements.lengths_m)
    if stored != now:
        raise InputError(
            f"{path}: {elements.id} has {stored} elements there and {now} in the results, "
            "the baseline must have the same"
        )


def _elements(name: str, crossings: list[Crossing]) -> _Elements | None:
    """The bridge as the newest crossing that can be fused knows it."""
    for crossing in reversed(crossings):
        of = crossing.fusion_likelihood
        if of is not None:
            lengths = of.element_lengths_m
            nominal = tuple(c.location for c in of.bridge[-len(lengths) :])
            return _Elements(name, lengths, nominal)
    return None
