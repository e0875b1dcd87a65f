"""What a log has to say: its complete cycles, and residuals in sigmas of what healthy ones scatter.

A residual is measured minus expected pressure, averaged over short bins that never cross a phase
change. Noise, cycle-to-cycle scatter and the model's own error are correlated in known ways; each
cycle's residual is whitened with their covariance, so that its squares add up to chi-square.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular

from twin.config import Config
from twin.errors import ConfigError
from twin.live import Twin
from twin.model import kernel
from twin.model import theta as c
from twin.model.dataset import coefficients
from twin.model.effects import apply
from twin.model.plant import reading
from twin.model.theta import Theta
from twin.monitor.cycles import Cycle, CycleCutter, figures
from twin.monitor.phases import expected_knees
from twin.monitor.signatures import steps
from twin.signals import MBAR, MS, SAMPLE, TICK, UNUSABLE, Phase, Samples, Ticks

BIN_ROWS = 10
MODEL_ERROR_S = 0.15  # over which the model's error goes on being the same
# What differs from cycle to cycle in a healthy ejector: effect, parameter, one standard deviation.
SCATTER = (
    ("supply_pressure_drop", {"drop": 0.02}),
    ("leakage", {"sonic_flow": 0.03}),
    ("response_delay", {"delay": 0.5}),
    ("blow_off_delay", {"delay": 0.5}),
)

Floats = npt.NDArray[np.float64]
# How a coefficient vector runs in time: from which row on which one holds; the first at row 0.
Course = Sequence[tuple[int, Theta]]


@dataclass(frozen=True)
class Evidence:
    """The complete cycles of a log in one stretch of rows, with all that judges a hypothesis."""

    theta: Theta  # of the calibrated twin as it stands
    begin_ns: int  # PLC time at which the log begins
    samples: Samples
    ticks: Ticks
    starts: npt.NDArray[np.int64]  # first row of each cycle, and the row after the last one
    judged: list[int]  # the cycles that count; in the others the model still swings in
    figures: list[dict[str, float]]  # of each cycle
    healthy: Mapping[str, tuple[float, float]]  # mean and sigma of each figure
    bins: npt.NDArray[np.int64]  # of each row, ascending; -1 where nothing can be compared
    bin_starts: npt.NDArray[np.int64]  # first bin of each cycle, and the one after the last
    whitening: list[Floats]  # lower Cholesky factor of each cycle's covariance, mbar²

    @property
    def cycles(self) -> int:
        """How many complete cycles there are."""
        return len(self.starts) - 1

    def expect(self, course: Course) -> Floats:
        """Pressure (Pa) that the sensor should read if the coefficients ran like ``course``."""
        expected = np.empty(len(self.samples))
        level = self.ticks["level"].astype(np.float64)
        dt = steps(self.samples, None)
        state = kernel.new_state()
        ends = [row for row, _ in course[1:]] + [len(dt)]
        before = course[0][1]
        for (first, theta), last in zip(course, ends, strict=True):
            phase = self._phase(theta)[first:last]
            part = slice(first, last)
            kernel.take_over(state, before, theta)
            before = theta
            kernel.advance(state, theta, dt[part], phase, level[part], expected[part])
        return expected

    def off(self, expected: Floats) -> Floats:
        """Measured minus ``expected`` pressure in mbar, averaged over each bin."""
        used = self.bins >= 0
        difference = (self.samples["pressure"][used] - expected[used]) / MBAR
        count = np.bincount(self.bins[used])
        mean: Floats = np.bincount(self.bins[used], difference) / count
        return mean

    def whitened(self, off: Floats, cycle: int) -> Floats:
        """Residuals of a cycle in sigmas."""
        part = off[self.bin_starts[cycle] : self.bin_starts[cycle + 1]]
        white: Floats = solve_triangular(self.whitening[cycle], part, lower=True)
        return white

    def residuals(self, course: Course) -> list[Floats]:
        """All that contradicts ``course`` in each judged cycle, in sigmas: waveform and levels."""
        off = self.off(self.expect(course))
        found = []
        for cycle in self.judged:
            theta = [theta for row, theta in course if row <= self.starts[cycle]][-1]
            found.append(np.concatenate([self.whitened(off, cycle), self.levels(theta, cycle)]))
        return found

    def levels(self, theta: Theta, cycle: int) -> Floats:
        """Switching levels of a cycle against those ``theta`` would give, in sigmas.

        The ejector switches on its own sensor; what the PLC reads there moves with the thresholds
        and with the errors of the PLC's sensor.
        """
        found = []
        for name, index in (("h1_level", c.H1), ("h1_low_level", c.H1_LOW)):
            if name not in self.healthy:
                continue
            mean, sigma = self.healthy[name]
            moved = (_read_vacuum(theta, index) - _read_vacuum(self.theta, index)) / MBAR
            if name in self.figures[cycle]:
                level = self.figures[cycle][name]
                found.append((level - mean - moved) / np.hypot(sigma, LEVEL_MBAR))
        return np.array(found)

    def _phase(self, theta: Theta) -> npt.NDArray[np.uint8]:
        """Phases with the nozzle's switching moved as far before each knee as ``theta`` has it."""
        phase: npt.NDArray[np.uint8] = self.ticks["phase"].copy()
        for jet, name in ((_collapse, Phase.HOLD), (_build_up, Phase.SUCTION)):
            lags = [round((jet(at) + _sensing(at)) / MS) for at in (self.theta, theta)]
            if (later := lags[1] - lags[0]) == 0:
                continue
            before = lags[0] if name == Phase.SUCTION else 0  # rows from the valve to the knee
            for knee in self._knees(name):
                phase[max(knee - before, 0) : knee] = _OTHER[name]
                phase[max(knee - before - later, 0) : knee] = name
        return phase

    def _knees(self, name: Phase) -> npt.NDArray[np.int64]:
        rows = np.flatnonzero(np.isfinite(self.ticks["level"]) & (self.ticks["phase"] == name))
        rows = rows[rows > 0]
        inside = np.isin(self.ticks["phase"][rows - 1], (Phase.SUCTION, Phase.HOLD))
        return rows[inside]


