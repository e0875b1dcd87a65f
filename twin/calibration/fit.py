"""The fit: the data set whose model follows healthy cycles best, and how well they determine it.

Maximum a posteriori by generalised least squares: the type says where a value is to be expected and
how far units differ, the cycles say the rest, each residual weighing what noise, scatter and the
model's own error leave of it. All derivatives come from one run of the bank of hypotheses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from twin.calibration.cycles import Cycles
from twin.calibration.left_out import with_left_out
from twin.calibration.parameters import FREE, directions, values, with_values
from twin.calibration.weights import Weights, weighted
from twin.model.dataset import RIPPLE, DataSet, coefficients
from twin.signals import MBAR, Samples

# Tolerances of the rounds. Knees are found and residuals weighed with what the round before found.
ROUNDS = (1e-2, 1e-2, 1e-3)
MOST_STEPS = 8  # in a round
FIRST_SHARE = 0.4  # of the log, for the first round: it has the longest way to go
DETERMINED = 0.5  # of what the type leaves open: what is known better comes from the log
STEP = 0.05  # of a parameter's sigma, for derivatives

Floats = npt.NDArray[np.float64]


@dataclass
class Problem:
    """Residuals and their derivatives over ways to differ from the type's data set, in sigmas."""

    data: DataSet
    cycles: Cycles
    weights: Weights
    _at: Floats | None = None
    _residual: Floats = field(default_factory=lambda: np.empty(0))
    _jacobian: Floats = field(default_factory=lambda: np.empty((0, 0)))

    def data_at(self, x: Floats) -> DataSet:
        """The data set at ``x``, kept within the bounds of each value."""
        low, high = ([getattr(free, end) for free in FREE] for end in ("low", "high"))
        moved = values(self.data) + directions(self.data) @ x
        return with_values(self.data, np.clip(moved, low, high))

    def residual(self, x: Floats) -> Floats:
        """Residuals of all bins, and how far ``x`` is from what is expected."""
        self._evaluate(x)
        return self._residual

    def jacobian(self, x: Floats) -> Floats:
        """Derivatives of ``residual``."""
        self._evaluate(x)
        return self._jacobian

    def _evaluate(self, x: Floats) -> None:
        if self._at is not None and np.array_equal(self._at, x):
            return
        moved = [self.data_at(one) for one in (x, *(x + np.eye(len(x)) * STEP))]
        off = self.cycles.off(np.stack([coefficients(data) for data in moved], axis=1))
        rising = np.stack([_rising(data) for data in moved], axis=1)
        white = np.concatenate([*self.weights.white(off), rising])
        self._at = x.copy()
        self._residual = np.concatenate([white[:, 0], x])
        self._jacobian = np.concatenate([(white[:, 1:] - white[:, :1]) / STEP, np.eye(len(x))])


def _rising(data: DataSet) -> Floats:
    """Penalty (sigmas) where suction would rise with vacuum: no ejector's does."""
    steps = np.diff(data.ejector.share(np.linspace(0.0, 1.0, 41)))
    return np.minimum(steps, 0.0) / (0.1 * RIPPLE)


@dataclass(frozen=True)
class Fitted:
    """A data set from healthy cycles, and how sure it is."""

    data: DataSet
    covariance: Floats  # of the free parameters, in their units
    left_open: Floats  # the same without what the model leaves out: what other logs may show
    prior: Floats  # one standard deviation of each before the log, in its unit
    left: float  # Pa rms that the model is off in the fitted cycles

    @property
    def spread(self) -> Floats:
        """One standard deviation of each free parameter, in its unit."""
        spread: Floats = np.sqrt(np.diag(self.covariance))
        return spread

    @property
    def determined(self) -> npt.NDArray[np.bool_]:
        """Which parameters the log determines; the others come from the type."""
        known: npt.NDArray[np.bool_] = self.spread < DETERMINED * self.prior
        return known

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter (``table.key``), in its unit."""
        number = [free.name for free in FREE].index(name)
        value, reach = FREE[number].of(self.data), 1.96 * float(self.spread[number])
        return value - reach, value + reach


def fit(samples: Samples, data: DataSet, progress: Callable[[str], None]) -> Fitted:
    """Fit the free parameters, starting from and held by ``data``."""
    x, best, noise = np.zeros(len(FREE)), data, data.sensor.noise_mbar * MBAR
    for turn, tolerance in enumerate(ROUNDS):
        progress(f"fitting, round {turn + 1} of {len(ROUNDS)}")
        rows = round(len(samples) * (FIRST_SHARE if turn == 0 else 1.0))
        cycles = Cycles.found(samples[:rows], best)
        weights = weighted(cycles, coefficients(best), noise, fitted=turn > 0)
        problem = Problem(data, cycles, weights)
        found = least_squares(
            problem.residual,
            x,
            problem.jacobian,
            max_nfev=MOST_STEPS,
            xtol=1e-3,
            ftol=tolerance,
        )
        x, best = found.x, problem.data_at(found.x)
    ways = directions(data)
    off = cycles.off(np.stack(with_left_out(best), axis=1))
    jacobian = problem.jacobian(x)
    plain = np.asarray(np.linalg.inv(jacobian.T @ jacobian), np.float64)
    covariance = ways @ _with_left_out(plain, jacobian, weights.white(off)) @ ways.T
    prior = np.sqrt(np.diag(ways @ ways.T))
    left = float(np.sqrt(np.average(off[:, 0] ** 2, weights=cycles.bins.count)))
    return Fitted(
        DataSet.model_validate(best.model_dump()), covariance, ways @ plain @ ways.T, prior, left
    )


def _with_left_out(covariance: Floats, jacobian: Floats, white: Sequence[Floats]) -> Floats:
    """Covariance of ``x``: of what residuals scatter, and where what is left out moves it.

    ``white`` are residuals (bins, n) in sigmas: of the fit, then with what the model leaves out.
    """
    all_white = np.concatenate(white)
    changes = all_white[:, 1:] - all_white[:, :1]
    moves = covariance @ jacobian[: len(changes)].T @ changes
    total: Floats = covariance + moves @ moves.T
    return total
