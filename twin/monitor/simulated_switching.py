"""How the air saving's switching would be seen: the model runs free, and its knees are looked for.

A knee is found where lines on either side of it meet. A slow sensor rounds it, so it is seen later
and at another level than it happened; all that is the same here as in the log.
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
from twin.monitor.phase_detector import Knees, PhaseFinder
from twin.signals import MBAR, MS, SAMPLE, Command, Phase, Samples

IDLE_ROWS = 50  # before the cycle
FALLS = 3.0  # times the noise: so far back a reading comes where a line rings
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Seen:
    """Vacuum (mbar) at which the nozzle was seen to go off and on; NaN where it did not switch.

    Rows from when the valve acted until it was seen, and how much (Pa) the level found was above
    what the sensor read then; 0 where it did not switch. How high (Pa) above its reading as the
    valve closed the line still rang; 0 where the pressure only rose.
    """

    off: float
    on: float
    off_rows: int = 0
    on_rows: int = 0
    off_above: float = 0.0
    on_above: float = 0.0
    rings: float = 0.0
    thresholds: tuple[float, float] = (np.nan, np.nan)  # mbar, what is read at them

    @property
    def levels(self) -> tuple[float, float]:
        """Vacuum (mbar) of either switching.

        Where the pressure does not come there, what is read at the threshold.
        """
        off, on = self.thresholds
        return off if np.isnan(self.off) else self.off, on if np.isnan(self.on) else self.on


def seen(thetas: Sequence[Theta], rows: int, knees: Knees) -> list[Seen]:
    """Command suction for ``rows`` from rest, let the model run free and look for its knees.

    The model runs each millisecond, as the control of an ejector does; rows are as far apart as
    those of ``knees``.
    """
    every = max(round(knees.period / MS), 1)
    commands = np.full((IDLE_ROWS + rows) * every, Command.SUCTION, np.uint8)
    commands[: IDLE_ROWS * every] = 0
    dt = np.full(len(commands), MS)
    samples = np.zeros(IDLE_ROWS + rows, SAMPLE)
    samples["sequence"] = np.arange(len(samples))
    samples["time_ns"] = np.arange(len(samples)) * every * 1_000_000
    samples["commands"] = commands[::every]
    found = []
    for theta in thetas:
        phase, expected = strides.simulate(theta, dt, commands)
        run = _Run(theta, phase[::every], expected[::every], knees.period)
        found.append(_seen(samples, run, knees))
    return found


class _Run(NamedTuple):
    """A free run of the model, as rows would show it."""

    theta: Theta
    phase: Bytes
    expected: Floats  # Pa, what is read
    period: float  # s, from row to row

    def rows(self, coefficient: int) -> int:
        """A time among the coefficients in rows."""
        return round(float(self.theta[coefficient]) / self.period)


def _seen(samples: Samples, run: _Run, knees: Knees) -> Seen:
    samples["pressure"] = run.expected
    finder = PhaseFinder(knees)
    (_, early, low), (_, late, high) = finder.push(samples), finder.flush()
    found, level = np.concatenate([early, late]), np.concatenate([low, high])
    off = _one(run, found, level, Phase.HOLD)
    on = _one(run, found, level, Phase.SUCTION)
    rings = _rings(run, FALLS * knees.noise)
    thresholds = _read_at(run.theta, c.H1), _read_at(run.theta, c.H1_LOW)
    return Seen(off[0], on[0], off[1], on[1], off[2], on[2], rings, thresholds)


def _one(run: _Run, found: Bytes, level: Floats, name: Phase) -> tuple[float, int, float]:
    """Vacuum, rows and level above the reading, for the first switching into ``name``."""
    phase, expected = run.phase, run.expected
    before = Phase.SUCTION if name == Phase.HOLD else Phase.HOLD
    switched = np.flatnonzero((phase[1:] == name) & (phase[:-1] == before)) + 1
    knees = np.flatnonzero(np.isfinite(level) & (found == name))
    knees = knees[np.isin(found[knees - 1], (before, name)) & (knees > IDLE_ROWS + 1)]
    if not len(switched) or not len(knees):
        return np.nan, 0, 0.0
    response = run.rows(c.RESPONSE_OFF if name == Phase.HOLD else c.RESPONSE)
    rows = int(knees[0] - switched[0] - response)
    vacuum = (run.theta[c.AMBIENT_NOMINAL] - level[knees[0]]) / MBAR
    return float(vacuum), rows, float(level[knees[0]] - expected[knees[0]])


def _rings(run: _Run, falls: float) -> float:
    """How high (Pa) the line still rings above the reading as the valve first closed.

    It rings as long as the reading comes back by more than ``falls`` (Pa).
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
    """Vacuum (mbar) that is read where the control switches."""
    vacuum = float(theta[threshold])
    if theta[c.CONTROL_SENSOR] == c.OWN:
        at = float(theta[c.AMBIENT]) - vacuum
        vacuum = float(theta[c.AMBIENT_NOMINAL]) - reading_of(at, theta)
    return vacuum / MBAR