LEVEL_MBAR = 0.7  # a switching level is not known better, whatever healthy cycles scatter
_OTHER = {Phase.HOLD: Phase.SUCTION, Phase.SUCTION: Phase.HOLD}


def _build_up(theta: Theta) -> float:
    return float(2.0 * theta[c.RAMP_UP] + theta[c.SLOW_RAMP_UP])


def _sensing(theta: Theta) -> float:
    return float(2.0 * theta[c.SENSOR_LAG] + theta[c.SLOW_SENSOR])


def _collapse(theta: Theta) -> float:
    return float(2.0 * theta[c.RAMP_DOWN])


def _read_vacuum(theta: Theta, index: int) -> float:
    nominal = theta[c.AMBIENT_NOMINAL]
    return float(nominal - reading(nominal - theta[index], theta.reshape(-1, 1), 0))


def collect(config: Config, blocks: Iterable[Samples]) -> Evidence:
    """Run the calibrated twin over a log and collect its complete cycles.

    ConfigError if the configuration
    does not say what healthy cycles scatter.
    """
    if "suction_rms" not in config.monitor.healthy:
        hint = "calibrate the twin first: [monitor.healthy] comes from healthy cycles"
        raise ConfigError(f"{config.document.name}: the twin is not calibrated", hint)
    theta = coefficients(config.data)
    cycles, begin_ns = complete_cycles(config, theta, blocks)
    samples = np.concatenate([np.empty(0, SAMPLE), *(cycle.samples for cycle in cycles)])
    ticks = np.concatenate([np.empty(0, TICK), *(cycle.ticks for cycle in cycles)])
    starts = np.cumsum([0, *(len(cycle.samples) for cycle in cycles)])
    judged = [number for number, cycle in enumerate(cycles) if cycle.settled]
    bins, bin_starts = _bins(samples, ticks, starts, judged)
    evidence = Evidence(
        theta=theta,
        begin_ns=begin_ns,
        samples=samples,
        ticks=ticks,
        starts=starts,
        judged=judged,
        figures=[figures(cycle, theta[c.AMBIENT]) for cycle in cycles],
        healthy={name: (one.mean, one.sigma) for name, one in config.monitor.healthy.items()},
        bins=bins,
        bin_starts=bin_starts,
        whitening=[],
    )
    if not judged:
        return evidence
    return replace(evidence, whitening=_whitening(evidence, config.data.sensor.noise_mbar))


