"""Covariances of residuals: their parts, and that whitening by them is by their inverse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag

from twin.inference.whitening import (
    CoupledCovariance,
    Covariance,
    add_independent,
    fading,
    low_rank,
)


def test_whitened_columns_have_the_products_of_the_inverse_covariance() -> None:
    random = np.random.default_rng(3)
    columns, half = random.normal(size=(9, 3)), random.normal(size=(9, 9))
    matrix = half @ half.T + np.eye(9)
    before = matrix.copy(), columns.copy()
    covariance = Covariance.of(matrix)
    white = covariance.white(columns)
    products = columns.T @ np.linalg.inv(matrix) @ columns
    np.testing.assert_allclose(white.T @ white, products, rtol=1e-9)
    assert covariance.log_pdet == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-9)
    np.testing.assert_array_equal(matrix, before[0])
    np.testing.assert_array_equal(columns, before[1])


def test_what_is_drawn_from_the_parts_scatters_by_their_covariance() -> None:
    """Noise, an unknown of each cycle, one of all cycles, and an error that fades."""
    random, draws = np.random.default_rng(4), 200_000
    time, cycle = np.array([0.0, 0.3, 1.5, 0.2]), np.array([1, 1, 1, 2])
    noise, error = np.array([0.3, 0.2, 0.4, 0.3]), np.array([0.5, 1.0, 0.7, 0.6])
    scatter, common = np.array([1.0, -0.5, 0.3, 0.8]), np.array([0.2, 0.4, 0.1, -0.6])
    matrix = low_rank(scatter[:, None], cycle) + low_rank(common[:, None])
    matrix += fading(error, time, cycle)
    add_independent(matrix, noise**2)
    first = random.normal(size=draws)
    errors = [first]
    for apart in np.diff(time[:3]):
        kept = np.exp(-apart)
        errors.append(kept * errors[-1] + np.sqrt(1.0 - kept**2) * random.normal(size=draws))
    errors.append(random.normal(size=draws))  # the other cycle has its own
    of_cycle = random.normal(size=(2, draws))
    drawn = noise[:, None] * random.normal(size=(4, draws)) + error[:, None] * np.array(errors)
    drawn += scatter[:, None] * of_cycle[cycle - 1] + common[:, None] * random.normal(size=draws)
    np.testing.assert_allclose(np.cov(drawn), matrix, atol=0.02)
    white = Covariance.of(matrix).white(drawn)
    np.testing.assert_allclose(np.cov(white), np.eye(4), atol=0.02)


@given(st.lists(st.tuples(st.floats(0.0, 9.0), st.integers(0, 2)), min_size=1, max_size=8))
def test_what_fades_is_a_covariance_wherever_it_is_seen(
    places: list[tuple[float, int]],
) -> None:
    time, group = np.array([at for at, _ in places]), np.array([number for _, number in places])
    matrix = fading(np.ones(len(places)), time, group)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > -1e-12


def coupled(groups: int) -> tuple[CoupledCovariance, np.typing.NDArray[np.float64]]:
    """A covariance of groups of 2, 5, 8, 2 ... residuals with 3 unknowns, and its whole matrix."""
    random = np.random.default_rng(5)
    sizes = [2 + 3 * (number % 3) for number in range(groups)]
    halves = [random.normal(size=(size, size)) for size in sizes]
    matrices = [half @ half.T + np.eye(len(half)) for half in halves]
    moves, half = random.normal(size=(sum(sizes), 3)), random.normal(size=(3, 3))
    prior = half @ half.T
    whole = block_diag(*matrices) + moves @ prior @ moves.T
    return CoupledCovariance.of(matrices, moves, prior), whole


def test_coupled_groups_whiten_as_the_whole_matrix_does() -> None:
    covariance, whole = coupled(7)
    columns = np.random.default_rng(6).normal(size=(len(whole), 4))
    at_once = Covariance.of(whole)
    np.testing.assert_allclose(covariance.white(columns), at_once.white(columns), atol=1e-9)
    assert covariance.log_pdet == pytest.approx(at_once.log_pdet, abs=1e-9)
    variance = np.einsum("sr,rq,sq->s", columns.T, whole, columns.T)
    np.testing.assert_allclose(covariance.sigma(columns.T), np.sqrt(variance), rtol=1e-9)


def test_memory_of_coupled_groups_grows_with_their_number_not_its_square() -> None:
    few, many = (
        sum(part.factor.size for part in covariance.own)
        + sum(part.size for part in (*covariance.moves, *covariance.learned))
        for covariance, _ in map(coupled, (6, 24))
    )
    assert many == 4 * few
