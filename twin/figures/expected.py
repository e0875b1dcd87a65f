"""What a cycle should have been: the model runs free beside the cycles, its nozzle its own.

The twin's ticks cannot say it: they are set onto the measurement at each knee, so their nozzle is
the measured one, and before H1 they end where the measurement got to. As the twin, this model
takes over the measured level at each suction edge, and what the gas has kept of the cycle before.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.figures.course import Bytes, Floats
from twin.model import kernel
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.term import Terms
from twin.monitor.signatures import steps
from twin.signals import BREAK, MBAR, MS, Command, Phase, Quality, Samples, Ticks

FREE_S = 1.0  # of suction with the cup open, until its vacuum is read
SWUNG_IN = 2  # suction edges without a break, from which on the gas is as warm as it should be


@dataclass
class Expectation:
    """The model of one unit, running free over the rows of a stream."""

    data: DataSet
    _state: kernel.State | None = None  # None until there is a level to begin at
    _last_ns: int | None = None
    _edges: int = 0  # since it began

    def __post_init__(self) -> None:
        self._theta = coefficients(self.data)
        self._terms = Terms(self.data.terms, float(self._theta[c.AMBIENT]))

    def over(self, samples: Samples, ticks: Ticks, at_edge: bool) -> tuple[Floats, Bytes] | None:
        """Expected vacuum (mbar) and phase of the next rows, a whole cycle if they begin with one.

        None until the model has swung in. ``at_edge`` says that suction begins at the first row.
        """
        stale = bool((samples["quality"] & Quality.STALE).any())  # nobody knows the commands
        if stale or samples["quality"][0] & BREAK:
            self.lose()
        begin = 0 if self._state is not None else _first_level(ticks, at_edge)
        if begin is None or stale:
            return None
        dt = steps(samples, self._last_ns)
        if self._state is None:
            self._state, dt[begin] = kernel.new_state(), -1.0
        self._edges += at_edge
        self._last_ns = int(samples["time_ns"][-1])
        rows = slice(begin, None)
        pressure, phase = self._run(self._state, dt[rows], samples[rows], ticks[begin])
        if self._edges < SWUNG_IN or not at_edge:
            return None
        return (self._theta[c.AMBIENT] - pressure) / MBAR, phase

    def lose(self) -> None:
        """Begin anew: what comes does not follow what was."""
        self._state, self._edges = None, 0

    @cached_property
    def free_flow(self) -> float:
        """Vacuum (mbar) that suction reaches with all cups open; NaN where nothing can open."""
        if not self._theta[c.OPENING] > 0.0:
            return float("nan")
        opened = self._theta.copy()
        opened[c.LAMINAR_LEAK] += opened[c.OPENING]
        state, rows = kernel.at_rest(opened), round(FREE_S * 1e3)
        phase, expected = np.empty(rows, np.uint8), np.empty(rows)
        commands = np.full(rows, Command.SUCTION, np.uint8)
        kernel.simulate(state, opened, np.full(rows, MS), commands, phase, expected)
        return float(opened[c.AMBIENT] - expected[-1]) / MBAR

    def _run(
        self, state: kernel.State, dt: Floats, samples: Samples, first: np.void
    ) -> tuple[Floats, Bytes]:
        """Pressure (Pa) and phase: the first row as the twin has it, the others free."""
        phase, pressure = np.empty(len(dt), np.uint8), np.empty(len(dt))
        phase[:1], level = first["phase"], np.array([first["level"]], np.float64)
        kernel.advance(state, self._theta, dt[:1], phase[:1], level, pressure[:1])
        commands = samples["commands"][1:]
        if len(commands):
            free = phase[1:], pressure[1:]
            kernel.simulate(state, self._theta, dt[1:], commands, *free, kernel.ROUGHLY)
        self._terms.add(phase, pressure)
        return pressure, phase


def _first_level(ticks: Ticks, at_edge: bool) -> int | None:
    """First row on which a model can be set: an idle one, or a suction edge."""
    good = ticks["phase"] == Phase.IDLE
    good[0] |= at_edge
    rows = np.flatnonzero(good & np.isfinite(ticks["level"]))
    return int(rows[0]) if len(rows) else None
