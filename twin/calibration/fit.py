"""The fit: the data set whose model follows healthy cycles best, and how well they determine it.

Maximum a posteriori by generalised least squares. The type gives the prior: expected values and
how far units differ. Residuals are whitened by noise, scatter and the model's own error. All
derivatives come from one run of the bank of hypotheses.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from twin.calibration.cycles import Both, Cycles
from twin.calibration.line_discrepancy import with_left_out
from twin.calibration.parameters import FREE_IN_MARKET, Free, Space, values
from twin.calibration.readings import noise_of
from twin.calibration.residual_covariance import CycleWhitener, plain, weighted
from twin.inference.levels import SIGMAS_95
from twin.inference.sensitivities import derivatives, inside, sensitivities
from twin.model.air import orifice
from twin.model.dataset import RIPPLE, DataSet, coefficients, sensor_place
from twin.model.parts import Tube
from twin.monitor.uncertain_data import both_sides
from twin.quality import UNUSABLE
from twin.signals import MBAR, MS, NS, Samples

# Tolerances of the rounds. Each round uses breakpoints and weights by the fit of the round before.
ROUNDS = (1e-2, 1e-2, 1e-3)
MOST_STEPS = 8  # in a round
FIRST_SHARE = 0.4  # of the log, for the first round, which takes the most steps
DETERMINED = 0.5  # of the prior sigma: a parameter with a smaller one is determined by the log
SWITCHING = 0.4  # sigma of the nozzle's time, over the most that it may be seen early or late
# s, sigma of a valve's delay from stroke to stroke: it limits how well edges are known.
JITTER = 0.3 * MS
INSIDE = 0.1  # sigmas: least distance of a search's start from a bound; on it, it would not move
RISING = 40  # steps over the characteristic in which a rise is penalised
END_PRESSURE = "ejector.end_pressure_mbar"
NEARLY_NOTHING = 0.02  # of the suction capacity: a record with less flow reaches the end pressure
BEST_END = 50.0 * MBAR  # Pa, absolute; single-stage ejectors end at 70 and more
# Share of the end pressure that an ejector may have instead, if it is above GOOD_END (Pa,
# absolute), which a good single-stage ejector reaches. Chosen: one sigma of the market.
BETTER, GOOD_END = 0.6, 100.0 * MBAR
LEAST_MORE = 0.03  # of the suction capacity: a leak that is larger by less changes no answer
DEEPEST = 0.001  # quantile of a record's pressures that counts as its deepest
SPEED_OF_SOUND = 343.0  # m/s
# s, travel time in a line at which waves are late by as much. Chosen on a rig with 2.4 m of hose,
# configured as 2.9 m: 0.9 ms there. Without it, the waves' residuals shifted the suction's course
# by 14 mbar.
CARRIED = 27e-3
MOST_WORSE = 1.1  # factor by which following a second pressure may raise the cost of the first
MOST_ROWS = 0.5  # share of usable rows above which a second pressure is followed
MOST_FACTOR = 10.0  # of the logarithm: the widest half interval
BENDS = ("bulge", "skew", "bend_2", "bend_3")

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Round:
    """A round of a fit from afar: number of starts, share of the record, limits of the search."""

    starts: int
    share: float  # of the record
    error: float  # Pa, sigma of the model's error
    steps: int
    tolerance: float  # relative change of the cost that ends a search


# All starts are tried on a few cycles, and about half of them drop out in each round. The model's
# error is narrowed for those that remain.
NARROWING = (
    Round(100, 0.3, 5.0 * MBAR, 4, 1e-2),
    Round(6, 0.3, 5.0 * MBAR, 8, 1e-2),
    Round(3, 0.3, 5.0 * MBAR, 15, 1e-2),
    Round(2, 0.3, 1.5 * MBAR, 20, 1e-3),
    Round(2, 0.3, 0.6 * MBAR, 20, 1e-3),
    Round(1, 1.0, 0.6 * MBAR, 40, 1e-4),
)
# The end of that, once more from its result: with a wide error a search leaves a local end.
AGAIN = NARROWING[3:]
# Most that one sigma of the parameters may raise chi-square, and halvings until it does. A linear
# model rises by 1 at most; chosen: one that bends may rise by as much as two sigmas of that.
MOST_RISE, MOST_HALVINGS = 4.0, 8
# For another explanation of the record, from a start near it.
WITH_LEAK = Round(1, 0.3, 0.6 * MBAR, 25, 1e-4)
# Sigmas beyond which the robust loss grows more slowly than the square of a residual.
ROBUST = 8.0


@dataclass
class Problem:
    """Residuals and their derivatives over coordinates of ``space``, all in sigmas."""

    space: Space
    cycles: Cycles | Both
    weights: CycleWhitener

    def residual(self, x: Floats) -> Floats:
        """Residuals of all bins, and distances of ``x`` from the prior.

        The nozzle switches at a row: between two rows, residuals are interpolated.
        """
        n, whole_rows = len(self.space.free), self._whole(x)
        if n == len(x):
            return self._predict(x[:, None])[:, 0]
        next_rows = whole_rows + np.append(np.zeros(n), 1.0 / self._rows)
        share = self._rows * (x[n] - whole_rows[n])
        interpolated: Floats = self._predict(np.stack([whole_rows, next_rows], axis=1)) @ [
            1.0 - share,
            share,
        ]
        return interpolated

    def jacobian(self, x: Floats) -> Floats:
        """Derivatives of ``residual``."""
        n = len(self.space.free)
        row = np.full(len(x) - n, 1.0 / self._rows)
        steps = np.append(inside(x[:n], self.space.high, self.space.step), row)
        return sensitivities(self._predict, self._whole(x), steps)[1]

    def jacobian_both_ways(self, x: Floats) -> Floats:
        """Mean of the derivatives of ``residual`` forwards and backwards, without nozzle's time.

        Where a part just fails to reach its stop, the model has a kink: one side alone shows
        nothing. Next to a bound there is one side.
        """
        forwards = inside(x, self.space.high, self.space.step)
        backwards = np.where(x - self.space.step >= self.space.low, -self.space.step, forwards)
        sides = [sensitivities(self._predict, x, steps)[1] for steps in (forwards, backwards)]
        return np.asarray(np.mean(sides, axis=0), np.float64)

    def misfit(self, datasets: Sequence[DataSet]) -> Floats:
        """Chi-square of the record by each data set, without the prior."""
        residuals = self.cycles.residuals(np.stack([*map(coefficients, datasets)], axis=1))
        chi2: Floats = np.sum(np.concatenate(self.weights.white(residuals)) ** 2, axis=0)
        return chi2

    def most_misfit(self, least: float) -> float:
        """Chi-square up to which a data set fits as well as the best one, with ``least``."""
        residual_count = sum(len(rows) for rows, _ in self.weights.parts)
        return least + MOST_RISE * max(least / residual_count, 1.0)

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper bounds of the coordinates, the nozzle's time last."""
        most = self.cycles.most_early / self._rows
        return np.append(self.space.low, -most), np.append(self.space.high, most)

    @property
    def _rows(self) -> float:
        """One sigma of the time at which the nozzle switches, in rows."""
        return SWITCHING * self.cycles.most_early

    def _whole(self, x: Floats) -> Floats:
        """``x`` with the nozzle switching at the row before."""
        n, rounded = len(self.space.free), x.copy()
        rounded[n:] = np.floor(x[n:] * self._rows) / self._rows
        return rounded

    def _predict(self, points: Floats) -> Floats:
        """Residuals at points, (coordinates, n) to (residuals, n)."""
        n = len(self.space.free)
        moved = [self.space.at(point) for point in points[:n].T]
        early = np.rint(points[n:] * self._rows).astype(int).ravel().tolist()
        residuals = self.cycles.residuals(
            np.stack([coefficients(data) for data in moved], axis=1), early
        )
        white = np.concatenate([*self.weights.white(residuals), points])
        if self.space.everywhere:
            return white
        return np.concatenate([white, np.stack([_rising(data) for data in moved], axis=1)])