def complete_cycles(
    config: Config, theta: Theta, blocks: Iterable[Samples]
) -> tuple[list[Cycle], int]:
    """The complete cycles of a stream in order, and the PLC time of its first row."""
    knees = expected_knees(theta, config.data.sensor.noise_mbar * MBAR)
    twin, cutter = Twin(theta, knees), CycleCutter()
    cycles: list[Cycle] = []
    begin_ns = 0
    for block in blocks:
        begin_ns = begin_ns or int(block["time_ns"][:1].sum())
        cycles += cutter.push(*twin.advance(block))
    cycles += cutter.push(*twin.flush())
    cycles += cutter.flush()
    return [cycle for cycle in cycles if cycle.complete], begin_ns


def _bins(
    samples: Samples, ticks: Ticks, starts: npt.NDArray[np.int64], judged: Sequence[int]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Number the bins: BIN_ROWS rows of one phase of one cycle each."""
    rows = np.arange(len(samples))
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    usable &= np.isfinite(ticks["expected"])
    usable &= np.isin(np.searchsorted(starts, rows, "right") - 1, judged)
    run = np.zeros(len(samples), bool)
    run[starts[:-1]] = True
    run[1:] |= ticks["phase"][1:] != ticks["phase"][:-1]
    first = np.maximum.accumulate(np.where(run, rows, 0))
    edge = run | ((rows - first) % BIN_ROWS == 0)
    label = np.cumsum(edge)  # every cycle begins with a new one
    labels, inverse = np.unique(label[usable], return_inverse=True)
    bins = np.full(len(samples), -1)
    bins[usable] = inverse
    after_all = len(label) and label[-1] + 1
    bin_starts = np.searchsorted(labels, np.append(label, after_all)[starts])
    return bins, bin_starts


def _whitening(evidence: Evidence, noise: float) -> list[Floats]:
    """Cholesky factors of each cycle's covariance: noise, scatter, and the model's own error."""
    base = evidence.off(evidence.expect([(0, evidence.theta)]))
    moves = []
    for name, sizes in SCATTER:
        changed = apply(evidence.theta, name, sizes)
        moves.append(evidence.off(evidence.expect([(0, changed)])) - base)
    used = evidence.bins >= 0
    rows = evidence.bins[used]
    count = np.bincount(rows)
    time = np.bincount(rows, np.flatnonzero(used) * MS) / count
    phase = np.zeros(len(count), np.uint8)
    phase[rows] = evidence.ticks["phase"][used]
    error = np.array([_model_error(evidence.healthy, Phase(p), noise) for p in range(len(Phase))])
    leftover, _ = evidence.healthy.get("leftover", (1.0, 0.0))  # what healthy cycles still have
    factors = []
    for first, last in zip(evidence.bin_starts, evidence.bin_starts[1:], strict=False):
        part = slice(first, last)
        apart = np.abs(time[part, None] - time[None, part])
        same = phase[part, None] == phase[None, part]
        size = error[phase[part]]
        covariance = np.outer(size, size) * same * np.exp(-apart / MODEL_ERROR_S)
        covariance += np.diag(noise**2 / count[part])
        covariance += sum(np.outer(move[part], move[part]) for move in moves)
        factors.append(np.linalg.cholesky(covariance) * leftover)
    return factors


def _model_error(healthy: Mapping[str, tuple[float, float]], phase: Phase, noise: float) -> float:
    """How far the model itself is off in a phase (mbar): healthy deviation that is not noise."""
    mean, sigma = healthy.get(f"{phase.name.lower()}_rms", (1.0, 0.0))
    return float(np.sqrt(max((mean + sigma) ** 2 - noise**2, 0.1**2)))
