"""Simulated detection of the air saving's switching: the detector applied to free runs.

A breakpoint is found where the lines on either side of it meet. A slow sensor rounds it, so that it
shows later and at another level than the switching. The simulation has the same errors as the log.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.model import dense_solver
from twin.model import theta as c
from twin.model.plant import reading_of
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints
from twin.monitor.breakpoints import Noise
from twin.monitor.offline_switching import switchings
from twin.monitor.switching_detector import SHORTEST_WINDOW, DetectorSettings, PhaseFinder
from twin.signals import MBAR, MS, NS, SAMPLE, Command, Phase, Samples

IDLE_ROWS = 50  # idle rows before the cycle
FALLS = 3.0  # times the noise; while a line rings, readings fall back by more
COPIES = 4  # cycles of the simulated record: breakpoints of a record are aligned together
LATEST = 100.0 * MS  # s, longest delay of a breakpoint after the valve's action, by a quick sensor
Bytes = npt.NDArray[np.uint8]
_OTHER = {Phase.HOLD: Phase.SUCTION, Phase.SUCTION: Phase.HOLD}
_RESPONSES = {Phase.HOLD: c.RESPONSE_OFF, Phase.SUCTION: c.RESPONSE}


@dataclass(frozen=True)
class DetectedSwitching:
    """Vacuum (mbar) at which the detector saw the nozzle go off and on; NaN if it did not switch.

    ``*_rows`` are rows from the valve's action to the breakpoint. ``*_above`` is the breakpoint's
    level less the reading at the valve's action (Pa). Both are 0 if it did not switch. ``rings`` is
    the height (Pa) of the line's ringing above the reading as the valve closed; 0 without ringing.
    """

    off: float
    on: float
    off_rows: int = 0
    on_rows: int = 0
    off_above: float = 0.0
    on_above: float = 0.0
    rings: float = 0.0
    thresholds: tuple[float, float] = (
        np.nan,
        np.nan,
    )  # mbar of vacuum read at H1, and at the level where the nozzle goes on again

    @property
    def levels(self) -> tuple[float, float]:
        """Vacuum (mbar) of both switchings; the reading at the threshold if it did not switch."""
        off, on = self.thresholds
        return off if np.isnan(self.off) else self.off, on if np.isnan(self.on) else self.on


def detected_switching(
    thetas: Sequence[Theta], rows: int, detector: DetectorSettings
) -> list[DetectedSwitching]:
    """Run the model free through ``rows`` of suction from rest, and detect its switchings.

    The model steps by a millisecond, like the control of an ejector; rows have the period of
    ``detector``.
    """
    samples = _suction(rows, detector.period)
    return [_detect(samples, _run(theta, rows, detector.period), detector) for theta in thetas]


def shows_late(theta: Theta, rows: int, noise: Noise, name: Phase) -> float:
    """Time (s) from the valve's action into ``name`` to its breakpoint in a whole record; or NaN.

    The record consists of copies of a free run for ``rows``, and is read as one with ``noise``.
    """
    run, samples = _run(theta, rows, noise.period), _suction(rows, noise.period)
    samples["pressure"] = run.expected
    record, row_ns = np.tile(samples, COPIES), round(noise.period / NS)
    record["time_ns"] = np.arange(len(record)) * row_ns
    phase = np.where(record["commands"] == Command.SUCTION, Phase.SUCTION, Phase.IDLE)
    found = switchings(record, phase.astype(np.uint8), noise)
    times = np.array([shown.time for shown in found if shown.on == (name == Phase.SUCTION)])
    late = times % (len(samples) * row_ns * NS) - run.acts(name)
    late = late[np.abs(late) < LATEST]
    return float(np.median(late)) if len(late) else 0.0


def bend_in_free_run(theta: Theta, rows: int, period: float) -> float:
    """Change of the slope (Pa per row) in a free run as the nozzle goes off; 0 if it does not."""
    run = _run(theta, rows, period)
    acts = run.acts(Phase.HOLD)
    row = round(acts / period) if np.isfinite(acts) else len(run.expected)
    slow = round(2.0 * float(theta[c.SENSOR_LAG] + theta[c.SLOW_SENSOR]) / period)
    before, after = run.expected[:row], run.expected[row + slow :]
    if min(len(before), len(after)) <= SHORTEST_WINDOW:
        return 0.0
    fall, rise = before[-1 - SHORTEST_WINDOW] - before[-1], after[SHORTEST_WINDOW] - after[0]
    return float(fall + rise) / SHORTEST_WINDOW


def shortest_interval(theta: Theta, rows: int, period: float) -> float:
    """Shortest time (s) between switchings of the nozzle in a free run; infinite below two."""
    control = _run(theta, rows, period).control
    switched = np.sort(np.concatenate([_switched(control, name) for name in _OTHER]))
    return float(np.diff(switched).min()) * MS if len(switched) > 1 else np.inf


def _suction(rows: int, period: float) -> Samples:
    """Samples of a suction from rest, without pressure."""
    samples = np.zeros(IDLE_ROWS + rows, SAMPLE)
    samples["sequence"] = np.arange(len(samples))
    samples["time_ns"] = np.arange(len(samples)) * max(round(period / MS), 1) * 1_000_000
    samples["commands"][IDLE_ROWS:] = Command.SUCTION
    return samples


def _run(theta: Theta, rows: int, period: float) -> "_Run":
    """Run the model free for ``rows`` of ``period`` seconds."""
    steps_per_row = max(round(period / MS), 1)
    commands = np.full((IDLE_ROWS + rows) * steps_per_row, Command.SUCTION, np.uint8)
    commands[: IDLE_ROWS * steps_per_row] = 0
    phase, expected = dense_solver.simulate(theta, np.full(len(commands), MS), commands)
    return _Run(theta, phase, phase[::steps_per_row], expected[::steps_per_row], period)


class _Run(NamedTuple):
    """A free run of the model, sampled in rows."""

    theta: Theta
    control: Bytes  # phase in each millisecond
    phase: Bytes
    expected: Floats  # Pa, readings of the sensor
    period: float  # s, from row to row

    def rows(self, coefficient: int) -> int:
        """A time of the coefficients, in rows."""
        return round(float(self.theta[coefficient]) / self.period)

    @property
    def latest(self) -> float:
        """Longest delay (s) of a breakpoint after the valve's action."""
        return LATEST + 2.0 * float(self.theta[c.SENSOR_LAG] + self.theta[c.SLOW_SENSOR])

    def acts(self, name: Phase) -> float:
        """Time (s) at which the valve first acts after the control switched; NaN if it does not."""
        switched = _switched(self.control, name)
        return switched[0] * MS + float(self.theta[_RESPONSES[name]]) if len(switched) else np.nan