def _rising(data: DataSet) -> Floats:
    """Penalty (sigmas) where suction would rise with vacuum: no ejector's does.

    It sets in gradually: a fit would stop at a hard wall.
    """
    steps = np.diff(data.ejector.share(np.linspace(0.0, 1.0, RISING + 1)))
    return (np.hypot(steps, RIPPLE) - steps) / (0.6 * RIPPLE)


def falling(data: DataSet) -> DataSet:
    """``data`` with bends reduced until suction falls with vacuum everywhere.

    The penalty only keeps a fit close to that; a data set must fulfil it.
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
    # Factor of the covariance without the model's discrepancy: other logs may narrow it.
    factor: Floats
    prior: Floats  # sigma of each before the log, in its unit
    left: float  # Pa rms of the residual in the fitted cycles
    scaled: npt.NDArray[np.bool_]  # parameters whose logarithm is normally distributed
    deepest: float = np.nan  # Pa, lowest pressure of the record; NaN if the type is known
    leaky: DataSet | None = None  # of an ejector with more suction and leak, if it fits as well

    @property
    def reaches_end(self) -> bool:
        """Whether the record goes down to where the ejector has nearly no suction."""
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
        is_determined: npt.NDArray[np.bool_] = self.spread < DETERMINED * self.prior
        if self.leaky:
            apart = np.abs(values(self.leaky, self.free) - values(self.data, self.free))
            is_determined &= apart < DETERMINED * self.prior
        is_determined[self._number(END_PRESSURE)] &= self.reaches_end
        return is_determined

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter (``table.key``), in its unit.

        A parameter that the log does not determine may be zero if its bounds allow that, as a leak
        may. Flows and volumes are at most as exact as the volumes that were told. If the record
        does not come near the end pressure, that is only known to lie below the deepest pressure:
        the record does not show how the characteristic continues. Where more suction and more leak
        fit as well, the interval holds their values, and the best end pressure of the market.
        """
        low, high = self._near_best(name)
        if self.leaky is None:
            return low, high
        value = self.free[self._number(name)].of(self.leaky)
        least = BEST_END / MBAR if name == END_PRESSURE else value
        return min(low, value, least), max(high, value)

    def _near_best(self, name: str) -> tuple[float, float]:
        """95 % interval by the neighbourhood of the best fit."""
        if name == END_PRESSURE and not self.reaches_end:
            return min(BEST_END, self.deepest) / MBAR, self.deepest / MBAR
        number = self._number(name)
        free, reach = self.free[number], SIGMAS_95 * float(self.spread[number])
        value = free.of(self.data)
        told = float(np.log(self.data.system.volumes_within_factor)) * free.scales_with_volumes
        if self.scaled[number] and value > 0.0:
            reach = math.hypot(reach / value, SIGMAS_95 * free.model_form, told)
            factor = float(np.exp(min(reach, MOST_FACTOR)))
            may_be_nothing = free.low == 0.0 and not self.determined[number]
            low = 0.0 if may_be_nothing else max(value / factor, free.low)
            return low, min(value * factor, free.high)
        reach = math.hypot(reach, told * value)
        return max(value - reach, free.low), min(value + reach, free.high)

    def _number(self, name: str) -> int:
        return [free.name for free in self.free].index(name)


