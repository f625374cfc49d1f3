"""The numerical experiment of the paper: Tables 1 to 4.

Numerical Verification of the Drive-By Monitoring Method for Identifying Vehicle and Bridge
Mechanical Parameters, Applied Sciences (2023), CC BY. m_s is misprinted in the available text; 8310
kg reproduces the rear body frequency and both wheel-hop frequencies of its Table 5.
"""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.physics.bridge import Beam, uniform_beam
from pre_core.physics.vehicle import HalfCar

TRUCK = HalfCar(
    body_mass_kg=8310.0,
    front_axle_to_cg_m=1.215,
    wheelbase_m=4.4,
    suspension_damping_ns_per_m=(24_200.0, 29_000.0),
    suspension_stiffness_n_per_m=(456_000.0, 410_000.0),
    unsprung_mass_kg=(469.0, 751.0),
    tyre_stiffness_n_per_m=(4_790_000.0, 4_310_000.0),
)
SPEED_M_PER_S = 10.0
SPAN_M = 30.0
ELEMENTS = 7
FLEXURAL_RIGIDITY_NM2 = 1.560e10
MASS_PER_LENGTH_KG_PER_M = 4400.0
RAYLEIGH_ALPHA_PER_S = 0.7024
RAYLEIGH_BETA_S = 0.0052
STEP_S = 0.001
FRONT_AXLE_START_M = -10.0

_REDUCED = {
    1: ((), 1.0),
    2: (range(7), 0.9),
    3: (range(7), 0.8),
    4: ((3,), 0.9),
    5: ((3,), 0.7),
    6: ((3,), 0.4),
    7: ((4, 5), 0.9),
    8: ((4, 5), 0.7),
    9: ((4, 5), 0.4),
    10: ((6,), 0.9),
    11: ((6,), 0.7),
    12: ((6,), 0.4),
}
SCENARIOS = tuple(_REDUCED)


def scenario_ratios(scenario: int) -> FloatArray:
    """Return EI of the elements (7,) relative to the undamaged value (Table 3)."""
    elements, ratio = _REDUCED[scenario]
    ratios = np.ones(ELEMENTS)
    ratios[list(elements)] = ratio
    return ratios


def beam(ratios: FloatArray) -> Beam:
    """Return the bridge of Table 2 with these ratios (7,) of the flexural rigidity."""
    return uniform_beam(
        SPAN_M,
        FLEXURAL_RIGIDITY_NM2 * np.asarray(ratios, dtype=np.float64),
        MASS_PER_LENGTH_KG_PER_M,
        RAYLEIGH_ALPHA_PER_S,
        RAYLEIGH_BETA_S,
    )
