"""What residuals have in common: covariances from their parts, and whitening by them.

Noise is independent and on the diagonal. What a residual moves by with one sigma of a few unknowns
(scatter, what calibration left open) is of low rank. What a model gets wrong fades with time.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dtrtrs

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Covariance:
    """A positive definite covariance by its lower Cholesky ``factor``."""

    factor: Floats

    @classmethod
    def of(cls, matrix: Floats) -> "Covariance":
        """That of a matrix. Raises LinAlgError where it is not positive definite."""
        return cls(np.linalg.cholesky(matrix.astype(np.float64)))

    @property
    def log_pdet(self) -> float:
        """Logarithm of the determinant: what wide covariances cost a likelihood."""
        return 2.0 * float(np.log(np.diag(self.factor)).sum())

    def white(self, columns: Floats) -> Floats:
        """Columns of residuals beside each other, each of sigma 1 and all independent."""
        # Its wrapper, solve_triangular, takes as long again: some 80 µs for each cycle.
        white: Floats = dtrtrs(self.factor, columns, lower=1)[0]
        return white


def low_rank(moves: Floats, group: Ints | None = None) -> Floats:
    """Of residuals that move by so much with one sigma of each unknown, (residuals, unknowns).

    Unknowns are the same for all, or others for each ``group``.
    """
    covariance: Floats = moves @ moves.T
    return covariance if group is None else covariance * (group[:, None] == group)


def fading(sigma: Floats, time: Floats, group: Ints) -> Floats:
    """Of what has a ``sigma`` at each time, goes on for about 1 of it, and differs by ``group``."""
    alike = np.exp(-np.abs(time[:, None] - time)) * (group[:, None] == group)
    covariance: Floats = np.outer(sigma, sigma) * alike
    return covariance


def add_independent(covariance: Floats, variance: Floats) -> None:
    """Add what varies in each residual by itself, in place."""
    np.einsum("ii->i", covariance)[:] += variance  # a view of the diagonal