def fit(samples: Samples, space: Space, progress: Callable[[str], None]) -> Fitted:
    """Fit the free parameters to healthy cycles of a unit of known type, starting from its data."""
    x, best = np.zeros(len(space.free)), space.data
    noise = best.sensor.noise_in_means() * MBAR
    for round_number, tolerance in enumerate(ROUNDS):
        progress(f"fitting, round {round_number + 1} of {len(ROUNDS)}")
        rows = round(len(samples) * (FIRST_SHARE if round_number == 0 else 1.0))
        cycles = Cycles.as_live(samples[:rows], best)
        weights = weighted(cycles, coefficients(best), noise, fitted=round_number > 0)
        problem = Problem(space, cycles, weights)
        x = _solved(problem, x, MOST_STEPS, tolerance)
        best = space.at(x)
    return _fitted(problem, x)  # pyright: ignore[reportPossiblyUnboundVariable] - there are rounds


@dataclass(frozen=True)
class _Start:
    """State of a fit from afar from one of its starts."""

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
    """Fit a unit of unknown type, however far from the ``guesses`` it may be.

    Each guess is a start, as a curve has several local explanations at which a fit can end. The
    model's error begins wide and is narrowed, so that the fit follows the large features first;
    residuals beyond it have a robust loss. Errors of bins are independent: a fit could otherwise
    hide its errors as scatter from cycle to cycle.

    A second pressure is followed afterwards, if most rows have one: from a guess, two pressures
    mislead a fit more often than one. It is left out if the first is then followed less well.
    """
    noises = [guesses[0].sensor.noise_in_means() * MBAR]
    spaces = [Space.of_market(guess, free) for guess in guesses]
    starts = [_Start(space, np.zeros(len(space.free))) for space in spaces]
    for number, fit_round in enumerate(NARROWING, 1):
        starts = _kept(starts, fit_round.starts)
        progress(f"fitting, round {number} of {len(NARROWING)}: {len(starts)} starts")
        rows = samples[: round(len(samples) * fit_round.share)]
        starts = sorted(
            (_followed(rows, start, fit_round, noises) for start in starts), key=attrgetter("cost")
        )
    best = _again(samples, starts[0], noises, progress)
    both_noises = noises + second_noise(samples)
    if len(both_noises) > 1:
        progress("following the second pressure as well")
        with_second = _followed(samples, best, NARROWING[-1], both_noises)
        if _alone(samples, with_second, noises) < MOST_WORSE * _alone(samples, best, noises):
            best, noises = with_second, both_noises
        else:
            progress("the second pressure is left out: the first would be followed less well")
    theta = coefficients(best.data)
    problem = _problem(
        samples, best, noises, lambda cycles, noise: weighted(cycles, theta, noise, fitted=True)
    )
    pressure = samples["pressure"][(samples["quality"] & UNUSABLE) == 0]
    deepest = float(np.nanquantile(pressure, DEEPEST))
    fitted = replace(_fitted(problem, best.x), deepest=deepest)
    progress("asking whether the record tells suction from leak")
    return replace(fitted, leaky=_leaky(samples, problem, fitted, noises))


