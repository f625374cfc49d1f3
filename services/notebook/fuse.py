"""Fusion of the crossings of several results, as by `driveby fuse`."""

from html import escape
from pathlib import Path
from typing import NamedTuple

from schemas.results import BridgeResult, Results, load_results, results_json
from services.common.errors import InputError
from services.common.files import check_writable, write_atomically
from services.common.kinds import RESULTS
from services.execution.blas import one_blas_thread
from services.execution.fuse_results import FusedElements, crossings_to_fuse, fuse_crossings
from services.notebook.read import Name
from services.notebook.showing import RIGIDITY_HEAD, html_table, rigidity_cells
from services.notebook.solution import Identification


class Fusion(NamedTuple):
    """Fused estimates of bridges."""

    results: Results
    """Crossings with the fused estimate of each bridge, as in results.json."""
    elements_of: dict[str, FusedElements]

    @property
    def bridges(self) -> dict[str, BridgeResult]:
        """Fused estimate of each bridge, by its identifier."""
        return dict(self.results.bridges)

    def to_json(self, path: str | Path) -> None:
        """Write results.json, as `driveby fuse --json` does."""
        check_writable(Path(path), kinds=(RESULTS,))
        write_atomically(Path(path), results_json(self.results))

    def __repr__(self) -> str:
        """Return one line for each bridge."""
        return "\n".join(f"<Fusion {self._line(name)}>" for name in self.bridges)

    def _repr_html_(self) -> str:
        parts = []
        for name, state in self.bridges.items():
            nominal = self.elements_of[name].nominal_flexural_rigidity_nm2
            rows = [
                (element, *rigidity_cells(one, sound))
                for (element, one), sound in zip(state.elements.items(), nominal, strict=True)
            ]
            table = html_table(("element", *RIGIDITY_HEAD), rows)
            parts.append(f"<p>{escape(self._line(name))}</p>{table}")
        return "".join(parts)

    def _line(self, name: str) -> str:
        state = self.bridges[name]
        number = len(state.crossings_used)
        noun = "crossing" if number == 1 else "crossings"
        return f"{name}: {number} {noun} fused, {state.verdict}; {state.finding or ''}".rstrip("; ")


def fuse(
    *sources: Name | Identification | Results,
    baseline: Name | Results | None = None,
    fuse_suspect: bool = False,
) -> Fusion:
    """Fuse all crossings of results (files, or what `identify` returned), each once.

    Of a crossing in several results the newest counts. `baseline` is compared with. BLAS is limited
    to one thread meanwhile. The same results give the same numbers as `driveby fuse`. Raise
    InputError, in one line, for unreadable results, several realms, or nothing that can be fused.
    """
    if not sources:
        raise InputError("no results given, results.json or the value of identify() expected")
    name = next((str(one) for one in sources if not isinstance(one, Identification | Results)), "")
    found = crossings_to_fuse(name or "fuse", [_results(one) for one in sources])
    stored = None
    if baseline is not None:
        place = "baseline" if isinstance(baseline, Results) else str(baseline)
        stored = (place, _results(baseline))
    with one_blas_thread():
        fused = fuse_crossings(
            name or "fuse",
            found,
            stored,
            lambda bridge, stage, share: None,
            fuse_suspect=fuse_suspect,
        )
    return Fusion(fused.results, fused.bridges)


def _results(source: Name | Identification | Results) -> Results:
    if isinstance(source, Identification):
        return source.results
    return source if isinstance(source, Results) else load_results(Path(source))
