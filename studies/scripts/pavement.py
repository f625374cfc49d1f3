"""Crossings of decks with another pavement: the tables of studies/pavement.md.

    python -m studies.scripts.pavement [--crossings 20] [--decks 1,2.5,0.5] [--tyres single,twin]
        [--joints MM] [--anisotropy FACTOR] [--records FILE]

Truck, bridge, sensors and conditions are those of the first crossings of the surveys "twin" and
"single-5" of `driveby validate --surveys`, with the same seeds. Records are appended to a file of
JSON lines and not computed again.
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from schemas.settings import IdentificationSettings
from services.simulation.drawn import default_site, drive, identify_simulated
from services.simulation.pavement import Pavement
from services.simulation.survey_kinds import KINDS
from studies.validation.calibration import Record, record
from studies.validation.surveys import crossing_truth, site_of_truck
from studies.validation.worlds import HEADINGS, cells, completed, lines_of, read_records

_KINDS = {"twin": "twin", "single": "single-5"}


class Case(NamedTuple):
    """Tyres and pavement of a row of the table."""

    tyres: str
    pavement: Pavement

    @property
    def name(self) -> str:
        """Return the key of its records."""
        deck, joint, anisotropy = self.pavement
        return f"{self.tyres} deck {deck:g} joints {1e3 * joint:g} anisotropy {anisotropy:g}"


def one_crossing(case: Case, seed: int) -> Record:
    """Simulate, identify and judge one crossing."""
    deck, joint, anisotropy = case.pavement
    kind = KINDS[_KINDS[case.tyres]]._replace(
        deck_roughness=deck, largest_joint_m=joint, anisotropy=anisotropy
    )
    site = site_of_truck(default_site(), kind, 0)
    truth, of_noise = crossing_truth(site, kind, seed, 0, 0)
    drawn = drive(site, truth, of_noise)
    found = identify_simulated(
        [drawn.run], drawn.site, IdentificationSettings(method="pre", threads=1)
    )
    seen = found[0] if len(found) == 1 else None
    return record(seed, drawn, seen, {}) | {"effect": case.name}


def _parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--crossings", type=int, default=20)
    parser.add_argument("--decks", default="1,2.5,0.5")
    parser.add_argument("--tyres", default="single,twin")
    parser.add_argument("--joints", type=float, default=0.0)
    parser.add_argument("--anisotropy", type=float, default=1.0)
    parser.add_argument("--records", type=Path, default=Path("build/pavement.jsonl"))
    return parser.parse_args()


def main() -> int:
    """Print the table of the crossings."""
    asked = _parsed()
    console = Console(width=100)
    asked.records.parent.mkdir(parents=True, exist_ok=True)
    cases = {
        case.name: case
        for tyres in asked.tyres.split(",")
        for deck in asked.decks.split(",")
        for case in [Case(tyres, Pavement(float(deck), 1e-3 * asked.joints, asked.anisotropy))]
    }
    wanted = [(name, seed) for seed in range(asked.crossings) for name in cases]
    known = {(line["effect"], line["seed"]): line for line in read_records(asked.records)}
    lines = completed(
        asked.records,
        wanted,
        known,
        lambda line: (line["effect"], line["seed"]),
        lambda key: partial(one_crossing, cases[key[0]], key[1]),
        1,
        lambda done, jobs: None,
    )
    table = Table(*HEADINGS[:-1], "evaluations", box=None)
    for row in lines_of(lines):
        of_row = [line for line in lines if line["effect"] == row.effect]
        used = [line["diagnostics"].get("evaluations") for line in of_row if line["estimates"]]
        known_used = [value for value in used if value is not None]
        median = f"{np.median(known_used):.0f}" if known_used else "–"
        table.add_row(*cells(row)[:-1], median)
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
