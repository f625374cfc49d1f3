"""Writes reference_estimate.json: what the engine makes of two stored recordings.

    .venv/bin/python -m tests.data.make_reference_estimate [--print] [sample] [noise_free]

Run it when a change of the result is meant, for the recordings (all by default) whose result is to
change, and say in the commit why the numbers moved and how far (`git diff` shows it).
tests/process_replay/test_reference.py compares with it. With --print the file stays as it is.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

from schemas.results import CrossingResult, Method
from schemas.settings import IdentificationSettings
from services.execution.offline import site_of
from tests.identifications import identify_recordings

PROJECT = Path(__file__).parents[2]
REFERENCE = Path(__file__).with_name("reference_estimate.json")


DRAWS = 6000
"""Five times the default, because processors part after the first difference in rounding."""


class Source(NamedTuple):
    """A recording and how it is identified. Both are of the paper's scenario 6, seed 1."""

    recording: Path
    method: Method


SOURCES = {
    # 25 µg/√Hz and the errors of a real receiver
    "sample": Source(PROJECT / "recordings" / "sample" / "crossing.mcap", "pre"),
    "noise_free": Source(Path(__file__).with_name("noise_free.mcap"), "least_squares"),
}


def identified(source: Source) -> CrossingResult:
    """What the code of now makes of a recording."""
    settings = IdentificationSettings(method=source.method, draws=DRAWS)
    recordings = [source.recording]
    (crossing,) = identify_recordings(recordings, site_of(recordings, None), settings).crossings
    return crossing


def digest(crossing: CrossingResult) -> dict[str, Any]:
    """The numbers of a result that a user reads, few enough to look at."""
    assert crossing.parameters is not None
    assert crossing.road is not None
    assert crossing.derived is not None
    road = crossing.road
    places = range(0, len(road.x_m), len(road.x_m) // 10)
    derived = {
        "f1_hz": crossing.derived.f1_hz,
        "max_deflection_m": crossing.derived.max_deflection_m,
    }
    return {
        "crossing_id": crossing.crossing_id,
        "direction": crossing.direction,
        "verdict": crossing.verdict,
        "reasons": list(crossing.reasons),
        "entry_time": crossing.entry_time,
        "exit_time": crossing.exit_time,
        "speed_m_per_s": crossing.speed_m_per_s,
        "chi2_per_dof": crossing.chi2_per_dof,
        "scale_error": crossing.scale_error,
        "estimates": {
            name: {"mean": p.mean, "std": p.std, "q025": p.q025, "q975": p.q975}
            for name, p in (crossing.parameters | derived).items()
        },
        "road_x_m": [road.x_m[i] for i in places],
        "road_front_m": [road.front_m[i] for i in places],
        "road_rear_m": [road.rear_m[i] for i in places],
        "iri_m_per_km": road.iri_m_per_km,
    }


def main() -> None:
    """Identify the recordings that are named and write or print what was found."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--print", action="store_true", dest="printed")
    parser.add_argument("names", nargs="*", metavar="NAME", choices=[*SOURCES, []])
    arguments = parser.parse_args()
    found = {name: digest(identified(SOURCES[name])) for name in arguments.names or SOURCES}
    if arguments.printed:
        json.dump(found, sys.stdout)
    else:
        kept = json.loads(REFERENCE.read_text())
        REFERENCE.write_text(json.dumps(kept | found, indent=1) + "\n")


if __name__ == "__main__":
    main()