def _detect(samples: Samples, run: _Run, detector: DetectorSettings) -> DetectedSwitching:
    samples["pressure"] = run.expected
    finder = PhaseFinder(detector)
    (_, early, low), (_, late, high) = finder.push(samples), finder.flush()
    detected, level = np.concatenate([early, late]), np.concatenate([low, high])
    off = _first_switching(run, detected, level, Phase.HOLD)
    on = _first_switching(run, detected, level, Phase.SUCTION)
    rings = _rings(run, FALLS * detector.noise)
    thresholds = _read_at(run.theta, c.H1), _read_at(run.theta, c.H1_LOW)
    return DetectedSwitching(off[0], on[0], off[1], on[1], off[2], on[2], rings, thresholds)


def _first_switching(
    run: _Run, detected: Bytes, level: Floats, name: Phase
) -> tuple[float, int, float]:
    """Vacuum, rows and level above the reading, for the first switching into ``name``.

    A breakpoint far from the valve's action is none of the switching's: a line that rings as
    suction begins can show one.
    """
    switched, before = _switched(run.phase, name) + 1, _OTHER[name]
    if not len(switched):
        return np.nan, 0, 0.0
    acts = int(switched[0]) + run.rows(_RESPONSES[name])
    break_rows = np.flatnonzero(np.isfinite(level) & (detected == name))
    break_rows = break_rows[
        np.isin(detected[break_rows - 1], (before, name))
        & (break_rows > IDLE_ROWS + 1)
        & (np.abs(break_rows - acts) * run.period <= run.latest)
    ]
    if not len(break_rows):
        return np.nan, 0, 0.0
    first = int(break_rows[0])
    vacuum = (run.theta[c.AMBIENT_NOMINAL] - level[first]) / MBAR
    return float(vacuum), first - acts, float(level[first] - run.expected[first])


def _switched(phase: Bytes, name: Phase) -> Ints:
    """Last rows before the nozzle switches into ``name``."""
    rows: Ints = np.flatnonzero((phase[1:] == name) & (phase[:-1] == _OTHER[name]))
    return rows


def _rings(run: _Run, falls: float) -> float:
    """Height (Pa) of the line's ringing above the reading as the valve first closed.

    The line rings as long as the reading falls back by more than ``falls`` (Pa).
    """
    off = run.phase == Phase.HOLD
    if not off.any():
        return 0.0
    first = int(off.argmax())
    rows = int((~off[first:]).argmax()) or len(off) - first
    held = run.expected[first + run.rows(c.RESPONSE_OFF) : first + rows]
    highest = np.maximum.accumulate(held)
    fallen = np.flatnonzero(highest - held > falls)
    return float(highest[fallen[-1]] - held[0]) if len(fallen) else 0.0


def _read_at(theta: Theta, threshold: int) -> float:
    """Vacuum (mbar) that the sensor reads when the control switches."""
    vacuum = float(theta[threshold])
    if theta[c.CONTROL_SENSOR] == c.OWN:
        pressure = float(theta[c.AMBIENT]) - vacuum
        vacuum = float(theta[c.AMBIENT_NOMINAL]) - reading_of(pressure, theta)
    return vacuum / MBAR
