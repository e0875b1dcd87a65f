"""Covariances of residuals from their parts, and whitening by them.

Noise is independent: it is on the diagonal. A few unknowns (scatter, parameters that calibration
left open) give a part of low rank. The correlation of the model's own error decays with time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dtrtrs

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Covariance:
    """A positive definite covariance, stored as its lower Cholesky ``factor``."""

    factor: Floats

    @classmethod
    def of(cls, matrix: Floats) -> "Covariance":
        """Factor a matrix. Raises LinAlgError if it is not positive definite."""
        return cls(np.linalg.cholesky(matrix.astype(np.float64)))  # pyright: ignore[reportArgumentType]

    @property
    def log_pdet(self) -> float:
        """Logarithm of the determinant: a likelihood's penalty for a wide covariance."""
        return 2.0 * float(np.log(np.diag(self.factor)).sum())

    def white(self, columns: Floats) -> Floats:
        """Whitened columns of residuals: each residual has sigma 1, all are independent."""
        # The wrapper solve_triangular would double the time: some 80 µs more for each cycle. The
        # transposed factor is in LAPACK's order: it is not copied.
        white: Floats = dtrtrs(self.factor.T, columns, lower=0, trans=1)[0]
        return white


@dataclass(frozen=True)
class CoupledCovariance:
    """A covariance of groups of residuals, such as cycles, with some unknowns in common.

    Its lower Cholesky factor is that of the whole matrix, but it is stored by groups. So memory and
    time grow with the number of groups, not with its square and cube.
    """

    own: tuple[Covariance, ...]  # of each group, given all groups before it
    moves: tuple[Floats, ...]  # of each group by the unknowns, (residuals, unknowns)
    learned: tuple[Floats, ...]  # whitened covariance with the unknowns, (residuals, unknowns)

    @classmethod
    def of(cls, matrices: Sequence[Floats], moves: Floats, prior: Floats) -> "CoupledCovariance":
        """Factor the sum of ``moves @ prior @ moves.T`` and the matrix of each group.

        ``moves`` are (residuals, unknowns), the groups in order; ``prior`` is the covariance of the
        unknowns. Raises LinAlgError if the sum is not positive definite.
        """
        ends = np.cumsum([len(matrix) for matrix in matrices], dtype=np.int64)
        groups = tuple(np.split(moves, ends)[: len(matrices)])
        own, learned, unknown = list[Covariance](), list[Floats](), prior
        for matrix, group in zip(matrices, groups, strict=True):
            shared = group @ unknown
            own.append(Covariance.of(matrix + shared @ group.T))
            learned.append(own[-1].white(shared))
            unknown = unknown - learned[-1].T @ learned[-1]
        return cls(tuple(own), groups, tuple(learned))

    @property
    def log_pdet(self) -> float:
        """Logarithm of the determinant: a likelihood's penalty for a wide covariance."""
        return sum(covariance.log_pdet for covariance in self.own)

    def white(self, columns: Floats) -> Floats:
        """Whitened columns of residuals: each residual has sigma 1, all are independent."""
        white, first = np.empty(columns.shape), 0
        known = np.zeros((self.moves[0].shape[1], columns.shape[1])) if self.moves else np.empty(0)
        for covariance, moves, learned in zip(self.own, self.moves, self.learned, strict=True):
            rows = slice(first, first + len(moves))
            white[rows] = covariance.white(columns[rows] - moves @ known)
            known += learned.T @ white[rows]
            first = rows.stop
        return white

    def sigma(self, shares: Floats) -> Floats:
        """One sigma of weighted sums of the residuals, from (sums, residuals)."""
        variance, last = np.zeros(len(shares)), shares.shape[1]
        later = np.zeros((len(shares), self.moves[0].shape[1])) if self.moves else np.empty(0)
        parts = list(zip(self.own, self.moves, self.learned, strict=True))
        for covariance, moves, learned in reversed(parts):
            part = shares[:, last - len(moves) : last]
            variance += np.sum((part @ covariance.factor + later @ learned.T) ** 2, axis=1)
            later += part @ moves
            last -= len(moves)
        sigma: Floats = np.sqrt(variance)
        return sigma


def low_rank(moves: Floats, group: Ints | None = None) -> Floats:
    """Covariance from ``moves``: changes by one sigma of each unknown, (residuals, unknowns).

    The unknowns are common to all residuals, or to those of the same ``group``.
    """
    covariance: Floats = moves @ moves.T
    return covariance if group is None else covariance * (group[:, None] == group)


def fading(sigma: Floats, time: Floats, group: Ints) -> Floats:
    """Covariance of an error with ``sigma`` at each time, independent between groups.

    Its correlation decays exponentially with a time constant of 1 in the unit of ``time``.
    """
    correlation = np.exp(-np.abs(time[:, None] - time)) * (group[:, None] == group)
    covariance: Floats = np.outer(sigma, sigma) * correlation
    return covariance


def add_independent(covariance: Floats, variance: Floats) -> None:
    """Add the independent variance of each residual, in place."""
    np.einsum("ii->i", covariance)[:] += variance  # a view of the diagonal
