"""Layout of a crossing's parameters in the search coordinates y."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.deflection import SWING_MODES
from pre_core.parameters import EI_1, FIRST_OF_BRIDGE

CHANNELS = 4


class ParameterLayout(NamedTuple):
    """Indices in y of groups of search coordinates."""

    theta: slice
    """Indices of the estimated parameters of truck and bridge."""
    bridge: NDArray[np.int64]
    """Indices of the bridge's estimated parameters; `elements` are the last ones."""
    elements: NDArray[np.int64]
    half_normal: NDArray[np.int64]
    """Indices of coordinates that must not be negative."""
    wheelbase: int
    gains: slice
    """Indices of the contrasts between the channels' gains."""
    common_gain: int
    delays: slice
    initial: slice
    """Indices of displacement, velocity and bias at the beginning, three for each channel."""
    swing: slice
    """Indices of the initial vibration of the bridge."""
    trajectory: slice
    """Indices of the coefficients of the trajectory's spline."""
    offset: int
    """Index of the slow error of the receiver, in m."""
    size: int
    """Number f of search coordinates."""


@lru_cache(maxsize=8)
def parameter_layout(estimated: bytes, half_normal: bytes, coefficients: int) -> ParameterLayout:
    """Return the layout for flags (p,) as bytes, and a number of spline coefficients.

    Flags are `estimated` parameters and those with a `half_normal` prior. Results are cached,
    because every evaluation needs one.
    """
    kept = np.flatnonzero(np.frombuffer(estimated, dtype=np.bool_))
    t = kept.size
    gains = slice(t + 1, t + 4)
    delays = slice(gains.stop + 1, gains.stop + 1 + CHANNELS)
    initial = slice(delays.stop, delays.stop + 3 * CHANNELS)
    swing = slice(initial.stop, initial.stop + 2 * SWING_MODES)
    trajectory = slice(swing.stop, swing.stop + coefficients)
    places = (
        np.flatnonzero(kept >= FIRST_OF_BRIDGE),
        np.flatnonzero(kept >= EI_1),
        np.flatnonzero(np.frombuffer(half_normal, dtype=np.bool_)[kept]),
    )
    for one in places:
        one.flags.writeable = False
    return ParameterLayout(
        slice(0, t),
        *places,
        t,
        gains,
        gains.stop,
        delays,
        initial,
        swing,
        trajectory,
        trajectory.stop,
        trajectory.stop + 1,
    )
