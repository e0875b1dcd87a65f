"""How well a calibrated twin follows the record that it was fitted to, phase by phase.

The residual has two parts. The part common to all cycles is the model's own error. The part that
differs from cycle to cycle is noise, quantisation and scatter: no model of this unit can do better,
so it is the floor of the record.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from twin.calibration.cycles import Cycles
from twin.model.dataset import DataSet, coefficients
from twin.monitor.bins import Floats, Ints
from twin.signals import MBAR, Phase

GOOD, USABLE = 1.5, 2.0  # times the floor
LEAST_FLOOR = 0.3 * MBAR  # Pa; no use needs a closer twin
ODD = 2.0  # times the median cycle's rms: beyond it a cycle counts less
FEWEST = 3  # cycles that must have a bin, to separate the common part from scatter
WEAKENS = {
    Phase.IDLE: "leaks and heat while nothing is commanded",
    Phase.SUCTION: "suction, end vacuum, volume and valve response",
    Phase.HOLD: "leaks and the check valve",
    Phase.BLOW_OFF: "blow-off",
}


@dataclass(frozen=True)
class Residual:
    """Residual of one phase (Pa rms), the floor of the record there, and the largest residual."""

    left: float
    floor: float
    most: float = 0.0  # Pa, largest of measured minus expected in the mean cycle
    at: float = 0.0  # s after the phase began

    @property
    def times(self) -> float:
        """Residual over the floor."""
        return self.left / max(self.floor, LEAST_FLOOR)


@dataclass(frozen=True)
class Verdict:
    """``good``, ``usable`` or ``refused``, with the residual of each phase."""

    residuals: Mapping[Phase, Residual]

    @property
    def word(self) -> str:
        """The verdict in a word: by the worst phase."""
        return "good" if self.worst <= GOOD else "usable" if self.worst <= USABLE else "refused"

    @property
    def worst(self) -> float:
        """Residual over the floor of the worst phase."""
        return max(residual.times for residual in self.residuals.values())

    @property
    def weak(self) -> list[Phase]:
        """Phases that the twin follows less well than the record allows, the worst first."""
        weak = [phase for phase, residual in self.residuals.items() if residual.times > GOOD]
        return sorted(weak, key=lambda phase: -self.residuals[phase].times)


def judge(cycles: Cycles, data: DataSet, noise: float) -> Verdict:
    """Judge the twin of ``data`` on ``cycles``; ``noise`` (Pa) is that of one reading."""
    _, bin_residuals = cycles.best_early(coefficients(data))
    bins = cycles.bins
    places = bins.place_by_turn
    used = (bins.cycle >= 1) & np.isfinite(bin_residuals)  # the model settles in the first cycle
    residuals = {}
    for phase in Phase:
        rows = used & (_phase_of(bins.kind) == phase)
        if rows.any():
            residual, place_number = bin_residuals[rows], places[rows]
            rms, floor = _rms_and_floor(
                residual, place_number, bins.cycle[rows], bins.count[rows], noise
            )
            seconds = bins.since[rows] * float(np.median(cycles.dt))
            residuals[phase] = Residual(rms, floor, *_largest_mean(residual, place_number, seconds))  # pyright: ignore[reportArgumentType]
    return Verdict(residuals)


def _largest_mean(residual: Floats, place: Ints, since: Floats) -> tuple[float, float]:
    """The largest mean residual (Pa) of bins that enough cycles have, and its time (s)."""
    _, number, counts = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.bincount(number, residual) / counts
    worst = int(np.argmax(np.abs(mean) * (counts >= min(FEWEST, counts.max()))))
    return float(mean[worst]), float(np.median(since[number == worst]))


def _phase_of(kind: Ints) -> Ints:
    """Phase of each kind of stretch; suction after a hold is suction."""
    phase: Ints = np.where(kind > max(Phase), int(Phase.SUCTION), kind)
    return phase


def _rms_and_floor(
    residual: Floats, place: Ints, cycle: Ints, count: Ints, noise: float
) -> tuple[float, float]:
    """Rms over rows (Pa) of the residual, and of the floor.

    The noise of single readings is added to the means of bins. Only bins that enough cycles have
    count: scatter is unknown where one cycle lasts longer than the others.

    An odd cycle says little of the model and of the floor. So a cycle that is farther than ODD
    times the median from the mean gets less weight in both.
    """
    _, number, counts = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.bincount(number, residual) / counts
    deviation = (residual - mean[number]) ** 2 * (counts / np.maximum(counts - 1, 1))[number]
    is_common = (counts >= FEWEST)[number]
    within_bin = noise**2 * (1.0 - 1.0 / count)  # what averaging over a bin took away
    if not is_common.any():
        return float(np.sqrt(np.average(residual**2 + within_bin, weights=count))), noise
    _, cycle_number = np.unique(cycle, return_inverse=True)
    rows = np.bincount(cycle_number, count * is_common)
    cycle_variance = np.bincount(
        cycle_number, count * is_common * (deviation + within_bin)
    ) / np.maximum(rows, 1)
    median = np.median(cycle_variance[rows > 0])
    weight = np.minimum(1.0, ODD**2 * median / np.maximum(cycle_variance, median))
    mean_square = np.sum(
        weight * np.bincount(cycle_number, count * is_common * (residual**2 + within_bin))
    ) / np.sum(rows)
    floor = np.mean((weight * cycle_variance)[rows > 0])
    return float(np.sqrt(mean_square)), float(np.sqrt(floor))
