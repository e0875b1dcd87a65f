"""Covariances of residuals from their parts, and whitening by them.

Noise is independent: it is on the diagonal. A few unknowns (scatter, parameters that calibration
left open) give a part of low rank. The correlation of the model's own error decays with time.
"""

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
        return cls(np.linalg.cholesky(matrix.astype(np.float64)))

    @property
    def log_pdet(self) -> float:
        """Logarithm of the determinant: a likelihood's penalty for a wide covariance."""
        return 2.0 * float(np.log(np.diag(self.factor)).sum())

    def white(self, columns: Floats) -> Floats:
        """Whitened columns of residuals: each residual has sigma 1, all are independent."""
        # The wrapper solve_triangular would double the time: some 80 µs more for each cycle.
        white: Floats = dtrtrs(self.factor, columns, lower=1)[0]
        return white


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
