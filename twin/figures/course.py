"""One side of a cycle, measured or expected, as key figures look at it: vacuum and nozzle."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from twin.signals import Phase

SMOOTH = 5  # readings; their median moves no edge, and one reading alone reaches nothing
ENDS = (0.01, 0.99)  # quantiles that stand for the lowest and the highest reading
LONGEST_HOLE = 0.01  # s without a reading, beyond which a switching may have been missed

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]


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
        over = (self.phase != Phase.SUCTION) & (self.phase != Phase.HOLD)
        return int(np.argmax(over)) if over.any() else len(self.phase)

    @cached_property
    def suction_s(self) -> float:
        """How long suction was commanded."""
        return self._at(self.suction_rows)

    @cached_property
    def blow_off_s(self) -> float:
        """How long blow-off was on."""
        steps = np.diff(self.time, append=self._at(len(self.time)))
        return float(steps[self.phase == Phase.BLOW_OFF].sum())

    @cached_property
    def nozzle(self) -> list[tuple[float, float]]:
        """When the nozzle was switched on and off (s), while suction was commanded."""
        on = self.phase[: self.suction_rows] == Phase.SUCTION
        edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(np.int8)))
        times = [
            self._end(int(row)) if number % 2 else self._begin(int(row))
            for number, row in enumerate(edges)
        ]
        in_order = np.maximum.accumulate(times) if times else np.empty(0)
        return [(float(on), float(off)) for on, off in in_order.reshape(-1, 2)]

    @cached_property
    def hold(self) -> slice:
        """Rows of the first stretch with the nozzle off; empty where there is none."""
        held = self.phase[: self.suction_rows] == Phase.HOLD
        edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(np.int8)))
        return slice(int(edges[0]), int(edges[1])) if len(edges) else slice(0, 0)

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
        smoothed: Floats = median_filter(vacuum[there], SMOOTH, mode="nearest")
        return self.time[: self.suction_rows][there], smoothed

    @cached_property
    def supplies(self) -> Floats:
        """What the supply read while the nozzle was on (bar)."""
        there: Floats = self.supply[(self.phase == Phase.SUCTION) & np.isfinite(self.supply)]
        return there

    @cached_property
    def supply_ends(self) -> Floats:
        """The lowest and the highest of it (bar), but for one reading in a hundred each."""
        ends = np.quantile(self.supplies, ENDS) if len(self.supplies) else np.full(2, np.nan)
        return np.asarray(ends)

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
