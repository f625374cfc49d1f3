"""Results of an identification: one shape for every method, as arrays and as tables.

pandas and xarray are needed only by the functions that return their types.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from schemas.reasons import Reason
from schemas.results import CrossingResult, Parameter, Results, Verdict, results_json
from schemas.site import Bridge, Site
from services.common.errors import InputError
from services.common.extras import check_installed
from services.common.field_docs import with_field_docs
from services.common.files import check_writable, write_atomically
from services.common.kinds import RESULTS
from services.history.draws import (
    Draws,
    DrawsOfCrossing,
    check_draws_file,
    posterior,
    write_draws,
)
from services.notebook.arguments import file_of, wrong
from services.notebook.inference import groups_beside, origin_of, prior_of
from services.notebook.showing import MAX_SHOWN, all_as_html, as_html, counted, one_line

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_STATISTICS = ("mean", "std", "q025", "q50", "q975")
_SPREAD = ("std", "q025", "q975")
WITH_DRAWS = "method pre has, with identify(..., draws=True), of crossings that are not rejected"
"""The origin of draws, for errors where there are none."""


@with_field_docs
class Solution(NamedTuple):
    """Result of one crossing, by whichever method."""

    crossing: CrossingResult
    """Complete result, with the fields of results.json (docs/contract.md)."""
    bridge: Bridge
    """Bridge of the site file: lengths and nominal values."""
    draws: Draws
    """Draws of each parameter, arrays (chain, draw).

    They are empty for a rejected crossing, without `draws=True`, and for methods without draws
    (`least_squares`, `random_walk`).
    """
    site: Site | None = None
    """Site file by which it was identified."""

    def __repr__(self) -> str:
        """Return one line."""
        return f"<Solution {one_line(self.crossing, self.bridge)}>"

    def _repr_html_(self) -> str:
        return as_html(self.crossing, self.bridge)

    @property
    def value(self) -> dict[str, Parameter]:
        """Estimate of each parameter, by name; empty for a rejected crossing."""
        return dict(self.crossing.parameters or {})

    @property
    def verdict(self) -> Verdict:
        """Verdict: `good`, `suspect` or `rejected`."""
        return self.crossing.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Reasons why the verdict is not `good`; `crossing.reason_texts` are sentences."""
        return self.crossing.reasons

    @property
    def stats(self) -> dict[str, float]:
        """Statistics of the search: evaluations, convergence, seconds."""
        return dict(self.crossing.diagnostics)

    def elements(self) -> "pd.DataFrame":
        """Return one row for each element of the bridge; see `Identification.elements`."""
        return _elements_of([self])

    def parameters(self) -> "pd.DataFrame":
        """Return one row for each parameter; see `Identification.parameters`."""
        return _parameters_of([self])

    def posterior(self) -> "xr.Dataset":
        """Return the draws as arrays (chain, draw); raise InputError without draws."""
        check_installed("a dataset of draws", "xarray")
        return posterior([_draws_of(one) for one in _with_draws([self])]).isel(crossing=0)


@with_field_docs
class Identification(NamedTuple):
    """Results of all crossings, in order of time."""

    solutions: tuple[Solution, ...]
    """Result of each crossing, rejected ones included."""
    results: Results
    """Results with the fused estimate of each bridge, as in results.json."""
    site: Site
    """Site file by which the crossings were identified."""

    def __repr__(self) -> str:
        """Return one line for each crossing, at most twenty."""
        lines = [f"<Identification {counted(self.results.crossings)}>"]
        lines += map(repr, self.solutions[:MAX_SHOWN])
        if len(self.solutions) > MAX_SHOWN:
            lines.append(f"… {len(self.solutions) - MAX_SHOWN} more")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return all_as_html([(one.crossing, one.bridge) for one in self.solutions])

    def elements(self) -> "pd.DataFrame":
        """Return one row for each element of each crossing; needs pandas.

        Columns: crossing, bridge, vehicle, method, verdict, element; from_m and to_m; mean, std,
        q025, q50 and q975 of EI in N·m²; nominal in N·m²; ratio (mean over nominal). Numbers are
        NaN for a rejected crossing, and std, q025 and q975 where the method has no noise model, so
        that an interval would be meaningless.
        """
        return _elements_of(self.solutions)

    def parameters(self) -> "pd.DataFrame":
        """Return one row for each parameter of each crossing, in the units of its column `unit`."""
        return _parameters_of(self.solutions)

    def posterior(self) -> "xr.Dataset":
        """Return the draws as arrays (chain, draw, crossing); needs xarray.

        Crossings without draws are omitted; without any draws InputError is raised. Longer chains
        are thinned to the shortest. For ArviZ:
        `arviz.InferenceData(posterior=found.posterior())`.
        """
        check_installed("a dataset of draws", "xarray")
        return posterior(_draws_of(solution) for solution in _with_draws(self.solutions))

    def prior(self) -> "xr.Dataset":
        """Return draws of the priors, named as the posterior's; needs xarray.

        Restraint, compliance and, without a declared lane, torsion are zero with a probability of
        one half (`probability_zero`), in these draws, too.
        """
        return prior_of([solution.crossing for solution in self.solutions if solution.draws])

    def to_netcdf(self, path: str | Path) -> None:
        """Write the draws, as `driveby identify --draws` does; `arviz.from_netcdf` reads `.nc`.

        A `.nc` also holds the groups `prior` and `sample_stats`; arrays have `units`, and groups
        the versions of program and method, the seed, the settings and the site's hash.

        Raise InputError without draws, or if xarray and h5netcdf are not installed and the file is
        no `.npz`.
        """
        file = file_of(path)
        check_draws_file(file)
        some = _with_draws(self.solutions, f"{file}: ")
        groups = groups_beside(file, [solution.crossing for solution in some])
        draws = (_draws_of(solution) for solution in some)
        write_draws(file, draws, groups, origin_of(self.results))

    def to_json(self, path: str | Path) -> None:
        """Write results.json, as `driveby identify --json` does."""
        file = file_of(path)
        check_writable(file, kinds=(RESULTS,))
        write_atomically(file, results_json(self.results))


