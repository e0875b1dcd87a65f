"""One side of a cycle, measured or expected, as key figures look at it: vacuum and nozzle."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from twin.model.control import LEAK_SETTLE_S
from twin.signals import Phase

LEAK_WINDOW_S = 1.0  # after the settling, in which leakage is judged
LEAST_WINDOW_S = 0.05  # noise of 0.3 mbar then gives 3 mbar/s
ENDS = (0.01, 0.99)  # quantiles that stand for the lowest and the highest reading
LONGEST_HOLE = 0.01  # s without a reading, beyond which a switching may have been missed

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

# As plain numbers: with an enumeration NumPy makes eight bytes of every phase to compare it.
_SUCTION, _HOLD, _BLOW_OFF = int(Phase.SUCTION), int(Phase.HOLD), int(Phase.BLOW_OFF)


@dataclass(frozen=True)
class Course:
    """Rows of one cycle from its suction edge on.

    ``vacuum`` (mbar) is NaN where nothing usable was read; ``supply`` (bar gauge, at the nozzle)
    where it is not measured. ``off_lag`` and ``on_lag`` (s) are from the switching of the air
    saving to where ``phase`` has it.
    """

    time: Floats  # s since the suction edge
    vacuum: Floats
    supply: Floats
    phase: Bytes
    ended: bool  # the end of the suction was seen
    blown: bool  # and that of the blow-off
    off_lag: float = 0.0
    on_lag: float = 0.0

    @cached_property
    def suction_rows(self) -> int:
        """Rows until suction is not commanded any more."""
        over = (self.phase != _SUCTION) & (self.phase != _HOLD)
        return int(np.argmax(over)) if over.any() else len(self.phase)

    @cached_property
    def suction_s(self) -> float:
        """How long suction was commanded."""
        return self._at(self.suction_rows)

    @cached_property
    def blow_off_s(self) -> float:
        """How long blow-off was on."""
        steps = np.diff(self.time, append=self._at(len(self.time)))
        return float(steps[self.phase == _BLOW_OFF].sum())

    @cached_property
    def nozzle(self) -> list[tuple[float, float]]:
        """When the nozzle was switched on and off (s), while suction was commanded."""
        edges = _edges(self.phase[: self.suction_rows] == _SUCTION)
        times = [
            self._end(row) if number % 2 else self._begin(row) for number, row in enumerate(edges)
        ]
        in_order = np.maximum.accumulate(times) if times else np.empty(0)
        return [(float(on), float(off)) for on, off in in_order.reshape(-1, 2)]

    @cached_property
    def hold(self) -> slice:
        """Rows of the first stretch with the nozzle off; empty where there is none."""
        edges = _edges(self.phase[: self.suction_rows] == _HOLD)
        return slice(edges[0], edges[1]) if edges else slice(0, 0)

    @cached_property
    def seamless(self) -> bool:
        """Whether readings follow each other so closely that no switching can have been missed."""
        there = self.time[: self.suction_rows][np.isfinite(self.vacuum[: self.suction_rows])]
        whole = np.concatenate([[0.0], there, [self.suction_s]])
        return len(there) > 0 and bool(np.diff(whole).max() <= LONGEST_HOLE)

    @cached_property
    def smooth(self) -> tuple[Floats, Floats]:
        """Times (s) and vacuum (mbar) of what was read during suction, single readings smoothed."""
        vacuum = self.vacuum[: self.suction_rows]
        there = np.isfinite(vacuum)
        if not there.any():
            return np.empty(0), np.empty(0)
        return self.time[: self.suction_rows][there], _smoothed(vacuum[there])

    @cached_property
    def supplies(self) -> Floats:
        """What the supply read while the nozzle was on (bar)."""
        there: Floats = self.supply[(self.phase == _SUCTION) & np.isfinite(self.supply)]
        return there

    @cached_property
    def mean_supply(self) -> float:
        """The mean of it (bar); NaN where there is none."""
        return float(self.supplies.mean()) if len(self.supplies) else float("nan")

    @cached_property
    def supply_ends(self) -> Floats:
        """The lowest and the highest of it (bar), but for one reading in a hundred each."""
        if not len(self.supplies):
            return np.full(2, np.nan)
        places = [round(share * (len(self.supplies) - 1)) for share in ENDS]
        ends: Floats = np.partition(self.supplies, places)[places]
        return ends

    @cached_property
    def leakage(self) -> float:
        """Vacuum lost per time (mbar/s) in the first stretch of hold; NaN where it cannot tell."""
        if not self.went_off or not self.seamless:
            return float("nan")
        time, vacuum = self.time[self.hold], self.vacuum[self.hold]
        since = time - time[0] - LEAK_SETTLE_S
        rows = (since >= 0.0) & (since <= LEAK_WINDOW_S) & np.isfinite(vacuum)
        if not rows.any() or since[rows][-1] < LEAST_WINDOW_S:
            return float("nan")
        return -slope(time[rows], vacuum[rows])

    def reached(self, level: float) -> float:
        """Time (s) at which the vacuum comes to ``level`` (mbar); NaN if it does not, or unseen."""
        time, vacuum = self.smooth
        beyond = np.flatnonzero(vacuum >= level)
        if not len(beyond):
            return float("nan")
        row = int(beyond[0])
        before = time[row - 1] if row else 0.0
        if time[row] - before > LONGEST_HOLE:
            return float("nan")
        if not row:
            return float(time[row])
        share = (level - vacuum[row - 1]) / (vacuum[row] - vacuum[row - 1])
        return float(before + share * (time[row] - before))

    @property
    def went_off(self) -> bool:
        """Whether the air saving switched the nozzle off."""
        return bool(self.hold.stop > 0)

    def _begin(self, row: int) -> float:
        return float(self.time[row]) - (self.on_lag if row else 0.0)

    def _end(self, row: int) -> float:
        return self._at(row) - (self.off_lag if row < self.suction_rows else 0.0)

    def _at(self, row: int) -> float:
        """Time of a row (s); of the one behind the last as if it came as soon as that did."""
        if row < len(self.time):
            return float(self.time[row])
        return float(self.time[-1] + (self.time[-1] - self.time[-2] if row > 1 else 0.0))


def slope(time: Floats, values: Floats) -> float:
    """Of a straight line through the values, per second."""
    centred = time - time.mean()
    return float(centred @ values / (centred @ centred))


def _edges(on: npt.NDArray[np.bool_]) -> list[int]:
    """Rows from which on it is on, and from which on it is not, in turn."""
    changes = (np.flatnonzero(on[1:] != on[:-1]) + 1).tolist()
    return [*([0] if on[:1].any() else []), *changes, *([len(on)] if on[-1:].any() else [])]


def _smoothed(values: Floats) -> Floats:
    """The median of five neighbours: it moves no edge, and one reading alone reaches nothing.

    Of four the least and the greatest cannot be it, so it is that of the other two and the fifth.
    """
    padded = np.concatenate([values[:1], values[:1], values, values[-1:], values[-1:]])
    a, b, middle, c, d = (padded[first : first + len(values)] for first in range(5))
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    low, high = np.minimum(low, high), np.maximum(low, high)
    result: Floats = np.maximum(low, np.minimum(high, middle))
    return result
