"""Weighted draws and chains on the same crossings, side by side.

    python -m tests.verdicts.both_ways --worlds 8 --records build/both_ways.jsonl

Crossings drawn from the priors, and of each effect that `driveby validate --method pre` has, but
those on roads that differ: there draws come neither by weights nor by chains. Each is identified as
always, and with the weights refused, so that chains follow. Records are appended to the file as
they come, and what is in it is not run again.
"""

import argparse
import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pre_core.crossing import sampling
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.common.files import make_folder
from services.simulation.drawn import default_site
from services.simulation.worlds import EFFECTS, ON_SURFACES
from services.validation.calibration import Record, one_crossing
from services.validation.worlds import (
    HEADINGS,
    cells,
    completed,
    identity_of,
    lines_of,
    one_world,
    read_records,
)

DRAWN = "drawn"
WAYS = ("weights", "chains")


def main() -> int:
    options = _options()
    site = default_site()
    settings = IdentificationSettings(method="pre", threads=1)
    identity = identity_of(site, settings)
    effects = [effect for effect in EFFECTS if effect not in ON_SURFACES]
    wanted = [(DRAWN, seed) for seed in range(options.crossings)]
    wanted += [(effect, seed) for seed in range(options.worlds) for effect in effects]
    make_folder(options.records.parent)
    known = {
        _key(line): line
        for line in read_records(options.records)
        if line.get("identity") == identity
    }
    records = completed(
        options.records,
        [(*which, way) for which in wanted for way in WAYS],
        known,
        _key,
        lambda key: partial(one, site, *key, settings),
        options.processes,
        lambda done, jobs: print(f"\r{done} of {jobs}", end="", file=sys.stderr, flush=True),
    )
    print(file=sys.stderr)
    print(told(records))
    return 0


def _options() -> argparse.Namespace:
    p = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    p.add_argument("--crossings", type=int, default=200)
    p.add_argument("--worlds", type=int, default=20, help="of each effect")
    p.add_argument("--records", type=Path, required=True)
    p.add_argument("--processes", type=int, default=2)
    return p.parse_args()


def _key(line: Record) -> tuple[str, int, str]:
    return line["effect"], line["seed"], line["way"]


def one(site: Site, effect: str, seed: int, way: str, settings: IdentificationSettings) -> Record:
    """The record of a crossing, its draws by `way`."""
    kept = sampling._weighted
    if way == "chains":
        sampling._weighted = lambda target, mixed, draws, report: (None, mixed, 0)
    try:
        if effect == DRAWN:
            line = one_crossing(site, seed, settings)
            line |= {"effect": effect, "identity": identity_of(site, settings)}
        else:
            line = one_world(site, effect, seed, settings)
    finally:
        sampling._weighted = kept
    return line | {"way": way}


def told(records: list[Record]) -> str:
    """A table: what both say of each effect, and how far they are apart crossing by crossing."""
    of = {_key(line): line for line in records}
    rows = [(*HEADINGS[:1], "way", *HEADINGS[1:-1], "evaluations"), ("---",) * (len(HEADINGS) + 1)]
    for effect in dict.fromkeys(line["effect"] for line in records):
        for way in WAYS:
            some = [line for line in records if (line["effect"], line["way"]) == (effect, way)]
            (line,) = lines_of(some)
            rows.append((effect, way, *cells(line)[1:-1], str(_evaluations(some))))
    text = ["| " + " | ".join(row) + " |" for row in rows]
    pairs = [(of[effect, seed, WAYS[0]], of[effect, seed, WAYS[1]]) for effect, seed, _ in of]
    both = [(a, b) for a, b in pairs if a["estimates"] and b["estimates"]]
    weighted = [(a, b) for a, b in both if "pareto_k" in a["diagnostics"]]
    apart, ratio = _differences(weighted)
    ess = [pair[0]["diagnostics"]["ess"] for pair in weighted]
    verdicts = sum(a["verdict"] != b["verdict"] for a, b in pairs) // 2
    fell_back = (len(both) - len(weighted)) // 2
    spread = float(np.sqrt(np.mean(apart**2)))
    low, middle, high = np.quantile(ratio, [0.0, 0.5, 1.0])
    return "\n".join(
        [
            *text,
            "",
            f"{len(both) // 2} crossings with an answer, {fell_back} fell back on chains.",
            f"Weights are worth {np.median(ess):.0f} draws (median), {min(ess):.0f} at least.",
            f"Means of EI are apart by {spread:.3f} std (rms), {np.abs(apart).max():.2f} at most.",
            f"std by weights over chains: {middle:.3f} (median), {low:.2f} to {high:.2f}.",
            f"{verdicts} verdicts differ.",
        ]
    )


def _evaluations(records: list[Record]) -> int:
    """Of the draws, median."""
    told = [line["diagnostics"].get("chain_evaluations") for line in records if line["estimates"]]
    return round(float(np.median([number for number in told if number is not None])))


def _differences(pairs: list[tuple[Record, Record]]) -> tuple[Any, Any]:
    """Of all EI: means apart in standard deviations, and the ratio of these."""
    apart, ratio = [], []
    for weighted, chains in pairs:
        for name in weighted["truth"]:
            if name.startswith("EI_"):
                a, b = weighted["estimates"][name], chains["estimates"][name]
                apart.append((a["mean"] - b["mean"]) / b["std"])
                ratio.append(a["std"] / b["std"])
    return np.array(apart), np.array(ratio)


if __name__ == "__main__":
    # The processes that are started inherit it: matrices are small, threads would only wait.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
