"""Standard deviation of normal errors from a median, which blunders hardly move (Hampel 1974)."""

from math import log, sqrt

SIGMA_BY_MEDIAN_1D = 1.4826
"""Standard deviation over the median of the absolute error in one dimension: 1 / (upper quartile of N(0, 1))."""
SIGMA_BY_MEDIAN_2D = 1 / sqrt(2 * log(2))
"""Standard deviation of one coordinate over the median length of the error in two dimensions (Rayleigh), 0.849."""
