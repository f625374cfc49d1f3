"""Effect of an error of the total mass on a bridge's coordinates."""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.fusion.information import BridgePriors


def mass_sensitivity(priors: BridgePriors, centre: FloatArray) -> FloatArray:
    """Return d x/d ln mass (b,) of the bridge's coordinates x at `centre` (b,)."""
    of, power = priors.coordinates, priors.mass_powers
    change = np.where(of.is_log, power / of.scale, power * centre)
    elements = np.arange(centre.size - priors.elements, centre.size)
    change[elements] = -power[elements] * centre[elements]
    return np.asarray(change)
