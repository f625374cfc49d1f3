"""Crossings of decks with another pavement: the tables of studies/pavement.md.

    python -m studies.scripts.pavement [--crossings 20] [--decks 1,2.5,0.5] [--tyres single,twin]
        [--joints MM] [--anisotropy FACTOR] [--search] [--records FILE]

Truck, bridge, sensors and conditions are those of the first crossings of the surveys "twin" and
"single-5" of `driveby validate --surveys`, with the same seeds. Each posterior is linearised at the
truth, in 1/EI, once for each noise of the mismatch on the bridge: as on the road, as estimated, and
known. With --search each crossing is identified instead. Records are appended to a file of JSON
lines and not computed again.
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from pre_core.crossing import posterior
from pre_core.crossing.compliances import to_compliance_coordinates
from pre_core.crossing.mismatch import BridgePavement
from pre_core.crossing.noise import no_suspension_noise
from pre_core.crossing.off_bridge import levels_at
from pre_core.crossing.pavement import known_pavement
from pre_core.crossing.preparation import update_noise
from pre_core.survey.plan import PosteriorAtTruth
from schemas.settings import IdentificationSettings
from services.simulation.data_alone import crossing_data_only
from services.simulation.drawn import SimulatedCrossing, drive, identify_simulated
from services.simulation.pavement import Pavement
from services.simulation.survey_kinds import KINDS
from studies.simulation.truths import default_site
from studies.validation.bound import at_truth, central_jacobian
from studies.validation.calibration import Record, record
from studies.validation.misspecification import HEADINGS, cells, completed, lines_of, read_records
from studies.validation.surveys import crossing_truth, site_of_truck

_KINDS = {"twin": "twin", "single": "single-5"}
_NOISES = ("as on the road", "estimated", "known")
_SETTINGS = IdentificationSettings(method="pre", threads=1)
_NORMAL_975 = 1.96


class Case(NamedTuple):
    """Tyres and pavement of a row of the table."""

    tyres: str
    pavement: Pavement

    @property
    def name(self) -> str:
        """Return the key of its records."""
        deck, joint, anisotropy = self.pavement
        return f"{self.tyres} deck {deck:g} joints {1e3 * joint:g} anisotropy {anisotropy:g}"


class LinearEstimate(NamedTuple):
    """Estimate of the elements, linear in 1/EI about the truth."""

    z: NDArray[np.float64]
    """Errors (elements,) of 1/EI in standard deviations."""
    std: NDArray[np.float64]
    """Relative standard deviations (elements,) of 1/EI."""


def simulated(case: Case, seed: int) -> SimulatedCrossing:
    """Simulate one crossing of a case."""
    deck, joint, anisotropy = case.pavement
    kind = KINDS[_KINDS[case.tyres]]._replace(
        deck_roughness=deck, largest_joint_m=joint, anisotropy=anisotropy
    )
    site = site_of_truck(default_site(), kind, 0)
    truth, of_noise = crossing_truth(site, kind, seed, 0, 0)
    return drive(site, truth, of_noise)


def linearised(
    at: PosteriorAtTruth, pavement: BridgePavement | None
) -> tuple[LinearEstimate, float]:
    """Return the estimate with this mismatch on the bridge, and its ratio to that of the road.

    The mismatch off the bridge is estimated in any case, that on it if it is None.
    """
    problem, y = at
    level = levels_at(problem, y)
    problem = update_noise(problem, y, no_suspension_noise(), mismatch=level, pavement=pavement)
    where = posterior.layout(problem)
    jacobian = central_jacobian(problem, y, np.arange(where.size))
    residual = posterior.all_rows(problem, y[None, :])[0]
    centre, straight = to_compliance_coordinates(problem, y, jacobian)
    covariance = np.linalg.inv(straight.T @ straight)
    error = -covariance @ (straight.T @ residual)
    std = np.sqrt(np.diag(covariance))[where.elements]
    used = problem.mismatch.pavement
    ratio = 1.0 if used is None else float(np.exp(used.ratio_and_tilt[0]))
    return LinearEstimate(error[where.elements] / std, std / centre[where.elements]), ratio


def at_the_truth(case: Case, seed: int) -> Record:
    """Simulate one crossing and linearise it at the truth with each noise."""
    drawn = simulated(case, seed)
    (seen,) = crossing_data_only([drawn.run], drawn.site, _SETTINGS)
    at = PosteriorAtTruth(*at_truth(seen, drawn))
    same = known_pavement(*at, 1.0)
    known = known_pavement(*at, case.pavement.deck_roughness)
    found = {
        name: linearised(at, pavement)
        for name, pavement in zip(_NOISES, (same, None, known), strict=True)
    }
    return {
        "effect": f"{case.name} at the truth",
        "seed": seed,
        "verdict": None,
        "ratio": found["estimated"][1],
        "linearised": {
            name: {"z": one.z.tolist(), "std": one.std.tolist()} for name, (one, _) in found.items()
        },
    }


def identified(case: Case, seed: int) -> Record:
    """Simulate, identify and judge one crossing."""
    drawn = simulated(case, seed)
    found = identify_simulated([drawn.run], drawn.site, _SETTINGS)
    seen = found[0] if len(found) == 1 else None
    return record(seed, drawn, seen, {}) | {"effect": case.name}


def _parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--crossings", type=int, default=20)
    parser.add_argument("--decks", default="1,2.5,0.5")
    parser.add_argument("--tyres", default="single,twin")
    parser.add_argument("--joints", type=float, default=0.0)
    parser.add_argument("--anisotropy", type=float, default=1.0)
    parser.add_argument("--search", action="store_true")
    parser.add_argument("--records", type=Path, default=Path("build/pavement.jsonl"))
    return parser.parse_args()


def _table_at_truth(lines: list[Record]) -> Table:
    """Return coverage, errors and widths by case and noise."""
    table = Table(
        "case", "n", "noise", "covered", "rms z", "max |z|", "std", "std/known", "ratio", box=None
    )
    for name in dict.fromkeys(line["effect"] for line in lines):
        of_case = [line for line in lines if line["effect"] == name]
        ratio = np.exp(np.mean(np.log([line["ratio"] for line in of_case])))
        known = np.array([line["linearised"]["known"]["std"] for line in of_case])
        for noise in _NOISES:
            z = np.array([line["linearised"][noise]["z"] for line in of_case])
            std = np.array([line["linearised"][noise]["std"] for line in of_case])
            table.add_row(
                name.removesuffix(" at the truth"),
                str(len(of_case)),
                noise,
                f"{100.0 * np.mean(np.abs(z) < _NORMAL_975):.1f} %",
                f"{np.sqrt(np.mean(z**2)):.2f}",
                f"{np.abs(z).max():.2f}",
                f"{100.0 * np.median(std):.1f} %",
                f"{np.median(std / known):.2f}",
                f"{ratio:.2f}" if noise == "estimated" else "",
            )
    return table


def _table_of_search(lines: list[Record]) -> Table:
    table = Table(*HEADINGS[:-1], box=None)
    for row in lines_of(lines):
        table.add_row(*cells(row)[:-1])
    return table


def main() -> int:
    """Print the table of the crossings."""
    asked = _parsed()
    asked.records.parent.mkdir(parents=True, exist_ok=True)
    ending = "" if asked.search else " at the truth"
    cases = {
        case.name + ending: case
        for tyres in asked.tyres.split(",")
        for deck in asked.decks.split(",")
        for case in [Case(tyres, Pavement(float(deck), 1e-3 * asked.joints, asked.anisotropy))]
    }
    run = identified if asked.search else at_the_truth
    lines = completed(
        asked.records,
        [(name, seed) for seed in range(asked.crossings) for name in cases],
        {(line["effect"], line["seed"]): line for line in read_records(asked.records)},
        lambda line: (line["effect"], line["seed"]),
        lambda key: partial(run, cases[key[0]], key[1]),
        1,
        lambda done, jobs: None,
    )
    Console(width=120).print(_table_of_search(lines) if asked.search else _table_at_truth(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
