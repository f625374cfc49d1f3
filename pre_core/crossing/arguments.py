"""The arguments of the kernels that evaluate a crossing: data, points and work arrays."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.rows import RESIDUALS, RowFilter, row_count
from pre_core.kernels.lanes import LANES
from pre_core.physics import modal_response
from pre_core.physics.beam_basis import BeamBasis
from pre_core.physics.tandem import NO_TANDEM, TandemTruck
from pre_core.physics.torsion import GROUPS, NO_TORSION, TorsionBasis

LONGEST_STRETCH = 128
"""Steps marched at a time, so that their work arrays stay in the cache."""


class GriddedCrossing(NamedTuple):
    """The data of one crossing on an even grid of n samples."""

    step_s: float
    signals: FloatArray  # (4, 6, n): see channels.py
    direction: int
    span_m: float
    total_mass_kg: float
    cg_height_m: float
    gravity_m_per_s2: float
    basis: BeamBasis
    edges_m: FloatArray  # (parts + 1,)
    first_row: int
    rows: int
    """Samples first_row … first_row + rows - 1 of the rear wheel are compared."""
    sinc: FloatArray  # (phases + 1, 2, taps): see `sinc_table`
    step: FloatArray  # (phases + 1, 2 reach): see `step_table`
    is_inertial: bool
    """Whether the tyre force is computed from the masses above it rather than from springs, dampers
    and axle; the results differ by the body equations."""
    swing_sample: int
    """Sample at which the initial vibration (`EvaluationPoints.swing`) begins, before the entry by
    more than the reach of `step`."""
    torsion: TorsionBasis = NO_TORSION
    tandem: TandemTruck = NO_TANDEM
    """Truck with a tandem; "front" and "rear" are then the compared axles of the tandem."""
    front_force_n: FloatArray = np.zeros((0, 0))
    """Forces (k, n) of the front axles besides their shares of the front springs', see
    `front_axles`."""
    front_moment_nm: FloatArray = np.zeros(0)
    """Moment (n,) of these forces on the body."""


class EvaluationPoints(NamedTuple):
    """The k points at which residuals are evaluated (`residuals.evaluate`).

    A gain common to all sensors scales all measurements and changes no residual except by the
    static load, which is not measured: residuals stay in the sensors' own scale, and known loads
    (weight, load transfer) are converted to it.
    """

    theta: FloatArray  # (k, p): truck and bridge, as in parameters.py
    wheelbase_m: FloatArray  # (k,)
    position_m: FloatArray  # (k, n): chainage of the front axle
    acceleration_m_per_s2: FloatArray  # (k, n): positive when speeding up
    gain: FloatArray  # (k, 4): relative corrections, of mean zero
    common_gain: FloatArray  # (k,): factor by which all four sensors read too little
    delay_s: FloatArray  # (k, 4): corrections, applied by Taylor's series
    initial: FloatArray  # (k, 4, 3): displacement, velocity, bias to be added
    swing: FloatArray  # (k, 2 modes): see `deflection`


class Buffers(NamedTuple):
    """Work arrays of one thread; modified in place."""

    matrix: FloatArray  # (m, m)
    vectors: FloatArray  # (m, m)
    cubics: FloatArray  # (parts, groups, 4, 4)
    feedback: FloatArray  # (groups, 5, 4)
    state: FloatArray  # (groups, 2, 4)
    force: FloatArray  # (wheels, stretch, 4)
    lanes: FloatArray  # (wheels, stretch, 4): deflection by lane
    place: FloatArray  # (wheels, n): the compared two, then the front axles
    part: NDArray[np.int64]  # (wheels, n)
    corrected: FloatArray  # (4, 3, n): displacement, velocity, acceleration of each channel
    load: FloatArray  # (wheels, n): contact force on the bridge, up positive
    precompensated: FloatArray  # (wheels, n): the same, precompensated
    road: FloatArray  # (2, n): deflection minus input profile
    body: FloatArray  # (2, n): residuals of the body equations
    begin: NDArray[np.int64]  # (rows,): see `residuals._locate_front_sample`, as the next
    between: FloatArray  # (rows,)
    residual: FloatArray  # (3, rows)
    row: FloatArray  # (filtered rows,)
    modes_of: FloatArray  # (p,) the bridge whose modes are in `cubics`
    modes: FloatArray  # (m, 3): see `modal_filters`
    end_force: FloatArray  # (2 ends, n)
    end_share: FloatArray  # (wheels, 2 ends, n)
    at_end: NDArray[np.bool_]  # (n,) whether one of these is not zero
    under_front: FloatArray  # (wheels - 2, n) deflection under the front axles
    shape: FloatArray  # (wheels - 3, stretch, 4): modes at the front axles but the first


def allocate_buffers(crossing: GriddedCrossing, parameters: int, rows: RowFilter) -> Buffers:
    """Allocate the work arrays for this crossing; `parameters` is the length p of theta."""
    parts, _, m = crossing.basis.cubics.shape
    groups = (m + LANES - 1) // LANES + GROUPS * crossing.torsion.ends_m.shape[0]
    n = crossing.signals.shape[2]
    front = crossing.tandem.front.ahead_m.size
    wheels = 2 + front
    return Buffers(
        np.zeros((m, m)),
        np.zeros((m, m)),
        np.zeros((parts, groups, 4, LANES)),
        np.zeros((groups, modal_response.COEFFICIENTS, LANES)),
        np.zeros((groups, 2, LANES)),
        np.zeros((wheels, LONGEST_STRETCH, LANES)),
        np.zeros((wheels, LONGEST_STRETCH, LANES)),
        np.zeros((wheels, n)),
        np.zeros((wheels, n), dtype=np.int64),
        np.zeros((4, 3, n)),
        np.zeros((wheels, n)),
        np.zeros((wheels, n)),
        np.zeros((2, n)),
        np.zeros((2, n)),
        np.zeros(crossing.rows, dtype=np.int64),
        np.zeros(crossing.rows),
        np.zeros((RESIDUALS, crossing.rows)),
        np.zeros(row_count(rows, crossing.rows)),
        np.full(parameters, np.nan),
        np.zeros((m, 3)),
        np.zeros((2, n)),
        np.zeros((wheels, 2, n)),
        np.full(n, False),
        np.zeros((front, n)),
        np.zeros((max(0, front - 1), LONGEST_STRETCH, LANES)),
    )
