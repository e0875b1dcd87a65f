"""What each figure of a cycle usually is, and how surely one of a cycle is not.

It begins with the cycles of the commissioning and goes on with the unit's own first ones: a few
cycles show neither mean nor scatter well enough for one false alarm in a month. After these nothing
more is learned, so that what changes slowly stays a change.
"""

from collections.abc import Mapping

import numpy as np

from twin.monitor.change_detection import Floats, Reference, as_normal
from twin.monitor.false_alarm_budget import SINGLE_CYCLES, cycles_between, normal_limit
from twin.monitor.healthy import Healthy

LEARNED = 300  # healthy cycles of its own: then a scatter is known to 4 %
LEARNED_WITHIN = 3.5  # sigmas up to which a cycle is learned from


class Baseline:
    """The figures of one unit's healthy cycles, in the order of ``names``; all values in mbar.

    How an ``_rms`` is spread hangs on how many things scatter. One makes it the size of a normal
    value about zero, several bring it nearer to its mean. It is judged as the first, so that it is
    beyond a limit no more often than is wanted.
    """

    def __init__(self, healthy: Healthy) -> None:
        self.names = tuple(healthy.figures)
        known = [(one.cycles, one.mean, one.estimate) for one in healthy.figures.values()]
        count, mean, sigma = np.array(known, np.float64).reshape(-1, 3).T.copy()
        self._reference = Reference(count, mean, (count - 1.0) * sigma**2)
        self._is_rms = np.array([name.endswith("_rms") for name in self.names], bool)
        self._learned = 0

    @property
    def sigma(self) -> Floats:
        """One standard deviation of each, as known by now."""
        found: Floats = np.sqrt(self._reference.squares / (self._reference.count - 1.0))
        return found

    def excess(self, figures: Mapping[str, float]) -> Floats:
        """By how much each is beyond its mean, an rms only above; NaN where it is not shown."""
        off = self._values(figures) - self._reference.mean
        found: Floats = np.where(self._is_rms, np.maximum(off, 0.0), off)
        return found

    def normal(self, figures: Mapping[str, float], smallest: float) -> Floats:
        """Each as a standard normal value, if the cycle is healthy; NaN where it is not shown.

        ``smallest`` is what may be beyond the mean without being anything.
        """
        known, excess = self._reference, self.excess(figures)
        beyond = np.maximum(np.abs(excess) - smallest, 0.0)
        from_zero = np.where(beyond > 0.0, known.mean + beyond, 0.0 * beyond)
        about_zero = known.squares / known.count + known.mean**2
        about_mean = known.squares / (known.count - 1.0) * (1.0 + 1.0 / known.count)
        far = np.where(self._is_rms, from_zero, np.sign(excess) * beyond)
        variance = np.where(self._is_rms, about_zero, about_mean)
        return as_normal(far / np.sqrt(variance), known.count - np.where(self._is_rms, 0.0, 1.0))

    def limit(self, days: float, seconds: float, shown: int) -> float:
        """The normal value from which on one of so many figures shown is an alarm.

        For so many ``days`` between false alarms of any kind, with cycles of so many ``seconds``.
        """
        return normal_limit(cycles_between(days, SINGLE_CYCLES, seconds), shown)

    def learn(self, figures: Mapping[str, float], normal: Floats) -> None:
        """Take a cycle in that is healthy by its ``normal`` values, while too few are known."""
        if self._learned < LEARNED and not (np.abs(normal) > LEARNED_WITHIN).any():
            self._learned += 1
            self._reference.add(self._values(figures))

    def _values(self, figures: Mapping[str, float]) -> Floats:
        return np.array([figures.get(name, np.nan) for name in self.names])
