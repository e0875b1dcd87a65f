"""Simulated detection of the air saving's switching: free runs of the model, and their knees.

A knee is found where lines on either side of it meet. A slow sensor rounds it, so it shows later
and at another level than it happened. The simulation has the same errors as the log.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.model import dense_solver as strides
from twin.model import theta as c
from twin.model.plant import reading_of
from twin.model.theta import Theta
from twin.monitor.bins import Floats
from twin.monitor.switching_detector import Knees, PhaseFinder
from twin.signals import MBAR, MS, SAMPLE, Command, Phase, Samples

IDLE_ROWS = 50  # before the cycle
FALLS = 3.0  # times the noise: a reading falls back by more while a line rings
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Seen:
    """Vacuum (mbar) at which the nozzle was seen to go off and on; NaN if it did not switch.

    ``*_rows`` are rows from the valve's action until the knee shows. ``*_above`` is the level found
    less the sensor's reading then (Pa). Both are 0 if it did not switch. ``rings`` is the height
    (Pa) of the line's ringing above the reading as the valve closed; 0 without ringing.
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
    )  # mbar, readings at H1 and where it goes on again

    @property
    def levels(self) -> tuple[float, float]:
        """Vacuum (mbar) of either switching; the reading at the threshold if it did not switch."""
        off, on = self.thresholds
        return off if np.isnan(self.off) else self.off, on if np.isnan(self.on) else self.on


def seen(thetas: Sequence[Theta], rows: int, knees: Knees) -> list[Seen]:
    """Simulate suction for ``rows`` from rest with the model running free, and find its knees.

    The model has steps of a millisecond, as the control of an ejector; rows have the period of
    ``knees``.
    """
    steps_per_row = max(round(knees.period / MS), 1)
    commands = np.full((IDLE_ROWS + rows) * steps_per_row, Command.SUCTION, np.uint8)
    commands[: IDLE_ROWS * steps_per_row] = 0
    dt = np.full(len(commands), MS)
    samples = np.zeros(IDLE_ROWS + rows, SAMPLE)
    samples["sequence"] = np.arange(len(samples))
    samples["time_ns"] = np.arange(len(samples)) * steps_per_row * 1_000_000
    samples["commands"] = commands[::steps_per_row]
    switchings = []
    for theta in thetas:
        phase, expected = strides.simulate(theta, dt, commands)
        run = _Run(theta, phase[::steps_per_row], expected[::steps_per_row], knees.period)
        switchings.append(_detect(samples, run, knees))
    return switchings


class _Run(NamedTuple):
    """A free run of the model, sampled in rows."""

    theta: Theta
    phase: Bytes
    expected: Floats  # Pa, readings of the sensor
    period: float  # s, from row to row

    def rows(self, coefficient: int) -> int:
        """A coefficient that is a time, in rows."""
        return round(float(self.theta[coefficient]) / self.period)


def _detect(samples: Samples, run: _Run, knees: Knees) -> Seen:
    samples["pressure"] = run.expected
    finder = PhaseFinder(knees)
    (_, early, low), (_, late, high) = finder.push(samples), finder.flush()
    detected, level = np.concatenate([early, late]), np.concatenate([low, high])
    off = _first_switching(run, detected, level, Phase.HOLD)
    on = _first_switching(run, detected, level, Phase.SUCTION)
    rings = _rings(run, FALLS * knees.noise)
    thresholds = _read_at(run.theta, c.H1), _read_at(run.theta, c.H1_LOW)
    return Seen(off[0], on[0], off[1], on[1], off[2], on[2], rings, thresholds)


def _first_switching(
    run: _Run, detected: Bytes, level: Floats, name: Phase
) -> tuple[float, int, float]:
    """Vacuum, rows and level above the reading, for the first switching into ``name``."""
    phase, expected = run.phase, run.expected
    before = Phase.SUCTION if name == Phase.HOLD else Phase.HOLD
    switched = np.flatnonzero((phase[1:] == name) & (phase[:-1] == before)) + 1
    knees = np.flatnonzero(np.isfinite(level) & (detected == name))
    knees = knees[np.isin(detected[knees - 1], (before, name)) & (knees > IDLE_ROWS + 1)]
    if not len(switched) or not len(knees):
        return np.nan, 0, 0.0
    response = run.rows(c.RESPONSE_OFF if name == Phase.HOLD else c.RESPONSE)
    rows = int(knees[0] - switched[0] - response)
    vacuum = (run.theta[c.AMBIENT_NOMINAL] - level[knees[0]]) / MBAR
    return float(vacuum), rows, float(level[knees[0]] - expected[knees[0]])


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
