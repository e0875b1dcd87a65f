"""Healthy cycles as the fit sees them: rows in one stretch, averaged over bins."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model.dataset import DataSet, coefficients
from twin.monitor.bins import Bins, Floats, Ints, binned
from twin.monitor.knees import as_wide_as_needed, expected_knees
from twin.monitor.phases import PhaseFinder
from twin.monitor.signatures import steps
from twin.signals import MBAR, UNUSABLE, Phase, Samples

BINS = 6  # in each unit of warped time


@dataclass(frozen=True)
class Cycles:
    """Healthy samples in one stretch with phases and levels, and their bins."""

    samples: Samples
    dt: Floats
    phase: npt.NDArray[np.uint8]
    level: Floats
    bins: Bins

    @classmethod
    def found(cls, samples: Samples, data: DataSet) -> "Cycles":
        """Find the phases as the twin of ``data`` does."""
        theta = coefficients(data)
        knees = expected_knees(theta, data.sensor.noise_mbar * MBAR)
        finder = PhaseFinder(as_wide_as_needed(knees, [samples]))
        early, late = finder.push(samples), finder.flush()
        rows, phase = (np.concatenate([early[i], late[i]]) for i in (0, 1))
        level = np.concatenate([early[2], late[2]]).astype(np.float32).astype(np.float64)
        dt = steps(rows, None)
        expected = _expected(theta.reshape(-1, 1), dt, phase, level)[:, 0]
        usable = ((rows["quality"] & UNUSABLE) == 0) & np.isfinite(rows["pressure"])
        bins = binned(phase, usable & np.isfinite(expected), _edges(phase), BINS)
        return cls(rows, dt, phase, level, bins)

    def off(self, theta: Floats) -> Floats:
        """Measured minus expected pressure (Pa) in each bin for hypotheses, (coefficients, n)."""
        half = -(-theta.shape[1] // (2 * kernel.LANES)) * kernel.LANES
        halves = [part for part in (theta[:, :half], theta[:, half:]) if part.shape[1]]
        with ThreadPoolExecutor(len(halves)) as pool:
            return np.concatenate(list(pool.map(self._off, halves)), axis=1)

    def _off(self, theta: Floats) -> Floats:
        expected = _expected(theta, self.dt, self.phase, self.level)
        return self.bins.mean(self.samples["pressure"][:, None] - expected)


def _edges(phase: npt.NDArray[np.uint8]) -> Ints:
    """Rows at which a cycle begins: suction that does not go on from a hold."""
    begins = (phase[1:] == Phase.SUCTION) & np.isin(phase[:-1], (Phase.IDLE, Phase.BLOW_OFF))
    return np.flatnonzero(begins) + 1


def _expected(theta: Floats, dt: Floats, phase: npt.NDArray[np.uint8], level: Floats) -> Floats:
    """Run hypotheses, (coefficients, n), over rows: (rows, n) in Pa."""
    expected = np.empty((len(dt), theta.shape[1]))
    kernel.advance(kernel.new_state(theta.shape[1]), theta, dt, phase, level, expected)
    return expected
