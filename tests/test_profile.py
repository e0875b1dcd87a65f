"""Intervals by profile likelihood: normal where the model is linear, lopsided where it is not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize_scalar

from twin.inference.levels import CHI2_95, SIGMAS_95
from twin.inference.profile import Floats, profile_interval

WIDE = np.full(2, -1e3), np.full(2, 1e3)
ROWS = np.linspace(0.0, 1.0, 40)


@given(st.floats(-0.95, 0.95), st.floats(0.1, 10.0))
def test_of_a_linear_model_it_is_the_normal_one(together: float, sigma: float) -> None:
    covariance = np.array([[1.0, together * sigma], [together * sigma, sigma**2]])
    x = np.array([2.0, -1.0])

    def misfit(points: Floats) -> Floats:
        off = points - x
        found: Floats = np.sum((off @ np.linalg.inv(covariance)) * off, axis=1) + 7.0
        return found

    low, high = profile_interval(misfit, x, covariance, WIDE, CHI2_95)
    reach = SIGMAS_95 * np.array([1.0, sigma])
    assert low == pytest.approx(x - reach, rel=0.03, abs=0.03 * sigma)
    assert high == pytest.approx(x + reach, rel=0.03, abs=0.03 * sigma)


def decay(point: Floats) -> Floats:
    found: Floats = np.exp(point[0] - np.exp(point[1]) * ROWS)
    return found


def test_of_another_model_it_is_where_the_best_of_the_other_size_has_the_rise() -> None:
    truth, sigma = np.array([1.0, 0.4]), 0.25
    data = decay(truth)

    def misfit(points: Floats) -> Floats:
        return np.array([np.sum((decay(point) - data) ** 2) / sigma**2 for point in points])

    moved = [(decay(truth + step) - data) / 1e-5 for step in 1e-5 * np.eye(2)]
    jacobian = np.stack(moved, axis=1) / sigma
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    low, high = profile_interval(misfit, truth, covariance, WIDE, CHI2_95)
    for size in (0, 1):

        def profiled(at: float, size: int = size) -> float:
            def along(other: float) -> float:
                point = np.array([at, other]) if size == 0 else np.array([other, at])
                return float(misfit(point[None])[0])

            other = truth[1 - size]
            return float(minimize_scalar(along, (other - 0.1, other + 0.1)).fun) - CHI2_95

        below = brentq(profiled, truth[size] - 2.0, truth[size])
        above = brentq(profiled, truth[size], truth[size] + 2.0)
        normal = SIGMAS_95 * np.sqrt(covariance[size, size])
        for found, true in ((low[size], below), (high[size], above)):
            assert abs(found - truth[size]) == pytest.approx(abs(true - truth[size]), rel=0.12)
        assert abs(high[1] - truth[1]) != pytest.approx(normal, rel=0.03)


def test_it_ends_at_a_bound_that_the_data_allow() -> None:
    def misfit(points: Floats) -> Floats:
        return np.sum(points**2, axis=1)

    bounds = np.array([-0.5, -9.0]), np.array([9.0, 9.0])
    low, high = profile_interval(misfit, np.zeros(2), np.eye(2), bounds, CHI2_95)
    assert low == pytest.approx([-0.5, -SIGMAS_95], abs=0.06)
    assert high == pytest.approx([SIGMAS_95, SIGMAS_95], abs=0.06)


def test_where_nothing_depends_on_a_size_it_is_all_of_its_range() -> None:
    def misfit(points: Floats) -> Floats:
        found: Floats = points[:, 0] ** 2
        return found

    covariance = np.diag([1.0, 1e6])
    bounds = np.array([-9.0, -4.0]), np.array([9.0, 6.0])
    low, high = profile_interval(misfit, np.zeros(2), covariance, bounds, CHI2_95)
    assert (low[1], high[1]) == (-4.0, 6.0)
    assert high[0] == pytest.approx(SIGMAS_95, abs=0.06)
