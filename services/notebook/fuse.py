"""Fusion of the crossings of several results, as by `driveby fuse`."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from schemas.results import BridgeResult, CrossingResult, Results, load_results, results_json
from schemas.site import Site
from services.common.errors import InputError
from services.common.extras import check_installed
from services.common.field_docs import with_field_docs
from services.common.files import check_writable, write_atomically
from services.common.kinds import RESULTS
from services.execution.blas import one_blas_thread
from services.execution.fuse_results import FusedElements, crossings_to_fuse, fuse_crossings
from services.identification.baseline_cautions import baseline_cautions
from services.ledger.baselines import realms_of_bridges
from services.notebook.arguments import file_of, known_arguments, path_of
from services.notebook.read import Name, given_site
from services.notebook.showing import RIGIDITY_HEAD, html_table, rigidity_cells
from services.notebook.solution import Identification, element_rows

if TYPE_CHECKING:
    import pandas as pd

_STATISTICS: Final = ("mean", "std", "q025", "q975")
_COLUMNS: Final = [
    *("bridge", "verdict", "crossings", "element", "from_m", "to_m"),
    *(*_STATISTICS, "nominal", "ratio"),
]
RESULTS_EXPECTED: Final = (
    "the name of a results file, or what identify() or fuse() returns; "
    "several are several arguments"
)


@with_field_docs
class Fusion(NamedTuple):
    """Fused estimates of bridges."""

    results: Results
    """Crossings with the fused estimate of each bridge, as in results.json."""
    elements_of: dict[str, FusedElements]
    """Elements of each bridge and their nominal values, by its identifier."""
    site: Site | None = None
    """Site file, for figures and reports; None where only results files were given."""
    baseline: Results | None = None
    """Results compared with; None without a baseline."""

    @property
    def bridges(self) -> dict[str, BridgeResult]:
        """Fused estimate of each bridge, by its identifier."""
        return dict(self.results.bridges)

    def elements(self) -> "pd.DataFrame":
        """Return one row for each element of each bridge; needs pandas.

        Columns: bridge, verdict, crossings (number of fused ones), element; from_m and to_m; mean,
        std, q025 and q975 of EI in N·m²; nominal in N·m²; ratio (mean over nominal). Numbers are
        NaN for a bridge without an estimate.
        """
        check_installed("a table of elements", "pandas")
        import pandas as pd

        rows = [row for name in self.bridges for row in self._element_rows(name)]
        return pd.DataFrame(rows, columns=_COLUMNS)

    def _element_rows(self, name: str) -> Iterator[dict[str, object]]:
        state, of = self.bridges[name], self.elements_of[name]
        used = len(state.crossings_used)
        identity: dict[str, object] = {"bridge": name, "verdict": state.verdict, "crossings": used}

        def statistics(element: str) -> dict[str, float]:
            one = state.elements.get(element)
            return {key: float(getattr(one, key, np.nan)) for key in _STATISTICS}

        for row in element_rows(of.lengths_m, of.nominal_flexural_rigidity_nm2, statistics):
            yield identity | row

    def site_with(self, bridges: Iterable[str]) -> Site:
        """Return the site file; raise InputError without one that has all these bridges."""
        known = () if self.site is None else tuple(bridge.id for bridge in self.site.bridges)
        for bridge in bridges:
            if self.site is None or bridge not in known:
                raise InputError(
                    f'{bridge}: has no site file, fuse(..., site="site.toml") gives one'
                )
        assert self.site is not None  # noqa: S101 - every fusion has a bridge
        return self.site

    def to_json(self, path: str | Path) -> None:
        """Write results.json, as `driveby fuse --json` does."""
        file = file_of(path)
        check_writable(file, kinds=(RESULTS,))
        write_atomically(file, results_json(self.results))

    def __repr__(self) -> str:
        """Return one line for each bridge."""
        return "\n".join(f"<Fusion {self._line(name)}>" for name in self.bridges)

    def _repr_html_(self) -> str:
        parts = []
        for name, state in self.bridges.items():
            nominal = self.elements_of[name].nominal_flexural_rigidity_nm2
            rows = [
                (element, *rigidity_cells(one, nominal_ei))
                for (element, one), nominal_ei in zip(state.elements.items(), nominal, strict=True)
            ]
            table = html_table(("element", *RIGIDITY_HEAD), rows)
            parts.append(f"<p>{escape(self._line(name))}</p>{table}")
        return "".join(parts)

    def _line(self, name: str) -> str:
        state = self.bridges[name]
        number = len(state.crossings_used)
        noun = "crossing" if number == 1 else "crossings"
        return f"{name}: {number} {noun} fused, {state.verdict}; {state.finding or ''}".rstrip("; ")


Source = Name | Identification | Fusion | Results


@known_arguments()
def fuse(
    *sources: Source | Sequence[Source],
    baseline: Source | None = None,
    fuse_suspect: bool = False,
    site: Name | Site | None = None,
) -> Fusion:
    """Fuse all crossings of results (files, or what `identify` returned), each once.

    Several are several arguments, or lists of them.
    `baseline` is compared with. `site` is needed for a figure or report of files alone. BLAS is
    limited to one thread meanwhile. The same results give the same numbers as `driveby fuse`.

    Raise InputError, in one line, for unreadable results, several realms, crossings that differ and
    have one identifier, or nothing that can be fused.
    """
    given = list(_each_of(sources))
    if not given:
        raise InputError("no results given, results.json or the value of identify() expected")
    name = next((str(one) for one in given if isinstance(one, str | PathLike)), "fuse")
    each = [_results("source", one) for one in given]
    check_identifiers(each)
    found = crossings_to_fuse(name, each)
    stored = None if baseline is None else _results("baseline", baseline)
    place = str(baseline) if isinstance(baseline, str | PathLike) else "baseline"
    with one_blas_thread():
        fused = fuse_crossings(
            name,
            found,
            None if stored is None else (place, stored.bridges),
            lambda bridge, stage, share: None,
            fuse_suspect=fuse_suspect,
        )
    if stored is not None:
        now, then = (realms_of_bridges(one.crossings) for one in (found, stored))
        for line in baseline_cautions(fused.results.bridges, stored.bridges, now, then):
            warnings.warn(line, stacklevel=3)
    known = _newest_site(given) if site is None else given_site(site)
    return Fusion(fused.results, fused.bridges, known, stored)


def _each_of(sources: Iterable[object]) -> Iterator[object]:
    """Yield sources and those of lists; results are named tuples, and no lists of others."""
    for one in sources:
        if isinstance(one, list) or type(one) is tuple:
            yield from one
        else:
            yield one


def _results(name: str, source: object) -> Results:
    """Return results given as an argument of this name; raise InputError for anything else."""
    if isinstance(source, Identification | Fusion):
        return source.results
    if isinstance(source, Results):
        return source
    return load_results(path_of(name, source, RESULTS_EXPECTED))


def check_identifiers(files: Sequence[Results]) -> None:
    """Raise InputError if crossings of one identifier have different estimates."""
    known: dict[str, CrossingResult] = {}
    for one in (crossing for results in files for crossing in results.crossings):
        first = known.setdefault(one.crossing_id, one)
        if first.parameters != one.parameters:
            raise InputError(
                f"{one.crossing_id}: two crossings with this identifier differ; of one crossing "
                "give one result, and start each simulated one at another time: "
                'simulation.started_at("2026-05-01T09:30:00Z")'
            )


def _newest_site(sources: Sequence[object]) -> Site | None:
    """Return the site of the newest results that have one."""
    with_site = [
        (one.results.created, one.site)
        for one in sources
        if isinstance(one, Identification | Fusion) and one.site is not None
    ]
    return max(with_site, key=lambda one: one[0])[1] if with_site else None
