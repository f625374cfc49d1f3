"""Errors of single crossings, linearised at the truth, in units of their standard deviations.

    python -m studies.scripts.linearised_errors --kind three-elements [--crossings 100]

Each crossing is the first of a simulated survey, with a truck, bridge and road of its own. The
residuals r and their Jacobian J are taken at the true values, with the centre of each prior drawn
about the truth: one Gauss-Newton step -(J'J)^-1 J'r is then the error of a linear estimate, whose
covariance is (J'J)^-1 if the likelihood is right. So the error of each parameter, in standard
deviations, has mean zero and root mean square one, whatever truths were drawn. Neither the search
nor the shape of the posterior matters.
"""

import argparse
import sys
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from pre_core import parameters
from pre_core.constants import NORMAL_975
from pre_core.crossing.posterior import all_rows, layout
from pre_core.search.levenberg_marquardt import initial_state
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.common.arrays import Floats
from services.simulation.data_alone import crossing_data_only
from services.simulation.drawn import drive
from services.simulation.survey_kinds import KINDS, SurveyKind
from studies.simulation.truths import default_site
from studies.validation.bound import at_truth
from studies.validation.surveys import crossing_truth, site_of_truck


class _Errors(NamedTuple):
    """Errors (p,) of a crossing's parameters in standard deviations, and these in the prior's."""

    names: tuple[str, ...]
    z: Floats
    std: Floats


def _errors(site: Site, kind: SurveyKind, survey: int) -> _Errors:
    """Return the linearised errors of the first crossing of a survey."""
    truth, seed = crossing_truth(site, kind, survey, 0, 0)
    driven = drive(site, truth, seed)
    settings = IdentificationSettings(method="pre", threads=1)
    (seen,) = crossing_data_only([driven.run], driven.site, settings)
    problem, y = at_truth(seen, driven)
    state = initial_state(lambda points: all_rows(problem, points), y)
    residual = state.residual.copy()
    # The priors' rows come last and contain y itself; nuisances after truck and bridge are fitted.
    where = layout(problem)
    first, known = residual.size - where.trajectory.start, where.gains.start
    rng = np.random.default_rng(np.random.SeedSequence([survey, 0x5C0]))
    residual[first : first + known] += rng.standard_normal(known) - y[:known]
    covariance = np.linalg.inv(state.jacobian.T @ state.jacobian)
    std = np.sqrt(np.diag(covariance))
    kept = np.flatnonzero(problem.priors.estimated)
    names = parameters.names(site.bridges[0].elements)
    z = -covariance @ (state.jacobian.T @ residual) / std
    return _Errors(tuple(names[k] for k in kept), z[: kept.size], std[: kept.size])


def main() -> int:
    """Print mean, root mean square and coverage of each parameter's errors."""
    parser = argparse.ArgumentParser(description="Check the widths of likelihoods at the truth.")
    kinds = sorted(name for name, kind in KINDS.items() if not kind.has_tandem)
    parser.add_argument("--kind", choices=kinds, default="twin")
    parser.add_argument("--crossings", type=int, default=100)
    asked = parser.parse_args()
    kind, found = KINDS[asked.kind], []
    site = site_of_truck(default_site(), kind, 0)
    console = Console(highlight=False, soft_wrap=True)
    with console.status("simulating") as status:
        for survey in range(asked.crossings):
            found.append(_errors(site, kind, survey))
            status.update(f"{survey + 1} of {asked.crossings} crossings")
    z, std = (np.array([getattr(one, name) for one in found]) for name in ("z", "std"))
    table = Table("parameter", "mean z", "rms z", "largest", "covered", "std / prior")
    inside = (np.abs(z) < NORMAL_975).mean(axis=0)
    for k, name in enumerate(found[0].names):
        table.add_row(
            name,
            f"{z[:, k].mean():.2f}",
            f"{np.sqrt((z[:, k] ** 2).mean()):.2f}",
            f"{np.abs(z[:, k]).max():.1f}",
            f"{100.0 * inside[k]:.0f} %",
            f"{np.median(std[:, k]):.2f}",
        )
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
