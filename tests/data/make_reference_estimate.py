"""Writes reference_estimate.json: what the engine makes of recordings/sample/crossing.mcap.

    .venv/bin/python tests/data/make_reference_estimate.py

Run it when a change of the result is meant, and say in the commit why the numbers moved and how far
(`git diff` shows it). tests/process_replay/test_reference.py compares with it.
"""

import json
from pathlib import Path
from typing import Any

from schemas.results import Crossing
from schemas.settings import IdentificationSettings
from services.identify import identify_recordings, site_of

PROJECT = Path(__file__).parents[2]
SAMPLE = PROJECT / "recordings" / "sample" / "crossing.mcap"
REFERENCE = Path(__file__).with_name("reference_estimate.json")


def digest(crossing: Crossing) -> dict[str, Any]:
    """The numbers of a result that a user reads, few enough to look at."""
    assert crossing.parameters is not None
    assert crossing.road is not None
    assert crossing.derived is not None
    road = crossing.road
    places = range(0, len(road.x_m), len(road.x_m) // 10)
    return {
        "crossing_id": crossing.crossing_id,
        "direction": crossing.direction,
        "verdict": crossing.verdict,
        "reasons": list(crossing.reasons),
        "entry_time": crossing.entry_time,
        "exit_time": crossing.exit_time,
        "speed_m_per_s": crossing.speed_m_per_s,
        "parameters": {name: p.mean for name, p in crossing.parameters.items()},
        "f1_hz": crossing.derived.f1_hz.mean,
        "max_deflection_m": crossing.derived.max_deflection_m.mean,
        "road_x_m": [road.x_m[i] for i in places],
        "road_front_m": [road.front_m[i] for i in places],
        "road_rear_m": [road.rear_m[i] for i in places],
        "iri_m_per_km": road.iri_m_per_km,
    }


def estimate() -> dict[str, Any]:
    """What the code of now makes of the sample."""
    found = identify_recordings([SAMPLE], site_of([SAMPLE], None), IdentificationSettings())
    (crossing,) = found.crossings
    return digest(crossing)


if __name__ == "__main__":
    REFERENCE.write_text(json.dumps(estimate(), indent=1) + "\n")
