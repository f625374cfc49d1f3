"""The site that studies draw from, and the truth of a crossing by the names of results."""

from pre_core import parameters
from pre_core.physics.bridge import natural_frequencies_hz
from pre_core.physics.models import from_models
from schemas.site import Site
from services.simulation.drawn import CrossingTruth
from services.simulation.drive import paper_site

_CG_HEIGHT_M = 1.1
"""Height of a loaded truck's centre of gravity above the road."""


def default_site() -> Site:
    """Return the paper's truck and bridge, with a known height of the centre of gravity."""
    site = paper_site()
    vehicle = site.vehicles[0].model_copy(update={"cg_height_m": _CG_HEIGHT_M})
    return site.model_copy(update={"vehicles": (vehicle,)})


def true_values(truth: CrossingTruth) -> dict[str, float]:
    """Return the truth under the names of docs/contract.md."""
    car, beam = truth.car, truth.beam
    vector = from_models(car, beam)
    names = parameters.names(beam.flexural_rigidity_nm2.size)
    values = dict(zip(names, vector.tolist(), strict=True))
    d_1 = car.front_axle_to_cg_m
    rear_share = d_1 / car.wheelbase_m
    return values | {
        "m_s": car.body_mass_kg,
        "m_s1": car.body_mass_kg * (1.0 - rear_share),
        "m_s2": car.body_mass_kg * rear_share,
        "wheelbase": car.wheelbase_m,
        "f1_hz": float(natural_frequencies_hz(beam, 1)[0]),
    }
