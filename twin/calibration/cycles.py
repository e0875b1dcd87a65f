"""Healthy cycles for a fit: rows in one stretch, averaged over bins."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, binned, drawn
from twin.monitor.detector_window import detector_of, select_window
from twin.monitor.offline_switching import Switching, noise_of, switchings
from twin.monitor.rows import time_steps
from twin.monitor.switching_detector import PhaseFinder, commanded
from twin.quality import UNUSABLE
from twin.signals import MBAR, MS, Phase, Samples

BINS = 6  # in each unit of warped time
MOST_EARLY = 15.0 * MS  # s (a row at least), by which the nozzle may be seen early or late
# Sigmas of a second sensor beside the first: offset of 1 % of a vacuum sensor's bar, error of its
# span, and the error of its lag, which is one of LAGS.
ZERO, SPAN, LAG = 10.0 * MBAR, 0.01, 1.0 * MS  # Pa, 1, s
NO_LAG = 0.25 * MS  # s, stage of a sensor without an input filter: a data set has none faster
LAGS = np.array([0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0]) * MS
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Cycles:
    """Healthy samples in one stretch with phases and levels, and their bins."""

    samples: Samples
    dt: Floats
    phase: Bytes
    level: Floats
    bins: Bins
    measured: Floats  # mean pressure (Pa) of each bin
    drawn: Ints  # subsampled rows at which the model is evaluated
    tolerance: float  # Pa, of a step of the model
    end: Literal["", "port", "vessel"] = ""  # end of the line with a second sensor, if it is that
    lag: float = np.nan  # s, of the second sensor
    # (bins, n): errors (Pa) of the sensor that are the same in all cycles, one sigma each.
    unsure: Floats = field(default_factory=lambda: np.empty((0, 0)))

    @classmethod
    def as_live(cls, samples: Samples, data: DataSet) -> "Cycles":
        """Find the phases as the live twin of ``data`` does, synchronised at each breakpoint."""
        theta = coefficients(data)
        finder = PhaseFinder(select_window(detector_of(data), [samples]))
        early, late = finder.push(samples), finder.flush()
        rows, phase = np.concatenate([early[0], late[0]]), np.concatenate([early[1], late[1]])
        level = np.concatenate([early[2], late[2]]).astype(np.float32).astype(np.float64)
        return cls._of(rows, phase, level, theta, quickly=False)

    @classmethod
    def found(cls, samples: Samples, data: DataSet) -> "Cycles":
        """Find the phases and the nozzle's switchings without a model.

        The nozzle switches where the pressure shows it; the model is not synchronised there. An
        ejector without air saving never switches the nozzle by itself.
        """
        theta = coefficients(data)
        blow_off = float(theta[c.BLOW_OFF_MODE]), float(theta[c.BLOW_OFF_TIME])
        rows, commanded_phase, level = commanded(samples, blow_off)
        level = level.astype(np.float32).astype(np.float64)
        saves_air = theta[c.AIR_SAVING] != c.OFF
        nozzle_switchings = (
            switchings(rows, commanded_phase, noise_of(rows, commanded_phase)) if saves_air else []
        )
        phase = _switched(commanded_phase, nozzle_switchings)
        return cls._of(rows, phase, level, theta, quickly=True)

    @classmethod
    def _of(
        cls, rows: Samples, phase: Bytes, level: Floats, theta: Floats, *, quickly: bool
    ) -> "Cycles":
        """Cycles with ``phase`` and ``level``; bins only where the model of ``theta`` is finite."""
        dt = time_steps(rows)
        expected = _expected(theta.reshape(-1, 1), dt, phase, level)[:, 0]
        usable = ((rows["quality"] & UNUSABLE) == 0) & np.isfinite(rows["pressure"])
        bins = binned(phase, usable & np.isfinite(expected), _edges(phase), BINS)
        measured = bins.mean(rows["pressure"].astype(np.float64))
        # A fit from afar takes the quick way: it needs many runs, and its error is larger anyway.
        drawn = _drawn(dt, phase, level) if quickly else np.arange(len(dt))
        tolerance = kernel.COARSE_TOLERANCE if quickly else kernel.TOLERANCE
        unsure = np.empty((len(measured), 0))
        return cls(rows, dt, phase, level, bins, measured, drawn, tolerance, unsure=unsure)

    @property
    def period(self) -> float:
        """Median time (s) from row to row."""
        return float(np.median(self.dt))

    @property
    def most_early(self) -> int:
        """Rows by which a switching may be seen early or late, the same in all cycles."""
        return max(round(MOST_EARLY / self.period), 1)

    @property
    def switchings(self) -> tuple[Ints, npt.NDArray[np.bool_]]:
        """Rows at which the nozzle is seen to switch, and whether it goes on."""
        rows = _switches(self.phase)
        return rows, self.phase[rows] == Phase.SUCTION

    def best_early(self, theta: Theta) -> tuple[int, Floats]:
        """Rows by which the nozzle switches before it is seen to, and the residual (Pa) of bins.

        The pressure shows the switching a little early or late, the same in all cycles. These rows
        fit ``theta`` best.
        """
        early = range(-self.most_early, self.most_early + 1)
        residuals = self.residuals(np.repeat(theta[:, None], len(early), axis=1), early)
        usable = np.isfinite(residuals).all(axis=1) & (self.bins.cycle >= 1)
        mean_square = np.average(residuals[usable] ** 2, axis=0, weights=self.bins.count[usable])
        best = int(np.argmin(mean_square))
        return early[best], residuals[:, best]

    def control_pressure(self, theta: Theta, early: int) -> Floats:
        """Pressure (Pa) of each row that the ejector's own control acts on; NaN where unusable.

        If its sensor is not the PLC's, the model of ``theta`` says how they differ.
        """
        usable = ((self.samples["quality"] & UNUSABLE) == 0) & np.isfinite(self.samples["pressure"])
        measured = np.where(usable, self.samples["pressure"].astype(np.float64), np.nan)
        if theta[c.CONTROL_SENSOR] == c.PLC:
            return measured
        own = theta.copy()
        own[c.PLACE], own[c.SENSOR_LAG], own[c.SLOW_SENSOR] = 0.0, NO_LAG, 0.0
        both = np.stack([own, theta], axis=1)
        expected = _expected(both, self.dt, self._phases([early]), self.level)
        return measured + expected[:, 0] - expected[:, 1]

    def of_second(self, end: Literal["port", "vessel"]) -> "Cycles":
        """These cycles with the second pressure, measured at an ``end`` of the line."""
        pressure = self.samples["pressure_2"].astype(np.float64)
        usable = (self.bins.number >= 0) & (pressure > 0.0)
        rows = np.arange(len(pressure))
        pressure = np.interp(rows, rows[usable], pressure[usable])
        bins = binned(self.phase, usable, _edges(self.phase), BINS)
        measured = bins.mean(pressure)
        slope = bins.mean(np.gradient(pressure) / float(np.median(self.dt)))
        errors = np.full(len(measured), ZERO), SPAN * (measured.max() - measured), LAG * slope
        return replace(self, bins=bins, measured=measured, end=end, unsure=np.stack(errors, axis=1))

    def as_slow(self, theta: Theta) -> "Cycles":
        """These cycles with the lag of LAGS for which the model of ``theta`` fits best."""
        slow = [replace(self, lag=float(lag))._sensed(theta) for lag in LAGS]
        residuals = self.residuals(np.stack(slow, axis=1))
        left = np.abs(residuals - self.unsure @ np.linalg.lstsq(self.unsure, residuals)[0])
        return replace(self, lag=float(LAGS[np.average(left, axis=0).argmin()]))

    def residuals(self, theta: Floats, early: Sequence[int] = ()) -> Floats:
        """Measured minus expected pressure (Pa) in each bin for hypotheses, (coefficients, n).

        ``early``: for each hypothesis, rows by which the nozzle switches before it is seen to.
        """
        theta = self._sensed(theta)
        moved = any(early)
        phase = self._phases(early) if moved else self.phase[:, None]
        changes = np.flatnonzero(np.diff(phase, axis=0).any(axis=1)) + 1
        drawn = np.unique(np.concatenate([self.drawn, changes - 1, changes]))
        dt = np.diff(np.cumsum(self.dt)[drawn], prepend=0.0)
        phase, level = phase[drawn], self.level[drawn]

        def run(part: slice) -> Floats:
            phases = phase[:, part] if moved else phase
            expected = _expected(theta[:, part], dt, phases, level, self.tolerance)
            residuals: Floats = self.measured[:, None] - self.bins.through(drawn, expected)
            return residuals

        half = -(-theta.shape[1] // (2 * kernel.LANES)) * kernel.LANES
        parts = [slice(None, half), slice(half, None)] if half < theta.shape[1] else [slice(None)]
        with ThreadPoolExecutor(len(parts)) as pool:
            return np.concatenate(list(pool.map(run, parts)), axis=1)

    def _sensed(self, theta: Floats) -> Floats:
        """Coefficients with this pressure's sensor in place of the PLC's."""
        if not self.end:
            return theta
        theta = theta.copy()
        line = theta[c.NEAR_RESISTANCE] + theta[c.RESISTANCE]
        theta[c.PLACE] = line if self.end == "vessel" else 0.0 * line
        if np.isfinite(self.lag):
            theta[c.SENSOR_LAG] = self.lag
        return theta

    def _phases(self, early: Sequence[int]) -> Bytes:
        """Phases with every switching moved, (rows, n)."""
        moved = np.repeat(self.phase[:, None], len(early), axis=1)
        for lane, rows in enumerate(early):
            for row in _switches(self.phase):
                begin, end = (row - rows, row) if rows > 0 else (row, row - rows)
                moved[max(begin, 0) : end, lane] = self.phase[row if rows > 0 else row - 1]
        return moved


@dataclass(frozen=True)
class Both:
    """Two pressures of the same cycles: residuals of the first, then of the second."""

    first: Cycles
    second: Cycles

    @property
    def bins(self) -> Bins:
        """Those of the first."""
        return self.first.bins

    @property
    def most_early(self) -> int:
        """Rows by which the nozzle may be seen early or late."""
        return self.first.most_early

    def residuals(self, theta: Floats, early: Sequence[int] = ()) -> Floats:
        """As in ``Cycles``."""
        return np.concatenate(
            [self.first.residuals(theta, early), self.second.residuals(theta, early)]
        )


def _switched(commanded_phase: Bytes, nozzle_switchings: Sequence[Switching]) -> Bytes:
    """Commanded phases, with suction split into suction and hold by the switchings."""
    phase = commanded_phase.copy()
    ends = [*(np.flatnonzero(np.diff(commanded_phase)) + 1).tolist(), len(commanded_phase)]
    for switching in nozzle_switchings:
        end = ends[int(np.searchsorted(ends, switching.row, "right"))]
        if commanded_phase[switching.row] == Phase.SUCTION:
            phase[switching.row : end] = Phase.SUCTION if switching.on else Phase.HOLD
    return phase


def _switches(phase: Bytes) -> Ints:
    """Rows at which the nozzle was seen to switch while suction is commanded."""
    inside = np.isin(phase, (Phase.SUCTION, Phase.HOLD))
    changes = np.flatnonzero(np.diff(phase)) + 1
    switches: Ints = changes[inside[changes] & inside[changes - 1]]
    return switches


def _edges(phase: Bytes) -> Ints:
    """Rows at which a cycle begins: suction after idle or blow-off, not after hold."""
    begins = (phase[1:] == Phase.SUCTION) & np.isin(phase[:-1], (Phase.IDLE, Phase.BLOW_OFF))
    return np.flatnonzero(begins) + 1


def _drawn(dt: Floats, phase: Bytes, level: Floats) -> Ints:
    """Subsampled rows for linear interpolation, denser after phase changes and set levels."""
    begins = np.isfinite(level)
    begins[0] = True
    begins[1:] |= np.diff(phase) != 0
    return drawn(dt, begins)


def _expected(
    theta: Floats,
    dt: Floats,
    phase: Bytes,
    level: Floats,
    tolerance: float = kernel.TOLERANCE,
) -> Floats:
    """Run hypotheses, (coefficients, n), over rows: (rows, n) in Pa."""
    expected = np.empty((len(dt), theta.shape[1]))
    state = kernel.new_state(theta.shape[1])
    kernel.advance(state, theta, dt, phase, level, expected, tolerance=tolerance)
    return expected
