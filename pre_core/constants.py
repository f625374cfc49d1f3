"""Constants of physics and statistics."""

STANDARD_GRAVITY_M_PER_S2 = 9.80665
"""Standard gravity (3rd General Conference on Weights and Measures, 1901)."""

MICRO_G_M_PER_S2 = 9.80665e-6
"""Unit of noise densities, 1e-6 g. The product of 1e-6 and the constant above differs from it in
the last bit."""

NORMAL_975 = 1.959963984540054
"""97.5 % quantile of the standard normal distribution: half the width of a 95 % interval in
standard deviations."""

DETECTION_PROBABILITY = 0.95
"""Probability with which a loss must be found to be called detectable, in plans and findings."""

NORMAL_95 = 1.6448536269514722
"""Quantile of the standard normal distribution for `DETECTION_PROBABILITY`."""

SLOPE_SPREAD = 4e-3
"""Prior standard deviation of the part of d ln EI/dT that all elements of a bridge share, 1/K:
concrete and asphalt lose some tenths of a per cent per kelvin."""
