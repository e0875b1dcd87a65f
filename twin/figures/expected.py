"""The expected cycle: the model runs free beside the cycles and switches its own nozzle.

The twin's ticks cannot tell it. They are reset to the measurement at each switching event, so their
nozzle is the measured one, and before H1 they end where the measurement ends. Like the twin, this
model takes over the measured level at each suction edge, and the gas state of the cycle before.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from twin.figures.cycle_view import Bytes, Floats, Rows, find_in_cycle
from twin.model import dense_solver, kernel
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.dense_solver import DenseSolver
from twin.model.term import Terms
from twin.model.theta import Theta
from twin.monitor.cycles import STALE
from twin.monitor.rows import TimeSteps
from twin.quality import BREAK
from twin.signals import MBAR, MS, Command, Phase, Samples, Ticks

LONGEST_SUCTION_S = 60.0  # in which H1 must be reached from rest
FREE_S = 1.0  # of suction with the cup open, until its vacuum is read
SWUNG_IN = 2  # suction edges without a break until the gas temperature has settled


@dataclass
class Expectation:
    """The model of one unit, running free over the rows of a stream.

    It may run as the rows come (``go_on``), so that little is left to do when a cycle ends
    (``end``); its result is the same to the last bit.
    """

    data: DataSet
    _solver: DenseSolver | None = None  # None until there is a level to start from
    _control: kernel.Control = field(default_factory=kernel.Control.anew)
    _steps: TimeSteps = field(default_factory=TimeSteps)
    _edges: int = 0  # since it began
    rows: int = 0  # of the cycle so far
    _stale: bool = False  # rows of this cycle are stale: the commands are unknown
    _pieces: list[tuple[Floats, Bytes]] = field(default_factory=list)  # pressure (Pa) and phase

    def __post_init__(self) -> None:
        self._theta = coefficients(self.data)
        self._terms = Terms(self.data.terms, float(self._theta[c.AMBIENT]))

    def over(self, samples: Samples, ticks: Ticks, at_edge: bool) -> tuple[Floats, Bytes] | None:
        """The result of ``end`` for rows that come all at once."""
        self.go_on(samples, ticks, at_edge)
        return self.end(at_edge)

    def go_on(self, samples: Samples, ticks: Ticks, at_edge: bool) -> None:
        """Run over the next rows of a cycle; ``at_edge``: suction begins at its first row."""
        if not len(samples):
            return
        first, self.rows = self.rows == 0, self.rows + len(samples)
        dt = self._steps.over(samples)
        self._stale |= bool((samples["quality"] & STALE).any())
        if self._stale or (first and samples["quality"][0] & BREAK):
            self.lose()
        begin = 0 if self._solver is not None else _first_level(ticks, first and at_edge)
        if begin is None or self._stale:
            return
        if self._solver is None:
            self._solver, dt[begin], first = DenseSolver(), -1.0, True
        rows = slice(begin, None)
        level = ticks[begin] if first else None
        self._pieces.append(self._run(self._solver, dt[rows], samples[rows], level))

    def end(self, at_edge: bool) -> tuple[Floats, Bytes] | None:
        """Expected vacuum (mbar) and phase of the rows since the last end: one cycle.

        None until the model has settled, and for rows that did not begin at a suction edge.
        """
        pieces, self._pieces, self.rows, self._stale = self._pieces, [], 0, False
        if self._solver is None:
            return None
        self._edges += at_edge
        if self._edges < SWUNG_IN or not at_edge:
            return None
        pressure, phase = (np.concatenate(column) for column in zip(*pieces, strict=True))
        return (self._theta[c.AMBIENT] - pressure) / MBAR, phase

    def lose(self) -> None:
        """Start anew: the next rows do not follow the last ones."""
        self._solver, self._edges = None, 0

    @cached_property
    def free_flow(self) -> float:
        """Vacuum (mbar) that suction reaches with all cups open; NaN if no cup can open."""
        return free_flow(self._theta)

    def _run(
        self, model: DenseSolver, dt: Floats, samples: Samples, first: np.void | None
    ) -> tuple[Floats, Bytes]:
        """Pressure (Pa) and phase: the ``first`` row is the twin's, all others run free."""
        phase, pressure = np.empty(len(dt), np.uint8), np.empty(len(dt))
        signals = np.empty(len(dt), np.uint8)
        free = slice(0 if first is None else 1, None)
        if first is not None:
            phase[0], level = first["phase"], np.array([first["level"]], np.float64)
            outputs = pressure[:1], signals[:1]
            dense_solver.advance(model, self._theta, dt[:1], phase[:1], level, *outputs)
            self._control = kernel.Control.anew()
        driven = self._theta, dt[free], samples["commands"][free]
        out = phase[free], pressure[free], signals[free]
        dense_solver.run_on(model, self._control, *driven, out, kernel.COARSE_TOLERANCE)
        self._terms.add(phase, pressure)
        return pressure, phase


