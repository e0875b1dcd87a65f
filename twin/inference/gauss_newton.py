"""Many small least-squares fits side by side: damped Gauss-Newton within bounds.

`scipy.optimize.least_squares` fits one problem and evaluates its residuals point by point; the
calibration uses it. The model's bank evaluates dozens of points in one run, so the diagnosis
moves all of its fits by one step with each run.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from twin.inference.sensitivities import derivatives, inside, points
from twin.inference.whitening import Floats

MOST_ROUNDS = 10
LONGEST = 6.0  # typical sizes: the longest step of one round
CONVERGED = 0.05  # a fit ends if a round would gain less chi-square, in multiples of ``scale``
BACK = 0.3  # share of a step that is kept if the step made the fit worse
NEARLY_STILL = 0.01  # typical sizes: a shorter step ends a fit that it makes worse
DAMPING = 1e-4  # of a typical size: a size that the data do not determine stays


Fit = TypeVar("Fit", bound="Descent")


@dataclass
class Descent:
    """One fit in progress: the best point so far, and the next one to evaluate.

    Sizes are in multiples of typical ones; residuals are whitened.
    """

    low: Floats
    high: Floats
    x: Floats
    chi2: float = np.inf
    residual: Floats = field(default_factory=lambda: np.empty(0))
    jacobian: Floats = field(default_factory=lambda: np.empty((0, 0)))
    gained: float = np.inf  # chi-square that the last successful step gained

    def __post_init__(self) -> None:
        self.x = np.clip(self.x, self.low, self.high)
        self.next, self.done = self.x, not len(self.x)

    @property
    def scale(self) -> float:
        """Chi-square per residual, at least 1: the variance of the whitened residuals."""
        return max(self.chi2 / max(len(self.residual), 1), 1.0)

    @property
    def information(self) -> Floats:
        """Fisher's information of the sizes, slightly regularised."""
        return information(self.jacobian)

    def asked(self) -> Floats:
        """The next point, then one with each size moved, (points, sizes)."""
        return points(self.next, self._moves()).T

    def take(self, white: Floats) -> None:
        """Take the residuals at the points of ``asked``, and choose the next point."""
        residual, jacobian = derivatives(white, self._moves())
        chi2 = float(residual @ residual)
        if not chi2 < self.chi2:
            back = self.x + BACK * (self.next - self.x)
            self.done = bool(np.abs(self.next - self.x).max(initial=0.0) < NEARLY_STILL)
            self.next = back
            return
        self.gained = self.chi2 - chi2
        self.x, self.chi2, self.residual, self.jacobian = self.next, chi2, residual, jacobian
        q, r = np.linalg.qr(self.jacobian)
        projection = q.T @ residual
        low = np.maximum(self.low - self.x, -LONGEST) - 1e-9
        high = np.minimum(self.high - self.x, LONGEST) + 1e-9
        r = np.concatenate([r, DAMPING * np.eye(len(low))])
        from scipy.optimize import lsq_linear  # noqa: PLC0415 - a start needs no optimizer

        step = lsq_linear(r, -np.concatenate([projection, np.zeros(len(low))]), (low, high)).x
        gain = float(projection @ projection - np.sum((projection + r[: len(low)] @ step) ** 2))
        self.next = np.clip(self.x + step, self.low, self.high)
        self.done = gain < CONVERGED * self.scale

    def _moves(self) -> Floats:
        """Steps for derivatives at the next point, one per size, within the upper bounds."""
        return inside(self.next, self.high)


def descend(
    fits: Sequence[Fit],
    residuals: Callable[[Sequence[tuple[Fit, Floats]]], Floats],
    give_up: Callable[[int], None],
) -> None:
    """Move fits until they are done, in place.

    ``residuals`` evaluates fits at points: (residuals, points), in sigmas. ``give_up`` gets the
    number of each round before it begins, and may end some fits.
    """
    for round_number in range(MOST_ROUNDS):
        give_up(round_number)
        active = [fit for fit in fits if not fit.done]
        if not active:
            return
        point_sets = [fit.asked() for fit in active]
        requests = [
            (fit, x) for fit, fit_points in zip(active, point_sets, strict=True) for x in fit_points
        ]
        ends = np.cumsum([len(fit_points) for fit_points in point_sets])[:-1]
        for fit, white in zip(active, np.split(residuals(requests), ends, axis=1), strict=True):
            fit.take(white)


def information(jacobian: Floats) -> Floats:
    """Fisher's information of whitened residuals, slightly regularised."""
    matrix: Floats = jacobian.T @ jacobian + 1e-6 * np.eye(jacobian.shape[1])
    return matrix