def _leaky(
    samples: Samples, problem: Problem, fitted: Fitted, noises: Sequence[float]
) -> DataSet | None:
    """Data of an ejector with a better end pressure and a larger leak that fit as well, or None.

    While the nozzle runs, a record shows only the difference of suction and leak. The leak shows
    alone where the nozzle is off and the system is evacuated.
    """
    guess = with_more_leak(fitted.data, fitted.deepest)
    if guess is None:
        return None
    space = Space.of_market(guess, problem.space.free)
    start = _followed(samples, _Start(space, np.zeros(len(space.free))), WITH_LEAK, noises)
    leaky = falling(start.data)
    chi2 = problem.misfit([fitted.data, leaky])
    has_more = leaky.system.leak_sl_min - fitted.data.system.leak_sl_min > LEAST_MORE * (
        leaky.ejector.suction_capacity_sl_min
    )
    return leaky if has_more and chi2[1] <= problem.most_misfit(float(chi2[0])) else None


def with_more_leak(data: DataSet, deepest: float) -> DataSet | None:
    """``data`` with a BETTER end pressure, and leak and bends for nearly the same net flow.

    None if the end pressure is good already. ``deepest`` (Pa) is the lowest pressure in use.
    """
    ejector, system, ambient = data.ejector, data.system, data.ambient.pressure_mbar
    capacity, end = ejector.suction_capacity_sl_min, ejector.end_pressure_mbar
    if end < GOOD_END / MBAR:
        return None
    pressure, better_end = np.linspace(max(deepest / MBAR, end), ambient, RISING + 1), BETTER * end
    as_found = (pressure - end) / (ambient - end)
    better = (pressure - better_end) / (ambient - better_end)
    ratios = (pressure / ambient).tolist()
    leaking = np.array([orifice(ratio, system.leak_critical_ratio)[0] for ratio in ratios])
    net = capacity * ejector.share(as_found) - system.leak_sl_min * leaking
    leak = float((capacity * ejector.share(better) - net)[0] / leaking[0])
    unbent = ejector.model_copy(update=dict.fromkeys(BENDS, 0.0))
    columns = (
        (1.0 - ejector.kink)
        * (better * (1.0 - better))[:, None]
        * np.vander(better, len(BENDS), increasing=True)
    )
    target = (net + leak * leaking) / capacity - unbent.share(better)
    bends = dict(zip(BENDS, np.linalg.lstsq(columns, target)[0].tolist(), strict=True))
    return falling(
        data.model_copy(
            update={
                "ejector": ejector.model_copy(update={"end_pressure_mbar": better_end} | bends),
                "system": system.model_copy(update={"leak_sl_min": leak}),
            }
        )
    )


