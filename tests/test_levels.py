"""Quantiles that the whole product shares, against SciPy's."""

import numpy as np
import pytest
from scipy import stats

from twin.inference.levels import CHI2_95, CHI2_999, MAD_TO_SIGMA, SIGMAS_95, UPPER_95


def test_quantiles_are_those_of_the_distributions() -> None:
    assert pytest.approx(stats.norm.ppf(UPPER_95)) == SIGMAS_95
    assert pytest.approx(stats.chi2.ppf(0.95, 1)) == CHI2_95
    assert pytest.approx(stats.chi2.ppf(0.999, 1)) == CHI2_999
    normal = np.abs(stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000))
    assert pytest.approx(1.0 / np.median(normal), rel=1e-4) == MAD_TO_SIGMA
