"""Accuracy of trucks with a tandem: the table of studies/tandems.md.

    python -m studies.scripts.tandems --kinds loaded aside --crossings 40 --records FILE

Each crossing is drawn by `studies.simulation.tandem_cases`, simulated by `two_sided`, which shares
no code with the method, and identified by the owner's site file. Finished crossings are kept in the
file of records and not run again. Half a minute to a minute each on a quiet core.
"""

import argparse
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from schemas.settings import IdentificationSettings
from services.simulation.drawn import identify_simulated
from services.simulation.wide_crossings import WideCase, drive_case, site_of
from studies.simulation.tandem_cases import TandemOptions, draw_tandem

_LOADED: Final = TandemOptions(total_mass_kg=(24.3e3, 25.3e3), span_m=(30.0, 30.0))
"""A loaded tipper on a bridge of 30 m."""
KINDS: Final = {
    "any": TandemOptions(),
    "loaded": _LOADED,
    "aside": _LOADED._replace(offset_m=0.02),
    "unequal": _LOADED._replace(outer_share=0.55),
    "own-springs": _LOADED._replace(equalised=False, friction_share=0.0),
    "own-rubbing": _LOADED._replace(equalised=False, friction_share=0.08),
    "undeclared": _LOADED._replace(equalised=False, friction_share=0.08, is_declared=False),
    "four-axles": _LOADED._replace(has_two_steered=True),
}
"""Kinds of crossings: a tandem 20 mm aside, twin tyres loaded 55:45, axles on springs of their own
without and with friction, such axles that the owner declares as equalised, and two steered axles
ahead of an equalised tandem."""
CONSOLE: Final = Console(soft_wrap=True)


def judged(case: WideCase) -> dict[str, Any]:
    """Identify the first run of a case; return its verdict, and errors where it has values."""
    settings = IdentificationSettings(method="pre", threads=1)
    site = site_of(case)
    found = identify_simulated([drive_case(case, 0).run], site, settings)
    if len(found) != 1:
        return {"verdict": "not_found"}
    result = found[0].result
    record: dict[str, Any] = {"verdict": result.verdict, "reasons": list(result.reasons)}
    if result.parameters is None or result.derived is None or result.derived.ei_level is None:
        return record
    truth = np.array(case.deck.flexural_rigidity_nm2)
    values = [result.parameters[f"EI_{e + 1}"] for e in range(truth.size)]
    mean, std = np.array([p.mean for p in values]), np.array([p.std for p in values])
    level = result.derived.ei_level
    nominal = np.array(site.bridges[0].nominal_flexural_rigidity_nm2)
    true_level = float(np.exp(np.mean(np.log(truth / nominal))))
    covered = [bool(p.q025 <= true <= p.q975) for p, true in zip(values, truth, strict=True)]
    return record | {
        "z": ((mean - truth) / std).round(3).tolist(),
        "covered": covered,
        "relative_std": (std / truth).round(4).tolist(),
        "level_std": round(level.std / level.mean, 4),
        "level_error": round(level.mean / true_level - 1.0, 4),
        "chi2": result.chi2_per_dof,
    }


def summary(records: list[dict[str, Any]]) -> dict[str, float]:
    """Return counts of verdicts, and figures of the good crossings."""
    good = [one for one in records if one["verdict"] == "good" and "z" in one]
    found: dict[str, float] = {"crossings": len(records), "good": len(good)}
    if not good:
        return found
    z = np.concatenate([one["z"] for one in good])
    return found | {
        "suspect": sum(one["verdict"] == "suspect" for one in records),
        "inner": float(np.median([np.median(one["relative_std"][1:-1]) for one in good])),
        "all": float(np.median([np.median(one["relative_std"]) for one in good])),
        "level": float(np.median([one["level_std"] for one in good])),
        "coverage": float(np.mean(np.concatenate([one["covered"] for one in good]))),
        "rms_z": float(np.sqrt(np.mean(z**2))),
        "largest_z": float(np.abs(z).max()),
        "smallest_inner": float(min(np.median(one["relative_std"][1:-1]) for one in good)),
    }


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Return the finished crossings by kind and seed."""
    if not path.exists():
        return {}
    lines = path.read_text("utf-8").splitlines()
    return {f"{one['kind']} {one['seed']}": one for one in map(json.loads, lines)}


def main() -> None:
    """Identify the missing crossings and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--crossings", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="first seed (default: 0)")
    parser.add_argument("--records", type=Path, default=Path("tandems.jsonl"))
    options = parser.parse_args()
    known = read(options.records)
    for kind in options.kinds:
        seeds = range(options.first, options.first + options.crossings)
        for seed in seeds:
            if f"{kind} {seed}" in known:
                continue
            one = {"kind": kind, "seed": seed, **judged(draw_tandem(seed, KINDS[kind]))}
            known[f"{kind} {seed}"] = one
            with options.records.open("a", encoding="utf-8") as file:
                file.write(json.dumps(one) + "\n")
        figures = summary([known[f"{kind} {seed}"] for seed in seeds])
        shown = json.dumps({key: round(value, 3) for key, value in figures.items()})
        CONSOLE.print(kind, shown, highlight=False, markup=False)


if __name__ == "__main__":
    main()
