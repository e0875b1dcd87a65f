"""Whether healthy cycles are alike: nothing may come or go while they are recorded."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from twin.calibration.covariance import weighted
from twin.calibration.cycles import Cycles
from twin.errors import ConfigError
from twin.inference.sensitivities import coefficients_at, inside, sensitivities
from twin.model.effects import EFFECTS, Parameter
from twin.model.theta import Theta
from twin.monitor.bins import Floats
from twin.signals import MBAR

SMALLEST = 0.5  # of an effect's typical size: less is within what cycles scatter
LEAST_SCATTER = 0.05  # of it, from cycle to cycle, whatever a few cycles show
MEDIAN = 0.954  # of the difference of two, over the standard deviation of each
SIGNIFICANT = 8.0  # standard errors between the cycles before and after
# A record parts into the cycles before and after one where that explains so much of what they
# differ by. A drift comes to 0.75; 50 healthy rigs of the tests' second world to 0.5 at most.
PARTED = 0.8
EACH = 3  # cycles at least, before and after
LEAST_PARTED = 2.0 * MBAR  # Pa rms
COMMON = 0.8  # of the cycles must have a place for it to be compared
LEVELS = {"h1_level": "h1_shift", "h1_low_level": "h2_shift"}  # figures and what moves them


@dataclass(frozen=True)
class Step:
    """The clearest step in what an effect would be, cycle by cycle."""

    effect: str
    parameter: Parameter
    size: float  # in typical sizes
    errors: float  # standard errors
    first: int  # cycle, counted from 0, from which on it is there
    gain: float  # sigmas² it explains

    @property
    def significant(self) -> bool:
        """Whether it is more than chance and more than a healthy unit has."""
        return abs(self.size) > SMALLEST and self.errors > SIGNIFICANT


def refuse_changing(
    cycles: Cycles, theta: Theta, noise: float, figures: Sequence[Mapping[str, float]]
) -> None:
    """ConfigError if an effect comes or goes in ``cycles``; ``theta`` is the unit's, ``figures``
    what each of its complete cycles says. ``noise`` (Pa) is the sensor's.
    """
    steps = [*_in_pressure(cycles, theta, noise), *_in_levels(figures)]
    steps = sorted((one for one in steps if one.significant), key=lambda one: -one.gain)
    if steps:
        best = steps[0]
        size = abs(best.size) * best.parameter.typical
        raise ConfigError(
            f"the cycles are not alike: with cycle {best.first + 1} something changes that looks"
            f" like {best.effect}, by {size:.2g} {best.parameter.unit}",
            "record healthy cycles of one state; twin diagnose says more",
        )


def refuse_parted(cycles: Cycles) -> None:
    """ConfigError if the cycles before and after one of them are two kinds: of two units, say.

    The one in which it changes may be of neither kind.
    """
    curves, weights = _curves(cycles)
    for first, mixed in product(range(EACH, len(curves) - EACH + 1), (0, 1)):
        early, late = curves[:first], curves[first + mixed :]
        if len(late) < EACH:
            continue
        both = np.concatenate([early, late])
        total = float(np.sum(weights * (both - both.mean(axis=0)) ** 2))
        apart = float(np.sum(weights * (late.mean(axis=0) - early.mean(axis=0)) ** 2))
        explained = apart * len(early) * len(late) / len(both)
        if apart > LEAST_PARTED**2 and explained > PARTED * total:
            usual = np.sqrt((total - explained) / len(both)) / MBAR
            raise ConfigError(
                f"with cycle {first + 2} of the record all changes, by {np.sqrt(apart) / MBAR:.1f}"
                f" mbar rms, where cycles otherwise differ by {usual:.1f}: it is of two units, or"
                " something was changed in the midst of it",
                "commission on a record of one healthy unit in one state",
            )


def _curves(cycles: Cycles) -> tuple[Floats, Floats]:
    """Mean pressure (Pa) of each cycle but the first at each place, (cycles, places), and what
    each place weighs; the weights add up to 1. What a cycle lacks is as in the mean cycle.
    """
    bins = cycles.bins
    used = np.flatnonzero(bins.cycle >= 1)
    numbers, cycle = np.unique(bins.cycle[used], return_inverse=True)
    _, place = np.unique(bins.place[used], return_inverse=True)
    sums, rows = (np.zeros((len(numbers), place.max(initial=-1) + 1)) for _ in range(2))
    np.add.at(sums, (cycle, place), cycles.measured[used] * bins.count[used])
    np.add.at(rows, (cycle, place), bins.count[used])
    common = (rows > 0).mean(axis=0) >= COMMON
    sums, rows = sums[:, common], rows[:, common]
    curves = np.divide(sums, rows, out=np.full(sums.shape, np.nan), where=rows > 0)
    curves = np.where(np.isnan(curves), np.nanmean(curves, axis=0), curves)
    weights = rows.mean(axis=0)
    return curves, weights / weights.sum()


def _in_pressure(cycles: Cycles, theta: Theta, noise: float) -> Iterator[Step]:
    """A step for each parameter of each effect, the model made linear."""
    taken = [(one.name, p) for one in EFFECTS.values() for p in one.parameters]
    typical = [(name, {p.name: p.typical}) for name, p in taken]
    neutral = np.zeros(len(taken))
    steps = inside(neutral, np.array([p.range(theta)[1] / p.typical for _, p in taken]), 1.0)
    off = np.column_stack(
        sensitivities(lambda at: cycles.off(coefficients_at(theta, typical, at)), neutral, steps)
    )
    white = weighted(cycles, theta, noise, fitted=False).white(off)[1:]  # it swings in in the first
    for number, (name, parameter) in enumerate(taken, 1):
        power = np.array([one[:, number] @ one[:, number] for one in white])
        if power.min() < 1.0:  # a typical size would be no more than noise
            continue
        pull = np.array([-one[:, number] @ one[:, 0] for one in white])
        yield _clearest(name, parameter, pull / power, float(power.mean()), before=1)


def _in_levels(figures: Sequence[Mapping[str, float]]) -> Iterator[Step]:
    """The same for the thresholds, which show only in where the nozzle switches."""
    drift = EFFECTS["threshold_drift"]
    for figure, name in LEVELS.items():
        levels = np.array([one[figure] for one in figures if figure in one])
        parameter = next(one for one in drift.parameters if one.name == name)
        if len(levels) == len(figures):
            yield _clearest(drift.name, parameter, levels / parameter.typical, 1.0, before=1)


def _clearest(name: str, parameter: Parameter, sizes: Floats, power: float, before: int) -> Step:
    """Where the sizes (in typical ones) part most clearly; ``before`` cycles precede them."""
    n, steps = len(sizes), []
    median = float(np.median(np.abs(np.diff(sizes))))  # a step in the midst of a cycle moves it not
    sigma = np.hypot(median / MEDIAN, LEAST_SCATTER)
    for first in range(1, n):
        shares = first * (n - first) / n
        size = float(sizes[first:].mean() - sizes[:first].mean())
        errors = float(abs(size) / sigma * np.sqrt(shares))
        gain = size**2 * shares * power
        steps.append(Step(name, parameter, size, errors, first + before, gain))
    return max(steps, key=lambda one: one.errors)
