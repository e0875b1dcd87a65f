"""The fit: the data set whose model follows healthy cycles best, and how well they determine it.

Maximum a posteriori by generalised least squares: the type says where a value is to be expected and
how far units differ, the cycles say the rest, each residual weighing what noise, scatter and the
model's own error leave of it. All derivatives come from one run of the bank of hypotheses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from twin.calibration.covariance import Weights, plain, weighted
from twin.calibration.cycles import Both, Cycles
from twin.calibration.line_discrepancy import with_left_out
from twin.calibration.parameters import FREE_IN_MARKET, Free, Space
from twin.calibration.readings import noise_of
from twin.inference.levels import SIGMAS_95
from twin.inference.sensitivities import derivatives, inside, sensitivities
from twin.model.dataset import RIPPLE, DataSet, coefficients, sensor_place
from twin.model.system import Tube
from twin.signals import MBAR, MS, NS, UNUSABLE, Samples

# Tolerances of the rounds. Knees are found and residuals weighed with what the round before found.
ROUNDS = (1e-2, 1e-2, 1e-3)
MOST_STEPS = 8  # in a round
FIRST_SHARE = 0.4  # of the log, for the first round: it has the longest way to go
DETERMINED = 0.5  # of what the type leaves open: what is known better comes from the log
SWITCHING = 0.4  # of the most that the nozzle may be seen early or late, one standard deviation
# s, one standard deviation of when a valve acts from stroke to stroke: edges are known no better.
JITTER = 0.3 * MS
INSIDE = 0.1  # sigmas from a bound, where a search begins at most: on it, it would not move
RISING = 40  # steps over the characteristic, in which suction is looked at
END_PRESSURE = "ejector.end_pressure_mbar"
NEARLY_NOTHING = 0.02  # of the suction capacity, at the deepest pressure of a record
BEST_END = 50.0 * MBAR  # Pa, absolute; single-stage ejectors end at 70 and more
DEEPEST = 0.001  # quantile of a record's rows: no single reading
SPEED_OF_SOUND = 343.0  # m/s
# s through a line whose waves would be late by as much. Chosen on a rig with 2.4 m of hose, told as
# 2.9: there 0.9 ms. With none, what the waves left drew the suction's course off by 14 mbar.
CARRIED = 27e-3
MOST_WORSE = 1.1  # times the cost of the first pressure alone, with a second one
MOST_ROWS = 0.5  # of the usable ones, above which a second pressure is followed
MOST_FACTOR = 10.0  # of the logarithm
BENDS = ("bulge", "skew", "bend_2", "bend_3")

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Round:
    """A round of a fit from afar: how many of the starts go through, on which cycles, how long."""

    starts: int
    share: float  # of the record
    error: float  # Pa, what the model may be off by
    steps: int
    tolerance: float  # of the cost, below which it is done


# All starts are tried on a few cycles, and half of what is left falls behind in each round; what
# they are off by is narrowed with those that remain.
NARROWING = (
    Round(100, 0.3, 5.0 * MBAR, 4, 1e-2),
    Round(6, 0.3, 5.0 * MBAR, 8, 1e-2),
    Round(3, 0.3, 5.0 * MBAR, 15, 1e-2),
    Round(2, 0.3, 1.5 * MBAR, 20, 1e-3),
    Round(2, 0.3, 0.6 * MBAR, 20, 1e-3),
    Round(1, 1.0, 0.6 * MBAR, 40, 1e-4),
)
# Sigmas, beyond which a residual pulls less than its square; below, it is what a fit gets wrong.
ROBUST = 8.0


@dataclass
class Problem:
    """Residuals and their derivatives over coordinates of ``space``, all in sigmas."""

    space: Space
    cycles: Cycles | Both
    weights: Weights

    def residual(self, x: Floats) -> Floats:
        """Residuals of all bins, and how far ``x`` is from what is expected.

        The nozzle switches at a row: between two, what is expected is between theirs.
        """
        n, whole = len(self.space.free), self._whole(x)
        if n == len(x):
            return self._predict(x[:, None])[:, 0]
        after = whole + np.append(np.zeros(n), 1.0 / self._rows)
        share = self._rows * (x[n] - whole[n])
        both: Floats = self._predict(np.stack([whole, after], axis=1)) @ [1.0 - share, share]
        return both

    def jacobian(self, x: Floats) -> Floats:
        """Derivatives of ``residual``."""
        n = len(self.space.free)
        row = np.full(len(x) - n, 1.0 / self._rows)
        steps = np.append(inside(x[:n], self.space.high, self.space.step), row)
        return sensitivities(self._predict, self._whole(x), steps)[1]

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Of the coordinates and of when the nozzle switches."""
        most = self.cycles.most_early / self._rows
        return np.append(self.space.low, -most), np.append(self.space.high, most)

    @property
    def _rows(self) -> float:
        """Rows by which the nozzle switches sooner or later, one standard deviation."""
        return SWITCHING * self.cycles.most_early

    def _whole(self, x: Floats) -> Floats:
        """``x`` with the nozzle switching at the row before."""
        n, whole = len(self.space.free), x.copy()
        whole[n:] = np.floor(x[n:] * self._rows) / self._rows
        return whole

    def _predict(self, points: Floats) -> Floats:
        """Residuals at points, (coordinates, n) to (residuals, n)."""
        n = len(self.space.free)
        moved = [self.space.at(one) for one in points[:n].T]
        early = np.rint(points[n:] * self._rows).astype(int).ravel().tolist()
        off = self.cycles.off(np.stack([coefficients(data) for data in moved], axis=1), early)
        white = np.concatenate([*self.weights.white(off), points])
        if self.space.everywhere:
            return white
        return np.concatenate([white, np.stack([_rising(data) for data in moved], axis=1)])


