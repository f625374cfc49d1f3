"""Crossings of trucks and bridges with width, identified and compared with the truth.

python -m tests.verdicts.width wide N          N drawn trucks in lanes off the axis
python -m tests.verdicts.width more-axles N    N of 16 trucks declared with two axles only

One line of JSON for each crossing, half a minute to one crossing on a quiet machine.
"""

import json
import sys
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.settings import IdentificationSettings
from services.simulation.drawn import identify_simulated
from services.simulation.wide_crossings import WideCase, drive_case, site_of
from studies.simulation.wide_cases import draw_wide, more_axles


class Judged(NamedTuple):
    """What the program says of one crossing."""

    name: str
    verdict: str
    """"not_found" where the engine gave no crossing."""
    reasons: tuple[str, ...]
    z: NDArray[np.float64]
    """Error over standard deviation of each element; empty where there is no answer."""
    is_covered: NDArray[np.bool_]
    """Whether the 95 % interval of each element holds the truth."""
    relative_std: NDArray[np.float64]


def judged(case: WideCase) -> Judged:
    """Drive the case's first run and identify it by the owner's site file."""
    settings = IdentificationSettings(method="pre", threads=1)
    found = identify_simulated([drive_case(case, 0).run], site_of(case), settings)
    none = np.empty(0)
    if len(found) != 1:
        return Judged(case.name, "not_found", (), none, none.astype(bool), none)
    result = found[0].result
    reasons = tuple(str(reason) for reason in result.reasons)
    if result.parameters is None:
        return Judged(case.name, result.verdict, reasons, none, none.astype(bool), none)
    truth = np.array(case.deck.flexural_rigidity_nm2)
    values = [result.parameters[f"EI_{e + 1}"] for e in range(truth.size)]
    mean, std = np.array([p.mean for p in values]), np.array([p.std for p in values])
    covered = [p.q025 <= true <= p.q975 for p, true in zip(values, truth, strict=True)]
    return Judged(
        case.name, result.verdict, reasons, (mean - truth) / std, np.array(covered), std / truth
    )


def as_json(case: WideCase, found: Judged) -> dict[str, Any]:
    """The verdict, and what of the truth a reader wants beside it."""
    torsion = case.deck.torsion
    return {
        "case": found.name,
        "verdict": found.verdict,
        "reasons": found.reasons,
        "z": found.z.round(2).tolist(),
        "covered": int(found.is_covered.sum()),
        "relative_std": found.relative_std.round(3).tolist(),
        "lane_offset_m": round(case.lane_offset_m, 2),
        "torsion_hz": None if torsion is None else round(torsion.frequency_hz, 2),
        "twin": case.truck.axles[1].twin_distance_m > 0.0,
        "declared": "lane_offset_m" in case.declared["bridge"],
        "axles": len(case.truck.axles),
    }


def main() -> None:
    kind, count = sys.argv[1:3]
    draw = {"wide": draw_wide, "more-axles": more_axles}[kind]
    for number in range(int(count)):
        case = draw(number)
        print(json.dumps(as_json(case, judged(case))), flush=True)


if __name__ == "__main__":
    main()
