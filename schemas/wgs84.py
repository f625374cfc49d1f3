"""The ellipsoid of all coordinates: those of sites, fixes and results."""

from typing import Final

SEMI_MAJOR_AXIS_M: Final = 6378137.0
FLATTENING: Final = 1 / 298.257223563
ECCENTRICITY_SQUARED: Final = FLATTENING * (2 - FLATTENING)
