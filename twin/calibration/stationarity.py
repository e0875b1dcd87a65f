"""Check that healthy cycles are stationary: no effect may come or go while they are recorded."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from twin.calibration.cycles import Cycles
from twin.calibration.residual_covariance import weighted
from twin.errors import ConfigError
from twin.inference.sensitivities import coefficients_at, inside, sensitivities
from twin.model import theta as c
from twin.model.effects import EFFECTS, Parameter, standing_for
from twin.model.theta import Theta
from twin.monitor.bins import Floats
from twin.signals import MBAR

SMALLEST = 0.5  # of an effect's typical size: smaller steps are within the scatter of cycles
LEAST_SCATTER = 0.05  # of it, from cycle to cycle, even if a few cycles show less
MEDIAN = 0.954  # median absolute difference of two normal values, over the sigma of each
SIGNIFICANT = 8.0  # standard errors between the cycles before and after
# Share of the variance between cycles that a step must explain to split a record. A drift reaches
# 0.75; 50 healthy rigs of the tests' second world reach 0.5 at most.
PARTED = 0.8
EACH = 3  # cycles at least, before and after
LEAST_PARTED = 2.0 * MBAR  # Pa rms
COMMON = 0.8  # share of the cycles that must have a bin for it to be compared
LEVELS = {"h1_level": c.H1, "h1_low_level": c.H1_LOW}  # figures, and coefficients of them


@dataclass(frozen=True)
class Step:
    """The most significant step of an effect's size over the cycles."""

    effect: str
    parameter: Parameter
    size: float  # in typical sizes
    errors: float  # standard errors
    first: int  # first cycle after the step, counted from 0
    gain: float  # sigmas² it explains

    @property
    def significant(self) -> bool:
        """Whether it exceeds both chance and the scatter of a healthy unit."""
        return abs(self.size) > SMALLEST and self.errors > SIGNIFICANT


def check_stationary(
    cycles: Cycles, theta: Theta, noise: float, figures: Sequence[Mapping[str, float]]
) -> None:
    """ConfigError if an effect comes or goes in ``cycles``.

    ``theta`` is the unit's; ``figures`` are those of each complete cycle; ``noise`` (Pa) is the
    sensor's.
    """
    steps = [*_pressure_steps(cycles, theta, noise), *_level_steps(figures)]
    steps = sorted((step for step in steps if step.significant), key=lambda step: -step.gain)
    if steps:
        best = steps[0]
        size = f"{abs(best.size) * best.parameter.typical:.2g} {best.parameter.unit}".strip()
        raise ConfigError(
            f"the cycles are not alike: with cycle {best.first + 1} something changes that looks"
            f" like {best.effect}, by {size}",
            "record healthy cycles of one state; twin diagnose says more",
        )


def check_one_group(cycles: Cycles) -> None:
    """ConfigError if the cycles before and after one of them differ clearly, as with two units.

    The cycle in which it changes may belong to neither group.
    """
    curves, weights = _curves(cycles)
    for first, skipped in product(range(EACH, len(curves) - EACH + 1), (0, 1)):
        curves_before, curves_after = curves[:first], curves[first + skipped :]
        if len(curves_after) < EACH:
            continue
        compared = np.concatenate([curves_before, curves_after])
        total = float(np.sum(weights * (compared - compared.mean(axis=0)) ** 2))
        step = float(
            np.sum(weights * (curves_after.mean(axis=0) - curves_before.mean(axis=0)) ** 2)
        )
        explained_sum = step * len(curves_before) * len(curves_after) / len(compared)
        if step > LEAST_PARTED**2 and explained_sum > PARTED * total:
            usual = np.sqrt((total - explained_sum) / len(compared)) / MBAR
            raise ConfigError(
                f"from cycle {first + 2} on the record is another, by {np.sqrt(step) / MBAR:.1f}"
                f" mbar rms, and other cycles differ by {usual:.1f}: it is of two units, or"
                " something was changed during it",
                "use a record of one healthy unit in one state",
            )


def _curves(cycles: Cycles) -> tuple[Floats, Floats]:
    """Mean pressure (Pa) of each cycle but the first in each bin, (cycles, bins), and weights.

    The weights of the bins add up to 1. A bin that a cycle lacks has the mean of the others.
    """
    bins = cycles.bins
    used = np.flatnonzero(bins.cycle >= 1)
    numbers, cycle = np.unique(bins.cycle[used], return_inverse=True)
    _, place_number = np.unique(bins.place[used], return_inverse=True)
    sums, rows = (np.zeros((len(numbers), place_number.max(initial=-1) + 1)) for _ in range(2))
    np.add.at(sums, (cycle, place_number), cycles.measured[used] * bins.count[used])
    np.add.at(rows, (cycle, place_number), bins.count[used])
    common = (rows > 0).mean(axis=0) >= COMMON
    sums, rows = sums[:, common], rows[:, common]
    curves = np.divide(sums, rows, out=np.full(sums.shape, np.nan), where=rows > 0)
    curves = np.where(np.isnan(curves), np.nanmean(curves, axis=0), curves)
    weights = rows.mean(axis=0)
    return curves, weights / weights.sum()


def _pressure_steps(cycles: Cycles, theta: Theta, noise: float) -> Iterator[Step]:
    """The clearest step for each parameter of each effect, with the linearised model."""
    parameters = [(effect.name, p) for effect in EFFECTS.values() for p in effect.parameters]
    typical = [(name, {p.name: p.typical}) for name, p in parameters]
    neutral = np.zeros(len(parameters))
    steps = inside(neutral, np.array([p.range(theta)[1] / p.typical for _, p in parameters]), 1.0)
    residuals = np.column_stack(
        sensitivities(
            lambda at: cycles.residuals(coefficients_at(theta, typical, at)), neutral, steps
        )
    )
    white = weighted(cycles, theta, noise, fitted=False).white(residuals)
    for number, (name, parameter) in enumerate(parameters, 1):
        power = np.array([effect[:, number] @ effect[:, number] for effect in white])
        if power.min() < 1.0:  # a typical size would be no more than noise
            continue
        pull = np.array([-effect[:, number] @ effect[:, 0] for effect in white])
        yield _clearest_step(name, parameter, pull / power, float(power.mean()), before=1)


def _level_steps(figures: Sequence[Mapping[str, float]]) -> Iterator[Step]:
    """The clearest step of each threshold, which shows only in where the nozzle switches."""
    for figure, threshold in LEVELS.items():
        levels = np.array([values[figure] for values in figures if figure in values])
        drift, parameter = standing_for(threshold)
        if len(levels) == len(figures):
            yield _clearest_step(drift.name, parameter, levels / parameter.typical, 1.0, before=1)


def _clearest_step(
    name: str, parameter: Parameter, sizes: Floats, power: float, before: int
) -> Step:
    """The most significant step of the sizes (in typical ones); ``before`` cycles precede them."""
    n, steps = len(sizes), []
    median = float(np.median(np.abs(np.diff(sizes))))  # robust against a single step
    sigma = np.hypot(median / MEDIAN, LEAST_SCATTER)
    for first in range(1, n):
        shares = first * (n - first) / n
        size = float(sizes[first:].mean() - sizes[:first].mean())
        errors = float(abs(size) / sigma * np.sqrt(shares))
        gain = size**2 * shares * power
        steps.append(Step(name, parameter, size, errors, first + before, gain))
    return max(steps, key=lambda step: step.errors)
