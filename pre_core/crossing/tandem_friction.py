"""Friction of a tandem without load equalisation, relative to its load."""

from pre_core.arrays import FloatArray
from pre_core.crossing.posterior import PosteriorProblem, has_tandem, points
from pre_core.crossing.suspension_noise import force_rms_n
from pre_core.physics.tandem import shared_load


def tandem_friction(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the RMS friction of a tandem's springs divided by their static load, at y (f,).

    It is zero for a truck without a tandem, and for an equalised one, whose friction does not
    matter.
    """
    crossing = problem.crossing
    if not has_tandem(problem) or crossing.tandem.is_equalised:
        return 0.0
    at = points(problem, y[None, :])
    gap = float(at.wheelbase_m[0])
    load = shared_load(crossing.tandem, at.theta[0], crossing.total_mass_kg, gap)
    static = load.bogie_kg * crossing.gravity_m_per_s2
    return float(force_rms_n(problem.force)[1] / static)
