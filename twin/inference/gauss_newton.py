"""Many small least-squares fits side by side: damped Gauss-Newton within bounds.

`scipy.optimize.least_squares` fits one problem and asks for its residuals point by point; the
calibration uses it. The model's bank answers for dozens of points in one run, so the diagnosis
moves all of its fits by one step with each run.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from scipy.optimize import lsq_linear

from twin.inference.covariance import Floats
from twin.inference.sensitivities import derivatives, inside, points

MOST_ROUNDS = 10
LONGEST = 6.0  # typical sizes that one round may move
CONVERGED = 0.05  # chi-square that one more round would gain, in times what a residual has
BACK = 0.3  # of a step that made it worse
NEARLY_STILL = 0.01  # typical sizes: a step back as short as that ends a fit
DAMPING = 1e-4  # of a typical size: where nothing determines a size, it stays


Fit = TypeVar("Fit", bound="Descent")


@dataclass
class Descent:
    """One fit on its way: the best point so far, and the one to look at next.

    Sizes are in typical ones; residuals are whitened.
    """

    low: Floats
    high: Floats
    x: Floats
    chi2: float = np.inf
    residual: Floats = field(default_factory=lambda: np.empty(0))
    jacobian: Floats = field(default_factory=lambda: np.empty((0, 0)))
    gained: float = np.inf  # in chi-square, by the last step that helped

    def __post_init__(self) -> None:
        self.x = np.clip(self.x, self.low, self.high)
        self.next, self.done = self.x, not len(self.x)

    @property
    def scale(self) -> float:
        """Chi-square per residual, 1 where it is less: what is left is as wide as that."""
        return max(self.chi2 / max(len(self.residual), 1), 1.0)

    @property
    def information(self) -> Floats:
        """Fisher's information of the sizes; a little where nothing depends on one."""
        return information(self.jacobian)

    def asked(self) -> Floats:
        """The next point, and one beside it for each size, (points, sizes)."""
        return points(self.next, self._moves()).T

    def take(self, white: Floats) -> None:
        """Take the residuals at the points that were ``asked`` for; choose the point after it."""
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
        pull = q.T @ residual
        low = np.maximum(self.low - self.x, -LONGEST) - 1e-9
        high = np.minimum(self.high - self.x, LONGEST) + 1e-9
        r = np.concatenate([r, DAMPING * np.eye(len(low))])
        step = lsq_linear(r, -np.concatenate([pull, np.zeros(len(low))]), (low, high)).x
        gain = float(pull @ pull - np.sum((pull + r[: len(low)] @ step) ** 2))
        self.next = np.clip(self.x + step, self.low, self.high)
        self.done = gain < CONVERGED * self.scale

    def _moves(self) -> Floats:
        """Steps for derivatives at the next point, one per size, away from the nearer bound."""
        return inside(self.next, self.high)


def descend(
    fits: Sequence[Fit],
    residuals: Callable[[Sequence[tuple[Fit, Floats]]], Floats],
    give_up: Callable[[int], None],
) -> None:
    """Move fits until they are done, in place.

    ``residuals`` are those of fits at points, (residuals, points), in sigmas. Before each round,
    by its number, ``give_up`` may end some.
    """
    for turn in range(MOST_ROUNDS):
        give_up(turn)
        going = [fit for fit in fits if not fit.done]
        if not going:
            return
        asked = [fit.asked() for fit in going]
        each = [(fit, x) for fit, some in zip(going, asked, strict=True) for x in some]
        ends = np.cumsum([len(some) for some in asked])[:-1]
        for fit, white in zip(going, np.split(residuals(each), ends, axis=1), strict=True):
            fit.take(white)


def information(jacobian: Floats) -> Floats:
    """Fisher's information of whitened residuals; a little where nothing depends on a size."""
    found: Floats = jacobian.T @ jacobian + 1e-6 * np.eye(jacobian.shape[1])
    return found