def one_solution(name: str, found: object, function: str) -> Solution:
    """Return the only crossing of an argument of a function; InputError for anything else."""
    if isinstance(found, Identification):
        if len(found.solutions) != 1:
            raise InputError(
                f"{function} draws one crossing, these are {len(found.solutions)}: "
                f"{function}(found.solutions[0]), …"
            )
        return found.solutions[0]
    if not isinstance(found, Solution):
        raise wrong(name, found, "what identify() returns or one of its solutions")
    return found


def _with_draws(solutions: Sequence[Solution], place: str = "") -> list[Solution]:
    """Return the solutions with draws; raise InputError if there are none."""
    some = [solution for solution in solutions if solution.draws]
    if not some:
        raise InputError(f"{place}no crossing has draws; {WITH_DRAWS}")
    return some


def _draws_of(solution: Solution) -> DrawsOfCrossing:
    crossing = solution.crossing
    return DrawsOfCrossing(crossing.crossing_id, crossing.vehicle, crossing.bridge, solution.draws)


def _elements_of(solutions: "list[Solution] | tuple[Solution, ...]") -> "pd.DataFrame":
    check_installed("a table of elements", "pandas")
    import pandas as pd

    rows: list[dict[str, object]] = []
    for solution in solutions:
        bridge, identity_of = solution.bridge, _identity_columns(solution)
        nominal = bridge.nominal_flexural_rigidity_nm2
        statistics = partial(_element_statistics, solution)
        of_elements = element_rows(bridge.lengths_m, nominal, statistics)
        rows += [identity_of | row for row in of_elements]
    identity = ("crossing", "bridge", "vehicle", "method", "verdict")
    columns = [*identity, "element", "from_m", "to_m", *_STATISTICS, "nominal", "ratio"]
    return pd.DataFrame(rows, columns=columns)


def element_rows(
    lengths_m: Sequence[float],
    nominal_nm2: Sequence[float],
    statistics: Callable[[str], dict[str, float]],
) -> Iterator[dict[str, object]]:
    """Yield the columns of each element: place, `statistics` of its name, nominal value, ratio."""
    start_m = 0.0
    for number, (length_m, nominal) in enumerate(zip(lengths_m, nominal_nm2, strict=True), start=1):
        name, stop_m = f"EI_{number}", start_m + length_m
        found = statistics(name)
        place: dict[str, object] = {"element": name, "from_m": start_m, "to_m": stop_m}
        yield place | found | {"nominal": nominal, "ratio": found["mean"] / nominal}
        start_m = stop_m


def _parameters_of(solutions: "list[Solution] | tuple[Solution, ...]") -> "pd.DataFrame":
    check_installed("a table of unknowns", "pandas")
    import pandas as pd

    rows = [
        _identity_columns(solution)
        | {"name": name, "unit": value.unit}
        | _statistics(solution, value)
        for solution in solutions
        for name, value in solution.value.items()
    ]
    identity = ("crossing", "bridge", "vehicle", "method", "verdict")
    return pd.DataFrame(rows, columns=[*identity, "name", "unit", *_STATISTICS])


def _identity_columns(solution: Solution) -> dict[str, object]:
    crossing = solution.crossing
    return {
        "crossing": crossing.crossing_id,
        "bridge": crossing.bridge,
        "vehicle": crossing.vehicle,
        "method": crossing.method,
        "verdict": crossing.verdict,
    }


def _element_statistics(solution: Solution, name: str) -> dict[str, float]:
    return _statistics(solution, solution.value.get(name))


def _statistics(solution: Solution, value: Parameter | None) -> dict[str, float]:
    if value is None:
        return dict.fromkeys(_STATISTICS, float("nan"))
    found = {name: float(getattr(value, name)) for name in _STATISTICS}
    if Reason.NO_NOISE_MODEL in solution.reasons:
        found |= dict.fromkeys(_SPREAD, float("nan"))
    return found
