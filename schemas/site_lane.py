"""The keys of `[bridge]` for an eccentric lane, and the torsion that follows from them.

On a deck of torsional rigidity GJ that rotates by theta, an axle whose centre is at the distance e
from the deck's axis sinks by e theta. Of e and GJ only g = e²/(GJ) is a parameter
(docs/contract.md, `torsion`). Owners know the lane and, at best, the ratio of the deck's first
torsional to its first bending frequency and the radius of gyration r of its cross-section. For a
uniform deck

    f_1 = pi/(2 L²) sqrt(EI/rho A),   f_t = ratio f_1,   GJ = rho A r² (2 L f_t)²

with the longest span L and the mean of the nominal EI.
"""

import math
from abc import abstractmethod
from typing import Annotated, Final

from pydantic import BaseModel, Field

from schemas.site_numbers import Number, Spread

USUAL_LANE_M: Final = 2.0
"""Distance of a usual lane from the axis: half of a two-lane road."""
USUAL_FREQUENCY_RATIO: Final = 2.0
USUAL_GYRATION_M: Final = 2.3
"""Radius of gyration of a two-lane deck, about 8 m wide."""
_RATIO_SPREAD, _GYRATION_SPREAD = 0.3, 0.2
_UNKNOWN_RATIO_SPREAD, _UNKNOWN_GYRATION_SPREAD = 0.5, 0.3
_NEGLIGIBLE_M: Final = 0.05
"""Largest distance of a lane from the axis that needs no torsion."""


def flexibility_per_n(
    lane_offset_m: float, gyration_m: float, frequency_ratio: float, span_m: float, ei_nm2: float
) -> float:
    """Return e²/(GJ) in 1/N at the distance e = `lane_offset_m` from the axis."""
    root = lane_offset_m * span_m / (math.pi * frequency_ratio * gyration_m)
    return root * root / ei_nm2


def wave_speed_m_per_s(
    frequency_ratio: float, span_m: float, ei_nm2: float, mass_per_length_kg_per_m: float
) -> float:
    """Return the speed 2 L f_t of torsional waves."""
    return frequency_ratio * math.pi / span_m * math.sqrt(ei_nm2 / mass_per_length_kg_per_m)


class Lane(BaseModel):
    """Position of the lane and torsion of the deck, as far as known."""

    lane_offset_m: Annotated[Number, Field(ge=-20, le=20)] | None = None
    """Distance of the lane's centre to the left of the bridge's axis, seen from start to end."""
    torsional_frequency_ratio: Annotated[Number, Field(ge=0.2, le=100)] | None = None
    """Ratio of the first torsional to the first bending frequency."""
    deck_gyration_m: Annotated[Number, Field(ge=0.1, le=30)] | None = None
    """Radius of gyration of the cross-section about its axis."""

    lane_offset_m_spread: Annotated[Number, Field(ge=0, le=20)] = 0.3
    """Standard deviation in m."""
    torsional_frequency_ratio_spread: Spread = _RATIO_SPREAD
    deck_gyration_m_spread: Spread = _GYRATION_SPREAD

    @abstractmethod
    def uniform(self) -> tuple[float, float, float]:
        """Return the longest span in m, mean nominal EI in N·m² and mass per length in kg/m."""

    @property
    def is_lane_off_axis(self) -> bool:
        """Whether the site file places the lane off the axis, so that the deck twists."""
        offset = self.lane_offset_m
        return offset is not None and abs(offset) > max(self.lane_offset_m_spread, _NEGLIGIBLE_M)

    @property
    def reference_lane_offset_m(self) -> float:
        """Distance from the axis at which the torsion parameter is defined."""
        if self.lane_offset_m is None:
            return USUAL_LANE_M
        return max(abs(self.lane_offset_m), self.lane_offset_m_spread)

    @property
    def torsional_flexibility_per_n(self) -> float:
        """Nominal e²/(GJ) in 1/N; 0 unless the site file places the lane off the axis."""
        return self._flexibility_per_n if self.is_lane_off_axis else 0.0

    @property
    def torsional_flexibility_per_n_spread(self) -> float:
        """Standard deviation of ln g: twice those of ln e, ln ratio and ln r, combined."""
        assert self.lane_offset_m is not None  # noqa: S101 - the lane is off the axis
        ratio, gyration = _UNKNOWN_RATIO_SPREAD, _UNKNOWN_GYRATION_SPREAD
        if self.torsional_frequency_ratio is not None:
            ratio = self.torsional_frequency_ratio_spread
        if self.deck_gyration_m is not None:
            gyration = self.deck_gyration_m_spread
        lane = self.lane_offset_m_spread / abs(self.lane_offset_m)
        return 2.0 * math.hypot(lane, ratio, gyration)

    @property
    def torsional_flexibility_per_n_scale_at_zero(self) -> float:
        """Scale of the half-normal prior of g; 0 where the lane is known to be on the axis."""
        if self.lane_offset_m is not None and self.reference_lane_offset_m <= _NEGLIGIBLE_M:
            return 0.0
        return self._flexibility_per_n

    @property
    def torsional_wave_speed_m_per_s(self) -> float:
        """Nominal speed of torsional waves, 2 L f_t."""
        return wave_speed_m_per_s(
            self.torsional_frequency_ratio or USUAL_FREQUENCY_RATIO, *self.uniform()
        )

    @property
    def _flexibility_per_n(self) -> float:
        return flexibility_per_n(
            self.reference_lane_offset_m,
            self.deck_gyration_m or USUAL_GYRATION_M,
            self.torsional_frequency_ratio or USUAL_FREQUENCY_RATIO,
            *self.uniform()[:2],
        )
