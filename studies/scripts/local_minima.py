"""Searches that end at a wrong bridge: how often, and how far below the true one.

    python -m studies.scripts.local_minima [--site SITE.toml] [--crossings 56]

Crossings are drawn as for a site validation. Each is identified, and fitted again from its truth,
which is unknown for real crossings: a search that ended lower in the log posterior missed that
bridge. One that ended higher found another bridge that explains the data as well, which is no
failure of a search.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from pre_core.crossing.comparison import minus_two_log_posterior
from pre_core.crossing.fit import complete_fit, fit_all
from pre_core.crossing.optimum import WITH_MISMATCH, find_optimum
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import load_site
from schemas.validation_records import VehicleBridgePair
from services.simulation.data_alone import crossing_data_only, inputs_of_seen
from services.simulation.drawn import drive
from services.simulation.trial_truth import drawn_truth
from services.simulation.validation_trial import conditions_of, single_pair_site
from studies.validation.bound import at_truth

_SITE = Path(__file__).with_name("equal_tyres.toml")
_CLEAR = 2.0
"""Difference of the log posterior from which two optima are different ones."""


class _Compared(NamedTuple):
    """Log posteriors of two optima of one crossing, less that of the truth."""

    found: float
    from_truth: float
    evaluations: int


def _compared(site: Site, seed: int) -> _Compared:
    """Identify the crossing of a seed, and fit it from its truth."""
    conditions = conditions_of(site.vehicles[0], site.bridges[0], site)
    truth, _ = drawn_truth(site, conditions, seed, seed)
    driven = drive(site, truth, seed, noise_ug_per_rthz=conditions.noise_density_ug_per_rthz)
    settings = IdentificationSettings(method="pre", threads=1)
    (seen,) = crossing_data_only([driven.run], driven.site, settings)
    found = find_optimum(inputs_of_seen(seen))
    _, y = at_truth(seen, driven)
    other, _ = fit_all(found.problem, y, WITH_MISMATCH[0])
    here = found._replace(state=found.state._replace(y=y))
    base = minus_two_log_posterior(here)
    best = np.nan if other is None else minus_two_log_posterior(complete_fit(other))
    return _Compared(
        0.5 * (base - minus_two_log_posterior(found)), 0.5 * (base - best), found.evaluations
    )


def main() -> int:
    """Print each crossing and the count."""
    parser = argparse.ArgumentParser(description="Count searches that end at a wrong bridge.")
    parser.add_argument("--site", type=Path, default=_SITE)
    parser.add_argument("--crossings", type=int, default=56)
    asked = parser.parse_args()
    known = load_site(asked.site)
    pair = VehicleBridgePair(known.vehicles[0].id, known.bridges[0].id)
    site = single_pair_site(known, pair)
    console, missed = Console(highlight=False, soft_wrap=True), 0
    for seed in range(1, asked.crossings + 1):
        one = _compared(site, seed)
        is_missed = one.from_truth > one.found + _CLEAR
        missed += is_missed
        console.print(
            f"crossing {seed}: log posterior {one.found:.1f} above the truth, from the truth "
            f"{one.from_truth:.1f}, {one.evaluations} evaluations{', MISSED' if is_missed else ''}",
        )
    console.print(
        f"{missed} of {asked.crossings} searches missed the bridge reached from the truth"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