def _kept(starts: Sequence[_Start], count: int) -> list[_Start]:
    """The ``count`` best of ``starts``, and among two or more the best by each way a part leaves.

    No search turns one way into the other, and early rounds hardly tell them apart.
    """
    if count < 2:
        return list(starts[:count])
    ways = [start.data.system.part_leaves for start in starts]
    best = [ways.index(way) for way in dict.fromkeys(ways)]
    others = [number for number in range(len(starts)) if number not in best]
    return [starts[number] for number in sorted((best + others)[:count])]


def _again(
    samples: Samples, best: _Start, noises: Sequence[float], progress: Callable[[str], None]
) -> _Start:
    """The better of ``best`` and of where its last rounds end if they begin from it."""
    progress("fitting again from the result")
    again = best
    for fit_round in AGAIN:
        rows = samples[: round(len(samples) * fit_round.share)]
        again = _followed(rows, again, fit_round, noises)
    return min(best, again, key=attrgetter("cost"))


def second_noise(samples: Samples) -> list[float]:
    """Noise (Pa) of a second pressure; empty if too few rows have one."""
    usable = (samples["quality"] & UNUSABLE) == 0
    has_second = usable & (samples["pressure_2"] > 0.0)
    if np.count_nonzero(has_second) <= MOST_ROWS * np.count_nonzero(usable):
        return []
    period = float(np.median(np.diff(samples["time_ns"]))) * NS
    return [noise_of(samples["pressure_2"][has_second].astype(np.float64), period)]


def _alone(samples: Samples, start: _Start, noises: Sequence[float]) -> float:
    """Cost of the residuals of the first pressure alone."""
    error = NARROWING[-1].error
    problem = _problem(
        samples, start, noises, lambda cycles, noise: plain(cycles, noise, error, _late(start.data))
    )
    return _cost(problem.residual(start.x))


def _cost(residual: Floats) -> float:
    """Robust cost of residuals in sigmas: large ones grow it by their logarithm only."""
    return float(np.sum(np.log1p(residual**2)))


def _other_end(data: DataSet) -> Literal["port", "vessel"]:
    """The end of the line that the sensor of ``data`` is farther from."""
    return "port" if sensor_place(data) > 0.5 else "vessel"


def _problem(
    samples: Samples,
    start: _Start,
    noises: Sequence[float],
    weigh: Callable[[Cycles, float], CycleWhitener],
) -> Problem:
    """The problem of following the pressure from a start; two ``noises`` (Pa): both pressures."""
    cycles = Cycles.found(samples, start.data)
    weights = weigh(cycles, noises[0])
    if len(noises) == 1:
        return Problem(start.space, cycles, weights)
    second = cycles.of_second(_other_end(start.data)).as_slow(coefficients(start.data))
    weights = weights.followed_by(weigh(second, noises[1]), len(cycles.measured))
    return Problem(start.space, Both(cycles, second), weights)


