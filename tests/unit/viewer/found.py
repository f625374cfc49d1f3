"""Results as a worker would have found them, of the bridge of docs/site.example.toml."""

from typing import Any

import numpy as np

from schemas.results import Results
from schemas.site import Site
from schemas.site_file import site_hash

RATIOS = np.array([1.0, 0.98, 1.01, 0.4, 1.02, 1.0, 0.99])


def some_crossing(
    name: str, *, verdict: str = "good", reasons: tuple[str, ...] = (), entry: float = 0.0
) -> dict[str, Any]:
    """One crossing, without what depends on the site."""
    return {
        "crossing_id": name, "realm": "live", "direction": "start_to_end", "method": "pre",
        "entry_time": 1.79e9 + entry, "exit_time": 1.79e9 + entry + 4.0, "speed_m_per_s": 10.0,
        "verdict": verdict, "reasons": list(reasons), "chi2_per_dof": 1.02, "scale_error": 0.013,
    }  # fmt: skip


def results_of(
    site: Site,
    *crossings: dict[str, Any],
    used: str | None = None,
    ratios: np.ndarray = RATIOS,
) -> Results:
    """A results file; with `used` there is a state of the bridge, of that crossing."""
    bridge = site.bridges[0]
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2)
    means = (ratios * nominal).tolist()
    x_m = np.linspace(0.0, bridge.span_m, 61)
    road = (2e-3 * np.sin(x_m)).tolist()
    filled = []
    for crossing in crossings:
        values = {
            f"EI_{n}": {"unit": "N·m²", "q50": mean} | _spread(mean)
            for n, mean in enumerate(means, start=1)
        }
        derived = {
            "f1_hz": {"unit": "Hz", "q50": 3.6} | _spread(3.6),
            "max_deflection_m": {"unit": "m", "q50": 2e-4} | _spread(2e-4),
            "probability_sprung": {"start": 0.03, "end": 0.04},
            "probability_giving": {"start": 0.02, "end": 0.01},
            "springs_believed": 1.0,
        }
        given = {
            "parameters": values,
            "derived": derived,
            "diagnostics": {"r_hat": 1.004, "ess": 812.0, "seconds": 5.9},
            "road": {
                "x_m": x_m.tolist(), "front_m": road, "rear_m": road, "mean_m": road,
                "iri_m_per_km": 2.4, "iso_class": "A",
            },
        }  # fmt: skip
        if crossing["verdict"] == "rejected":
            given = {"parameters": None}
        whose = {"vehicle": site.vehicles[0].id, "bridge": bridge.id}
        filled.append({**whose, **crossing, **given})
    states = {}
    if used is not None:
        elements = {f"EI_{n}": _spread(mean) for n, mean in enumerate(means, start=1)}
        states[bridge.id] = {**elements, "level": _level(ratios), "crossings_used": [used]}
    content = {
        "version": "0.1.0", "created": 1.79e9, "site_hash": site_hash(site), "settings": {},
        "seed": 1, "crossings": filled, "bridges": states,
    }  # fmt: skip
    return Results.model_validate(content)


def with_contradictions(found: Results, **z: float) -> Results:
    """Results whose crossings have a bridge parameter far from the declared value; `z` by name."""
    crossings = []
    for crossing in found.crossings:
        mass = {
            "unit": "kg/m", "q50": 7335.0, **_spread(7335.0),
            "prior": {"distribution": "log_normal", "location": 4400.0, "scale": 0.02},
        }  # fmt: skip
        line = crossing.model_dump(mode="json")
        line["parameters"]["rhoA"] = mass
        line["diagnostics"] |= z
        crossings.append(line)
    return Results.model_validate(found.model_dump(mode="json") | {"crossings": crossings})


def _level(ratios: np.ndarray) -> dict[str, float]:
    """Of elements that err by 3 % each, of which 1.3 % is the crossing's scale error."""
    mean = float(np.exp(np.log(ratios).mean()))
    own = 1.0 / ratios.size
    std = mean * float(np.sqrt(0.013**2 * (1.0 - own) + 0.03**2 * own))
    return {"mean": mean, "std": std, "q025": mean - 1.96 * std, "q975": mean + 1.96 * std}


def _spread(mean: float) -> dict[str, float]:
    return {"mean": mean, "std": 0.03 * mean, "q025": 0.943 * mean, "q975": 1.06 * mean}
