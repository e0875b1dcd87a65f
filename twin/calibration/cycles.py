"""Healthy cycles as the fit sees them: rows in one stretch, averaged over bins.

What a model gets wrong after a switching goes on for about as long as the switching is past. So
bins, correlations and all else run in warped time: logarithmic from an edge on, then uniform.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model.dataset import DataSet, coefficients
from twin.monitor.phases import PhaseFinder, expected_knees
from twin.monitor.signatures import steps
from twin.signals import MBAR, MS, UNUSABLE, Phase, Samples

EARLIEST_S, LATEST_S = 5e-3, 0.3  # how long an error goes on, at an edge and long after it
BINS = 6  # in each unit of warped time

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Bins:
    """What each bin is, in order of time; no bin crosses a phase change."""

    count: Ints  # rows
    cycle: Ints
    stretch: Ints  # of one phase, counted over all rows
    kind: Ints  # of stretch: its phase, and the phase before
    time: Floats  # warped, since the stretch began

    @property
    def place(self) -> Ints:
        """The same number for what is alike from cycle to cycle: kind and time."""
        return (self.kind << 16) + np.floor(self.time * BINS).astype(np.int64)


@dataclass(frozen=True)
class Cycles:
    """Healthy samples in one stretch with phases and levels, and their bins."""

    samples: Samples
    dt: Floats
    phase: npt.NDArray[np.uint8]
    level: Floats
    bin: Ints  # of each row; -1 where nothing can be compared
    bins: Bins

    @classmethod
    def found(cls, samples: Samples, data: DataSet) -> "Cycles":
        """Find the phases as the twin of ``data`` does."""
        theta = coefficients(data)
        finder = PhaseFinder(expected_knees(theta, data.sensor.noise_mbar * MBAR))
        early, late = finder.push(samples), finder.flush()
        rows, phase = (np.concatenate([early[i], late[i]]) for i in (0, 1))
        level = np.concatenate([early[2], late[2]]).astype(np.float32).astype(np.float64)
        dt = steps(rows, None)
        expected = _expected(theta.reshape(-1, 1), dt, phase, level)[:, 0]
        usable = ((rows["quality"] & UNUSABLE) == 0) & np.isfinite(rows["pressure"])
        number, bins = _binned(phase, usable & np.isfinite(expected))
        return cls(rows, dt, phase, level, number, bins)

    def off(self, theta: Floats) -> Floats:
        """Measured minus expected pressure (Pa) in each bin for hypotheses, (coefficients, n)."""
        half = -(-theta.shape[1] // (2 * kernel.LANES)) * kernel.LANES
        halves = [part for part in (theta[:, :half], theta[:, half:]) if part.shape[1]]
        with ThreadPoolExecutor(len(halves)) as pool:
            return np.concatenate(list(pool.map(self._off, halves)), axis=1)

    def _off(self, theta: Floats) -> Floats:
        expected = _expected(theta, self.dt, self.phase, self.level)
        used = np.flatnonzero(self.bin >= 0)
        first = np.searchsorted(self.bin[used], np.arange(len(self.bins.count)))
        difference = self.samples["pressure"][used, None] - expected[used]
        sums: Floats = np.add.reduceat(difference, first, axis=0)
        return sums / self.bins.count[:, None]


def _expected(theta: Floats, dt: Floats, phase: npt.NDArray[np.uint8], level: Floats) -> Floats:
    """Run hypotheses, (coefficients, n), over rows: (rows, n) in Pa."""
    expected = np.empty((len(dt), theta.shape[1]))
    kernel.advance(kernel.new_state(theta.shape[1]), theta, dt, phase, level, expected)
    return expected


def warped(seconds: Floats) -> Floats:
    """Warped time: it passes by 1 while an error goes on being about the same."""
    early = np.minimum(seconds, LATEST_S - EARLIEST_S)
    late: Floats = (seconds - early) / LATEST_S
    return np.log1p(early / EARLIEST_S) + late


def _binned(phase: npt.NDArray[np.uint8], usable: npt.NDArray[np.bool_]) -> tuple[Ints, Bins]:
    """Number of the bin of each row, and what the bins are."""
    rows = np.arange(len(phase))
    begins = np.diff(phase, prepend=255) != 0
    first = np.flatnonzero(begins)
    stretch = np.cumsum(begins) - 1
    before = phase[np.maximum(first - 1, 0)].astype(np.int64)
    kind = (phase[first].astype(np.int64) * len(Phase) + before)[stretch]
    edge = begins & (phase == Phase.SUCTION) & (before[stretch] != Phase.HOLD)
    time = warped((rows - first[stretch]) * MS)
    place = (stretch << 16) + np.floor(time * BINS).astype(np.int64)
    _, first, number, count = np.unique(
        place[usable], return_index=True, return_inverse=True, return_counts=True
    )
    here = rows[usable][first]
    bins = Bins(count, np.cumsum(edge)[here], stretch[here], kind[here], time[here])
    result = np.full(len(phase), -1)
    result[usable] = number
    return result, bins
