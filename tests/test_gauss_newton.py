"""Fits side by side: they end where SciPy's ends, within bounds, each in its own time."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from twin.inference.gauss_newton import MOST_ROUNDS, Descent, descend, information
from twin.inference.whitening import Floats

TIMES = np.linspace(0.0, 3.0, 40)


def curve(x: Floats) -> Floats:
    """Something that is not linear in its sizes."""
    found: Floats = x[0] * np.exp(-TIMES / (0.5 + x[1] ** 2))
    return found


def run(measured: Floats, starts: Sequence[Floats], low: float, high: float) -> list[Descent]:
    """Fits from several starts."""
    ends = np.full(2, low), np.full(2, high)
    fits = [Descent(*ends, start) for start in starts]

    def residuals(asked: Sequence[tuple[Descent, Floats]]) -> Floats:
        return np.column_stack([(curve(x) - measured) / 0.01 for _, x in asked])

    descend(fits, residuals, lambda _: None)
    return fits


@settings(max_examples=20, deadline=None)
@given(st.floats(0.5, 4.0), st.floats(0.3, 2.0), st.integers(0, 1000))
def test_a_fit_ends_where_scipys_does(size: float, time: float, seed: int) -> None:
    noise = 0.01 * np.random.default_rng(seed).standard_normal(len(TIMES))
    measured = curve(np.array([size, time])) + noise
    start = np.array([size, time]) * 1.3
    (fit,) = run(measured, [start], 0.0, 6.0)

    def residual(x: Floats) -> Floats:
        return (curve(x) - measured) / 0.01

    known = least_squares(residual, start, bounds=(0.0, 6.0))
    sigma = np.sqrt(np.diag(np.linalg.inv(fit.information)))
    assert np.abs(fit.x - known.x) == pytest.approx(0.0, abs=0.5 * sigma.max())
    assert fit.chi2 == pytest.approx(2.0 * known.cost, abs=0.3 * fit.scale)


def test_a_linear_fit_is_exact_after_one_step() -> None:
    rng = np.random.default_rng(3)
    matrix, right = rng.standard_normal((30, 2)), rng.standard_normal(30)
    fit = Descent(np.full(2, -9.0), np.full(2, 9.0), np.zeros(2))
    rounds = list[int]()
    descend(
        [fit],
        lambda asked: np.column_stack([matrix @ x - right for _, x in asked]),
        rounds.append,
    )
    assert fit.x == pytest.approx(np.linalg.lstsq(matrix, right, rcond=None)[0], abs=1e-3)
    assert rounds == [0, 1, 2]  # it has nothing to do in the last
    assert information(fit.jacobian) == pytest.approx(matrix.T @ matrix, rel=1e-3)


def test_a_size_stays_within_its_bounds() -> None:
    (fit,) = run(curve(np.array([3.0, 1.0])), [np.array([0.5, 0.5])], 0.0, 2.0)
    assert fit.x[0] == pytest.approx(2.0)
    assert (fit.x >= 0.0).all()


def test_what_is_given_up_keeps_its_best_point_and_asks_no_more() -> None:
    first, second = (Descent(np.zeros(2), np.full(2, 6.0), x) for x in np.array([[1, 1], [5, 5]]))
    asked_of = []

    def residuals(asked: Sequence[tuple[Descent, Floats]]) -> Floats:
        asked_of.append({id(fit) for fit, _ in asked})
        return np.column_stack([curve(x) - curve(np.array([2.0, 1.0])) for _, x in asked])

    def give_up(turn: int) -> None:
        second.done |= turn == 1

    descend([first, second], residuals, give_up)
    assert asked_of[0] == {id(first), id(second)}
    assert all(some == {id(first)} for some in asked_of[1:])
    assert len(asked_of) <= MOST_ROUNDS
    assert np.isfinite(second.chi2)
