"""Healthy cycles as the fit sees them: rows in one stretch, averaged over bins."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model.dataset import DataSet, coefficients
from twin.monitor.bins import Bins, Floats, Ints, binned, sparse
from twin.monitor.knees import as_wide_as_needed, expected_knees
from twin.monitor.phases import PhaseFinder
from twin.monitor.signatures import steps
from twin.signals import MBAR, MS, UNUSABLE, Phase, Samples

BINS = 6  # in each unit of warped time


@dataclass(frozen=True)
class Cycles:
    """Healthy samples in one stretch with phases and levels, and their bins."""

    samples: Samples
    dt: Floats
    phase: npt.NDArray[np.uint8]
    level: Floats
    bins: Bins
    measured: Floats  # mean pressure (Pa) of each bin
    drawn: Ints  # rows that suffice to draw what is expected
    tolerance: float  # Pa, of a step of the model

    @classmethod
    def found(cls, samples: Samples, data: DataSet, *, through: bool = False) -> "Cycles":
        """Find the phases as the twin of ``data`` does.

        With ``through`` the model runs on through a switching of the nozzle; otherwise it is
        synchronised on the level that was measured there.
        """
        theta = coefficients(data)
        knees = expected_knees(theta, data.sensor.noise_mbar * MBAR)
        finder = PhaseFinder(as_wide_as_needed(knees, [samples]))
        early, late = finder.push(samples), finder.flush()
        rows, phase = (np.concatenate([early[i], late[i]]) for i in (0, 1))
        level = np.concatenate([early[2], late[2]]).astype(np.float32).astype(np.float64)
        if through:
            level[_switches(phase)] = np.nan
        dt = steps(rows, None)
        expected = _expected(theta.reshape(-1, 1), dt, phase, level)[:, 0]
        usable = ((rows["quality"] & UNUSABLE) == 0) & np.isfinite(rows["pressure"])
        bins = binned(phase, usable & np.isfinite(expected), _edges(phase), BINS)
        measured = bins.mean(rows["pressure"].astype(np.float64))
        # A fit from afar takes what is quick: it has a long way to go, and is off by more.
        drawn = _drawn(dt, phase, level) if through else np.arange(len(dt))
        tolerance = kernel.ROUGHLY if through else kernel.TOLERANCE
        return cls(rows, dt, phase, level, bins, measured, drawn, tolerance)

    def off(self, theta: Floats, early: Sequence[int] = ()) -> Floats:
        """Measured minus expected pressure (Pa) in each bin for hypotheses, (coefficients, n).

        ``early`` says for each by how many rows the nozzle switches before it is seen to.
        """
        moved = any(early)
        phase = self._phases(early) if moved else self.phase[:, None]
        changes = np.flatnonzero(np.diff(phase, axis=0).any(axis=1)) + 1
        drawn = np.unique(np.concatenate([self.drawn, changes - 1, changes]))
        dt = np.diff(np.cumsum(self.dt)[drawn], prepend=0.0)
        phase, level = phase[drawn], self.level[drawn]

        def run(part: slice) -> Floats:
            phases = phase[:, part] if moved else phase
            expected = _expected(theta[:, part], dt, phases, level, self.tolerance)
            off: Floats = self.measured[:, None] - self.bins.through(drawn, expected)
            return off

        half = -(-theta.shape[1] // (2 * kernel.LANES)) * kernel.LANES
        parts = [slice(None, half), slice(half, None)] if half < theta.shape[1] else [slice(None)]
        with ThreadPoolExecutor(len(parts)) as pool:
            return np.concatenate(list(pool.map(run, parts)), axis=1)

    def _phases(self, early: Sequence[int]) -> npt.NDArray[np.uint8]:
        """Phases with every switching moved, (rows, n)."""
        moved = np.repeat(self.phase[:, None], len(early), axis=1)
        for lane, rows in enumerate(early):
            for row in _switches(self.phase):
                begin, end = (row - rows, row) if rows > 0 else (row, row - rows)
                moved[max(begin, 0) : end, lane] = self.phase[row if rows > 0 else row - 1]
        return moved


def _switches(phase: npt.NDArray[np.uint8]) -> Ints:
    """Rows at which the nozzle was seen to switch while suction is commanded."""
    inside = np.isin(phase, (Phase.SUCTION, Phase.HOLD))
    changes = np.flatnonzero(np.diff(phase)) + 1
    switches: Ints = changes[inside[changes] & inside[changes - 1]]
    return switches


def _edges(phase: npt.NDArray[np.uint8]) -> Ints:
    """Rows at which a cycle begins: suction that does not go on from a hold."""
    begins = (phase[1:] == Phase.SUCTION) & np.isin(phase[:-1], (Phase.IDLE, Phase.BLOW_OFF))
    return np.flatnonzero(begins) + 1


def _drawn(dt: Floats, phase: npt.NDArray[np.uint8], level: Floats) -> Ints:
    """Rows that suffice to draw a course: where phases change, time breaks or a level is set."""
    begins = np.isfinite(level) | (dt < 0.5 * MS) | (dt > 1.5 * MS)
    begins[0] = True
    begins[1:] |= np.diff(phase) != 0
    return sparse(begins)


def _expected(
    theta: Floats,
    dt: Floats,
    phase: npt.NDArray[np.uint8],
    level: Floats,
    tolerance: float = kernel.TOLERANCE,
) -> Floats:
    """Run hypotheses, (coefficients, n), over rows: (rows, n) in Pa."""
    expected = np.empty((len(dt), theta.shape[1]))
    state = kernel.new_state(theta.shape[1])
    kernel.advance(state, theta, dt, phase, level, expected, tolerance=tolerance)
    return expected