def _rising(data: DataSet) -> Floats:
    """Penalty (sigmas) where suction would rise with vacuum: no ejector's does.

    It is felt a little before: at a wall that comes without warning, a fit stops.
    """
    steps = np.diff(data.ejector.share(np.linspace(0.0, 1.0, RISING + 1)))
    return (np.hypot(steps, RIPPLE) - steps) / (0.6 * RIPPLE)


def falling(data: DataSet) -> DataSet:
    """``data`` with its characteristic bent no further than suction falls with vacuum.

    The penalty keeps a fit nearly there; a data set must be there.
    """
    x = np.linspace(0.0, 1.0, 101)
    unbent = data.ejector.model_copy(update=dict.fromkeys(BENDS, 0.0))
    straight, steps = np.diff(unbent.share(x)), np.diff(data.ejector.share(x))
    back = steps < 0.0
    share = float(np.min(straight[back] / (straight - steps)[back], initial=1.0))
    bends = {name: share * getattr(data.ejector, name) for name in BENDS}
    return data.model_copy(update={"ejector": data.ejector.model_copy(update=bends)})


@dataclass(frozen=True)
class Fitted:
    """A data set from healthy cycles, and how sure it is."""

    data: DataSet
    free: tuple[Free, ...]
    covariance: Floats  # of the free parameters, in their units
    left_open: Floats  # the same without what the model leaves out: what other logs may show
    prior: Floats  # one standard deviation of each before the log, in its unit
    left: float  # Pa rms that the model is off in the fitted cycles
    scaled: npt.NDArray[np.bool_]  # of which parameters the logarithm is normally distributed
    deepest: float = np.nan  # Pa, to which the record goes; NaN where the type knows what is below

    @property
    def reaches_end(self) -> bool:
        """Whether the record goes down to where the ejector moves nearly nothing any more."""
        ejector, ambient = self.data.ejector, self.data.ambient.pressure_mbar
        end = ejector.end_pressure_mbar
        beyond = max(self.deepest / MBAR - end, 0.0) / (ambient - end)
        return not float(ejector.share(np.array([beyond]))[0]) > NEARLY_NOTHING

    @property
    def spread(self) -> Floats:
        """One standard deviation of each free parameter, in its unit."""
        spread: Floats = np.sqrt(np.diag(self.covariance))
        return spread

    @property
    def determined(self) -> npt.NDArray[np.bool_]:
        """Which parameters the log determines; the others come from the type."""
        known: npt.NDArray[np.bool_] = self.spread < DETERMINED * self.prior
        known[self._number(END_PRESSURE)] &= self.reaches_end
        return known

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter (``table.key``), in its unit.

        What the log does not determine may be nothing, where that can be: a leak. An end pressure
        that the record does not come near is known to be below its deepest: how the characteristic
        goes on from there is nobody's knowledge.
        """
        if name == END_PRESSURE and not self.reaches_end:
            return min(BEST_END, self.deepest) / MBAR, self.deepest / MBAR
        number = self._number(name)
        free, reach = self.free[number], SIGMAS_95 * float(self.spread[number])
        value = free.of(self.data)
        if self.scaled[number] and value > 0.0:
            reach = float(np.hypot(reach / value, SIGMAS_95 * free.model_form))
            factor = float(np.exp(min(reach, MOST_FACTOR)))
            may_be_nothing = free.low == 0.0 and not self.determined[number]
            low = 0.0 if may_be_nothing else max(value / factor, free.low)
            return low, min(value * factor, free.high)
        return max(value - reach, free.low), min(value + reach, free.high)

    def _number(self, name: str) -> int:
        return [free.name for free in self.free].index(name)


def fit(samples: Samples, space: Space, progress: Callable[[str], None]) -> Fitted:
    """Fit the free parameters to healthy cycles of a unit of known type, starting from its data."""
    x, best, noise = np.zeros(len(space.free)), space.data, space.data.sensor.noise_mbar * MBAR
    for turn, tolerance in enumerate(ROUNDS):
        progress(f"fitting, round {turn + 1} of {len(ROUNDS)}")
        rows = round(len(samples) * (FIRST_SHARE if turn == 0 else 1.0))
        cycles = Cycles.as_live(samples[:rows], best)
        weights = weighted(cycles, coefficients(best), noise, fitted=turn > 0)
        problem = Problem(space, cycles, weights)
        x = _solved(problem, x, MOST_STEPS, tolerance)
        best = space.at(x)
    return _fitted(problem, x)


@dataclass(frozen=True)
class _Start:
    """Where a fit from afar has come to from one of its starts."""

    space: Space
    x: Floats
    cost: float = 0.0

    @property
    def data(self) -> DataSet:
        return self.space.at(self.x)


def fit_from_afar(
    samples: Samples,
    guesses: Sequence[DataSet],
    progress: Callable[[str], None],
    free: tuple[Free, ...] = FREE_IN_MARKET,
) -> Fitted:
    """Fit a unit that nobody has seen before, however far from the ``guesses`` it may be.

    Each guess is a start, as a curve has more than one explanation near which a fit can end. What
    the model may be off by begins wide and is narrowed, so that the fit follows the large features
    first; residuals beyond it pull less than their square (a robust loss). No bin's error is taken
    to be another's: what a fit may call scatter from cycle to cycle hides what it gets wrong.

    A second pressure, where most rows have one, is followed from there on: from a guess, two lead
    astray more often than one. It is not where the first is followed less well for it.
    """
    noises = [guesses[0].sensor.noise_mbar * MBAR]
    spaces = [Space.of_market(guess, free) for guess in guesses]
    starts = [_Start(space, np.zeros(len(space.free))) for space in spaces]
    for number, one in enumerate(NARROWING, 1):
        starts = starts[: one.starts]
        progress(f"fitting, round {number} of {len(NARROWING)}: {len(starts)} starts")
        rows = samples[: round(len(samples) * one.share)]
        starts = sorted(
            (_followed(rows, start, one, noises) for start in starts), key=attrgetter("cost")
        )
    best, two = starts[0], noises + second_noise(samples)
    if len(two) > 1:
        progress("following the second pressure as well")
        both = _followed(samples, best, NARROWING[-1], two)
        if _alone(samples, both, noises) < MOST_WORSE * _alone(samples, best, noises):
            best, noises = both, two
        else:
            progress("the second pressure is left out: the first would be followed less well")
    theta = coefficients(best.data)
    problem = _problem(
        samples, best, noises, lambda cycles, noise: weighted(cycles, theta, noise, fitted=True)
    )
    pressure = samples["pressure"][(samples["quality"] & UNUSABLE) == 0]
    deepest = float(np.nanquantile(pressure, DEEPEST))
    return replace(_fitted(problem, best.x), deepest=deepest)


def second_noise(samples: Samples) -> list[float]:
    """Noise (Pa) of a second pressure; empty where too few rows have one to follow it."""
    usable = (samples["quality"] & UNUSABLE) == 0
    there = usable & (samples["pressure_2"] > 0.0)
    if np.count_nonzero(there) <= MOST_ROWS * np.count_nonzero(usable):
        return []
    period = float(np.median(np.diff(samples["time_ns"]))) * NS
    return [noise_of(samples["pressure_2"][there].astype(np.float64), period)]


def _alone(samples: Samples, start: _Start, noises: Sequence[float]) -> float:
    """What is left of the first pressure alone, as a cost."""
    error = NARROWING[-1].error
    problem = _problem(
        samples, start, noises, lambda cycles, noise: plain(cycles, noise, error, _late(start.data))
    )
    return _cost(problem.residual(start.x))


def _cost(residual: Floats) -> float:
    """Of residuals in sigmas; what is far off costs little more than what is off."""
    return float(np.sum(np.log1p(residual**2)))


def _other_end(data: DataSet) -> Literal["port", "vessel"]:
    """The end of the line that the sensor of ``data`` is farther from."""
    return "port" if sensor_place(data) > 0.5 else "vessel"


def _problem(
    samples: Samples,
    start: _Start,
    noises: Sequence[float],
    weigh: Callable[[Cycles, float], Weights],
) -> Problem:
    """To follow the pressure from a start, and a second one where there are two ``noises`` (Pa)."""
    cycles = Cycles.found(samples, start.data)
    weights = weigh(cycles, noises[0])
    if len(noises) == 1:
        return Problem(start.space, cycles, weights)
    second = cycles.of_second(_other_end(start.data)).as_slow(coefficients(start.data))
    weights = weights.followed_by(weigh(second, noises[1]), len(cycles.measured))
    return Problem(start.space, Both(cycles, second), weights)


def _late(data: DataSet) -> float:
    """By how much (s) edges may be early or late: by strokes of valves, and by waves in the line.

    Few nodes carry those.
    A wave that is not much longer than what is between two nodes is late by a share of its way that
    grows with the square of it.
    """
    length = sum(part.length_mm for part in data.system.parts if isinstance(part, Tube))
    through = 1e-3 * length / SPEED_OF_SOUND
    return float(np.hypot(JITTER, through * (through / CARRIED) ** 2))


def _followed(samples: Samples, start: _Start, one: Round, noises: Sequence[float]) -> _Start:
    """Where a round leads from a start."""
    problem = _problem(
        samples,
        start,
        noises,
        lambda cycles, noise: plain(cycles, noise, one.error, _late(start.data)),
    )
    # The last coordinate is how much sooner the nozzle switches than it was seen to.
    x = _solved(problem, np.append(start.x, 0.0), one.steps, one.tolerance, "soft_l1")
    return _Start(start.space, x[:-1], _cost(problem.residual(x)))


def _solved(
    problem: Problem,
    x: Floats,
    steps: int,
    tolerance: float,
    loss: Literal["linear", "soft_l1"] = "linear",
) -> Floats:
    low, high = (bound[: len(x)] for bound in problem.bounds)
    found = least_squares(
        problem.residual,
        np.clip(x, low + INSIDE, high - INSIDE),
        problem.jacobian,
        bounds=(low, high),
        max_nfev=steps,
        xtol=1e-3,
        ftol=tolerance,
        loss=loss,
        f_scale=ROBUST,
    )
    best: Floats = found.x
    return best


def _fitted(problem: Problem, x: Floats) -> Fitted:
    """What the fit found at ``x``, and how sure it is."""
    problem = replace(problem, space=problem.space.on_the_line)
    space, cycles = problem.space, problem.cycles
    x = np.clip(x, space.low, space.high)
    best = DataSet.model_validate(falling(space.at(x)).model_dump())
    ways = space.slopes(x)
    off = cycles.off(np.stack(with_left_out(best), axis=1))
    jacobian = problem.jacobian(x)
    plain = np.asarray(np.linalg.inv(jacobian.T @ jacobian), np.float64)
    covariance = ways @ _with_left_out(plain, jacobian, problem.weights.white(off)) @ ways.T
    prior = np.sqrt(np.diag(ways @ ways.T))
    first = off[: len(cycles.bins.count), 0]
    left = float(np.sqrt(np.average(first**2, weights=cycles.bins.count)))
    left_open = ways @ plain @ ways.T
    return Fitted(best, space.free, covariance, left_open, prior, left, space.scaled)


def _with_left_out(covariance: Floats, jacobian: Floats, white: Sequence[Floats]) -> Floats:
    """Covariance of ``x``: of what residuals scatter, and where what is left out moves it.

    ``white`` are residuals (bins, n) in sigmas: of the fit, then with what the model leaves out.
    """
    all_white = np.concatenate(white)
    _, changes = derivatives(all_white)
    moves = covariance @ jacobian[: len(changes)].T @ changes
    total: Floats = covariance + moves @ moves.T
    return total