def _late(data: DataSet) -> float:
    """One sigma (s) of the time of an edge: by strokes of valves, and by waves in the line.

    The model has few nodes along the line. A wave that is not much longer than their distance is
    late. Its delay over the travel time grows with the square of that.
    """
    length = sum(part.length_mm for part in data.system.parts if isinstance(part, Tube))
    passage = 1e-3 * length / SPEED_OF_SOUND
    return float(np.hypot(JITTER, passage * (passage / CARRIED) ** 2))


def _followed(samples: Samples, start: _Start, fit_round: Round, noises: Sequence[float]) -> _Start:
    """The result of one round from a start."""
    problem = _problem(
        samples,
        start,
        noises,
        lambda cycles, noise: plain(cycles, noise, fit_round.error, _late(start.data)),
    )
    # The last coordinate is the time by which the nozzle switches before it is seen to.
    x = _solved(problem, np.append(start.x, 0.0), fit_round.steps, fit_round.tolerance, "soft_l1")
    return _Start(start.space, x[:-1], _cost(problem.residual(x)))


def _solved(
    problem: Problem,
    x: Floats,
    steps: int,
    tolerance: float,
    loss: Literal["linear", "soft_l1"] = "linear",
) -> Floats:
    low, high = (bound[: len(x)] for bound in problem.bounds)
    result = least_squares(
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
    best: Floats = result.x
    return best


def _fitted(problem: Problem, x: Floats) -> Fitted:
    """The data set at ``x`` with its covariance."""
    problem = replace(problem, space=problem.space.on_the_line)
    space, cycles = problem.space, problem.cycles
    x = np.clip(x, space.low, space.high)
    best = DataSet.model_validate(falling(space.at(x)).model_dump())
    slopes = space.slopes(x)
    residuals = cycles.residuals(np.stack(with_left_out(best), axis=1))
    jacobian = problem.jacobian_both_ways(x)
    plain = np.asarray(np.linalg.inv(jacobian.T @ jacobian), np.float64)
    covariance = (
        slopes @ _with_left_out(plain, jacobian, problem.weights.white(residuals)) @ slopes.T
    )
    prior = np.sqrt(np.diag(slopes @ slopes.T))
    first_residual = residuals[: len(cycles.bins.count), 0]
    rms = float(np.sqrt(np.average(first_residual**2, weights=cycles.bins.count)))
    root = np.asarray(np.linalg.cholesky(slopes @ plain @ slopes.T), np.float64)
    factor = allowed(problem, best, root)
    return Fitted(best, space.free, covariance, factor, prior, rms, space.scaled)


def allowed(problem: Problem, best: DataSet, factor: Floats) -> Floats:
    """``factor`` of a covariance of parameters, its columns as long as the record allows.

    The covariance counts the model as linear. Where that bends, one sigma of a column may
    contradict the record, on one side at least: then the column is halved until it does not.
    """
    names = [free.name for free in problem.space.free]
    most = problem.most_misfit(float(problem.misfit([best])[0]))
    factor = factor.copy()
    too_long = np.arange(len(names))
    for _ in range(MOST_HALVINGS):
        sides = [
            side
            for column in too_long
            for side in both_sides(best, dict(zip(names, factor[:, column].tolist(), strict=True)))
        ]
        too_long = too_long[problem.misfit(sides).reshape(-1, 2).max(axis=1) > most]
        if not len(too_long):
            break
        factor[:, too_long] /= 2.0
    return factor


def _with_left_out(covariance: Floats, jacobian: Floats, white: Sequence[Floats]) -> Floats:
    """Covariance of ``x``: by the scatter of residuals, and by the model's discrepancy.

    ``white`` are residuals (bins, n) in sigmas: of the fit, then with each omitted effect.
    """
    all_white = np.concatenate(white)
    _, changes = derivatives(all_white)
    moves = covariance @ jacobian[: len(changes)].T @ changes
    total: Floats = covariance + moves @ moves.T
    return total
