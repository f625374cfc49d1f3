"""Constants of nature and of statistics, each once."""

STANDARD_GRAVITY_M_PER_S2 = 9.80665
"""By definition (3rd General Conference on Weights and Measures, 1901)."""

MICRO_G_M_PER_S2 = 9.80665e-6
"""A millionth of it, in which noise densities are given. The product of 1e-6 and the constant above
is another number, by one unit of its last place."""

NORMAL_975 = 1.959963984540054
"""97.5 % quantile of the standard normal distribution: a 95 % interval is so many standard
deviations to either side."""
