"""Confidence levels: quantiles of the normal distribution that the whole product shares."""

from statistics import NormalDist

_NORMAL = NormalDist()
# Quantile at the upper end of a 95 % interval with equal tails.
UPPER_95 = 0.975
# Standard deviations on either side of a 95 % interval, and the chi-square of one parameter there.
SIGMAS_95 = _NORMAL.inv_cdf(UPPER_95)
CHI2_95 = SIGMAS_95**2
# Chi-square of one parameter that chance exceeds once in a thousand.
CHI2_999 = _NORMAL.inv_cdf(1.0 - 0.001 / 2.0) ** 2
# Standard deviation of normal scatter over its median absolute deviation (MAD).
MAD_TO_SIGMA = 1.0 / _NORMAL.inv_cdf(0.75)