def free_flow(theta: Theta) -> float:
    """Vacuum (mbar) that suction reaches with all cups open; NaN if no cup can open."""
    if not theta[[c.OPENING, c.HOLE]].any():
        return float("nan")
    opened = theta.copy()
    opened[c.LAMINAR_LEAK] += opened[c.OPENING]
    opened[c.LEAK] += opened[c.HOLE]
    rows = round(FREE_S * 1e3)
    commands = np.full(rows, Command.SUCTION, np.uint8)
    _, expected = dense_solver.simulate(opened, np.full(rows, MS), commands)
    return float(opened[c.AMBIENT] - expected[-1]) / MBAR


def t1_from_rest(data: DataSet, theta: Theta | None = None) -> float:
    """Time (ms) from H2 to H1 that the data set expects; infinite if H1 is not reached.

    The air saving is off, so that suction goes on to H1 of the data set. ``theta`` are other
    coefficients than those of the data set.
    """
    theta = coefficients(data) if theta is None else theta.copy()
    theta[c.AIR_SAVING] = c.OFF
    seconds = 1.0
    while seconds <= LONGEST_SUCTION_S:
        vacuum, _ = _suction(theta, seconds)
        reached = np.flatnonzero(vacuum >= data.ejector.h1_mbar)
        if len(reached):
            return float(reached[0] - np.argmax(vacuum >= data.ejector.h2_mbar))
        seconds *= 4.0
    return math.inf


def leakage_from_rest(data: DataSet, theta: Theta | None = None) -> float:
    """Leakage (mbar/s) that the data set expects of the first hold; 0 without a hold.

    ``theta`` are other coefficients than those of the data set.
    """
    reached_ms = t1_from_rest(data, theta)
    if not math.isfinite(reached_ms) or data.ejector.air_saving == "off":
        return 0.0
    vacuum, phase = _suction(coefficients(data) if theta is None else theta, LONGEST_SUCTION_S)
    time = np.arange(len(vacuum), dtype=np.float64) * MS
    rows = Rows(time, vacuum, np.full(len(time), np.nan), phase, ended=True, blown=False)
    leakage = find_in_cycle(rows, data.ejector.h2_mbar, data.ejector.h1_mbar).vacuum.leakage
    return leakage if math.isfinite(leakage) else 0.0


def _suction(theta: Theta, seconds: float) -> tuple[Floats, Bytes]:
    """Vacuum (mbar) and phase, each millisecond, of a suction from rest."""
    rows = round(seconds * 1e3)
    commands = np.full(rows, Command.SUCTION, np.uint8)
    phase, pressure = dense_solver.simulate(theta, np.full(rows, MS), commands)
    vacuum: Floats = (theta[c.AMBIENT] - pressure) / MBAR
    return vacuum, phase


def _first_level(ticks: Ticks, at_edge: bool) -> int | None:
    """First row from which a model can start: an idle one, or a suction edge."""
    settable = ticks["phase"] == Phase.IDLE
    settable[0] |= at_edge
    rows = np.flatnonzero(settable & np.isfinite(ticks["level"]))
    return int(rows[0]) if len(rows) else None
