"""The table of identification methods: what each needs of a drive, and what it offers."""

from collections.abc import Mapping
from typing import Final, NamedTuple

from schemas.site import Site
from services.finding.crossing_data import WindowOf, close_window, wide_window
from services.finding.placed import middle_sensor
from services.finding.stays import LONGEST_BRIDGED_S

LONGEST_SURE_OUTAGE_S = 1.5
"""Longest time in s between fixes of a certain trajectory without the axles' signals."""


class IdentificationMethod(NamedTuple):
    """A method of identification."""

    window: WindowOf
    """Shape of the stretch of a drive that it needs."""
    longest_outage_s: float
    """Longest time in s without a fix on the bridge."""
    is_general: bool
    """Whether it knows bridges with interior supports and tandem axles."""
    has_noise_model: bool
    """Whether it uses the sensors' noise, and has posterior draws and site validations."""


_PAPER: Final = IdentificationMethod(
    close_window, LONGEST_SURE_OUTAGE_S, is_general=False, has_noise_model=False
)
METHODS: Final[Mapping[str, IdentificationMethod]] = {
    "pre": IdentificationMethod(
        wide_window, LONGEST_BRIDGED_S, is_general=True, has_noise_model=True
    ),
    "least_squares": _PAPER,
    "random_walk": _PAPER,
}


def lacks_noise(site: Site, method: str) -> bool:
    """Return whether a method needs the sensors' noise, and the site declares none."""
    densities = (middle_sensor(site.sensor, one).noise_density_ug_per_rthz for one in site.vehicles)
    return METHODS[method].has_noise_model and not any(map(any, densities))


def window_of(method: str) -> WindowOf:
    """Return the shape of a method's window; the paper's methods need the bridge alone."""
    return METHODS[method].window
