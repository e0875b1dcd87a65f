"""Healthy distribution of each figure of a cycle, and how improbable a value is in it.

It begins with the cycles of the commissioning and learns from the unit's own first ones: a few
cycles show neither mean nor scatter well enough for one false alarm in a month. Learning then
stops, so that a slow change stays visible.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtr

from twin.monitor.false_alarm_budget import SINGLE_CYCLES, cycles_between, normal_limit
from twin.monitor.healthy import Healthy
from twin.monitor.score_prediction import FARTHEST, Floats

LEARNED = 300  # healthy cycles of the unit, after which a scatter is known to 4 %
LEARNED_WITHIN = 3.5  # sigmas; a cycle farther out is not learned


@dataclass
class Reference:
    """Statistics of the figures so far: counts, means and sums of squares about the means."""

    count: Floats
    mean: Floats
    squares: Floats

    def add(self, figures: Floats) -> None:
        """Add the figures of a cycle, NaN for one that it does not show (Welford's method)."""
        shown = np.isfinite(figures)
        self.count = self.count + shown
        off = np.where(shown, figures - self.mean, 0.0)
        self.mean = self.mean + off / np.maximum(self.count, 1.0)
        self.squares = self.squares + np.where(shown, off * (figures - self.mean), 0.0)


class Baseline:
    """The figures of one unit's healthy cycles, in the order of ``names``; all values in mbar.

    The distribution of an ``_rms`` depends on the number of quantities that scatter. With one it is
    the absolute value of a normal variable; with several it is closer to its mean. The first is
    assumed, so that a figure does not exceed its limit more often than wanted.
    """

    def __init__(self, healthy: Healthy) -> None:
        self.names = tuple(healthy.figures)
        scatters = [
            (scatter.cycles, scatter.mean, scatter.estimate) for scatter in healthy.figures.values()
        ]
        count, mean, sigma = np.array(scatters, np.float64).reshape(-1, 3).T.copy()
        self._reference = Reference(count, mean, (count - 1.0) * sigma**2)
        self._is_rms = np.array([name.endswith("_rms") for name in self.names], bool)
        self._learned = 0

    @property
    def sigma(self) -> Floats:
        """Present estimate of each figure's sigma."""
        sigma: Floats = np.sqrt(self._reference.squares / (self._reference.count - 1.0))
        return sigma

    def excess(self, figures: Mapping[str, float]) -> Floats:
        """Each figure less its mean: absolute, of an rms only if positive; NaN without a value."""
        off = self._values(figures) - self._reference.mean
        excess: Floats = np.where(self._is_rms, np.maximum(off, 0.0), off)
        return excess

    def normal(
        self, figures: Mapping[str, float], smallest: float, doubts: Mapping[str, float]
    ) -> Floats:
        """Each figure as a standard normal value under a healthy unit; NaN without a value.

        Distances from the mean up to ``smallest``, or to what is in doubt on the day, count as
        none.
        """
        reference, excess = self._reference, self.excess(figures)
        least = [max(doubts.get(name, 0.0), smallest) for name in self.names]
        beyond = np.maximum(np.abs(excess) - least, 0.0)
        from_zero = np.where(beyond > 0.0, reference.mean + beyond, 0.0 * beyond)
        about_zero = reference.squares / reference.count + reference.mean**2
        about_mean = reference.squares / (reference.count - 1.0) * (1.0 + 1.0 / reference.count)
        distance = np.where(self._is_rms, from_zero, np.sign(excess) * beyond)
        variance = np.where(self._is_rms, about_zero, about_mean)
        return as_normal(
            distance / np.sqrt(variance), reference.count - np.where(self._is_rms, 0.0, 1.0)
        )

    def limit(self, days: float, seconds: float, shown: int) -> float:
        """The normal value at which one of ``shown`` figures raises an alarm.

        ``days`` is the mean time between false alarms of any kind; a cycle takes ``seconds``.
        """
        return normal_limit(cycles_between(days, SINGLE_CYCLES, seconds), shown)

    def learn(self, figures: Mapping[str, float], normal: Floats) -> None:
        """Learn a cycle that is healthy by its ``normal`` values, until LEARNED are known."""
        if self._learned < LEARNED and not (np.abs(normal) > LEARNED_WITHIN).any():
            self._learned += 1
            self._reference.add(self._values(figures))

    def _values(self, figures: Mapping[str, float]) -> Floats:
        return np.array([figures.get(name, np.nan) for name in self.names])


def as_normal(t: Floats, freedom: Floats) -> Floats:
    """Student's t as the standard normal value of equal probability; NaN stays."""
    result: Floats = -np.sign(t) * np.maximum(ndtri(stdtr(freedom, -np.abs(t))), -FARTHEST)
    return result
