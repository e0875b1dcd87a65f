"""Key figures of simulated cycles: the commands of a log with another data set.

The commands stay as recorded. A PLC whose program waits for a vacuum would send others.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from twin.figures.cycle_view import Bytes, Floats, Rows
from twin.figures.key_figures import Unit, figures
from twin.model import dense_solver
from twin.model import theta as c
from twin.model.term import Terms
from twin.model.theta import Theta
from twin.monitor.bins import Ints
from twin.monitor.cycles import Cycle, cut
from twin.monitor.rows import elapsed
from twin.signals import BAR, MBAR, MS, SAMPLE, Phase, Samples, Ticks, joined, unbroken

LONGEST_STEP = 20.0  # median steps; a longer one is a gap, and is replaced by the median
LONGEST_PAUSE = 10.0  # median cycles; a longer cycle contains a pause of production


@dataclass(frozen=True)
class Program:
    """The commands of consecutive whole cycles, with a row at least each millisecond."""

    steps: Floats  # (rows) s since the row before, not negative
    commands: Bytes  # (rows) bits of ``Command``
    starts: Ints  # (cycles + 1) first row of each cycle, and the row behind the last one

    @classmethod
    def of(cls, samples: Samples, starts: Sequence[int] | Ints) -> "Program":
        """The commands of rows (at least two) in cycles that begin at ``starts``.

        Gaps become median steps, and so do steps between cycles that were not consecutive.
        """
        steps = elapsed(samples)
        typical_step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else MS
        is_gap = (steps <= 0.0) | (steps > LONGEST_STEP * typical_step)
        steps[is_gap] = typical_step
        finer = max(round(typical_step / MS), 1)
        rows = np.repeat(steps / finer, finer)
        return cls(rows, np.repeat(samples["commands"], finer), np.asarray(starts) * finer)

    @classmethod
    def of_cycles(cls, cycles: Sequence[Cycle]) -> "Program":
        """The commands of complete cycles, at least one."""
        samples = joined(np.empty(0, SAMPLE), *(cycle.samples for cycle in cycles))
        starts = np.cumsum([0, *(len(cycle.samples) for cycle in cycles)])
        return cls.of(samples, starts)

    @property
    def cycle_seconds(self) -> Floats:
        """Duration of each cycle (s)."""
        return np.add.reduceat(self.steps, self.starts[:-1])


@dataclass(frozen=True)
class SimulatedCycle:
    """One simulated cycle: its key figures, and the lowest vacuum of its hold."""

    figures: Mapping[str, float]  # by name, in the figures' units; NaN if unknown
    held: float  # mbar: lowest vacuum from the first switching-off on; without one the highest


def simulated(theta: Theta, unit: Unit, program: Program) -> list[SimulatedCycle]:
    """Simulate the cycles of a program with coefficients ``theta``.

    ``unit`` has the levels for the key figures. The first cycle starts from rest, unlike those of a
    running machine, and is left out if there are others.
    """
    phase, pressure = dense_solver.simulate(theta, program.steps, program.commands)
    Terms(unit.data.terms, float(theta[c.AMBIENT])).add(phase, pressure)
    vacuum = (theta[c.AMBIENT] - pressure) / MBAR
    nozzle_bar = float(theta[c.SUPPLY] - theta[c.DROOP]) / BAR
    cycles = [
        _cycle(program.steps[rows], vacuum[rows], phase[rows], nozzle_bar, unit)
        for rows in _slices(program.starts)
    ]
    return cycles[1:] or cycles


def mean_air(cycles: Sequence[SimulatedCycle]) -> float:
    """Mean air (Nl) of a cycle."""
    return float(np.mean([cycle.figures["air"] for cycle in cycles]))


def mean_cycle_time(seconds: Sequence[float] | Floats) -> float:
    """Mean time (s) of a cycle while the machine works; NaN without a cycle.

    ``seconds`` are the times from one suction edge to the next. Pauses are left out: cycles longer
    than LONGEST_PAUSE times the median.
    """
    times = np.asarray(seconds, np.float64)
    if not len(times):
        return math.nan
    return float(np.mean(times[times <= LONGEST_PAUSE * np.median(times)]))


def whole_cycles(blocks: Iterable[tuple[Samples, Ticks]]) -> Iterator[Cycle]:
    """The complete cycles of rows in order, each in one piece."""
    return (cycle for cycle in cut(unbroken(blocks), math.inf) if cycle.complete)


def spread(cycles: Iterable[Cycle], most: int) -> list[Cycle]:
    """Between half of ``most`` and ``most`` of the cycles, evenly spread; all if they are fewer."""
    kept: list[Cycle] = []
    stride = 1
    for number, cycle in enumerate(cycles):
        if number % stride == 0:
            kept.append(cycle)
        if len(kept) > most:
            kept, stride = kept[::2], 2 * stride
    return kept


def _slices(starts: Ints) -> Iterator[slice]:
    return (slice(first, behind) for first, behind in pairwise(starts.tolist()))


def _cycle(
    steps: Floats, vacuum: Floats, phase: Bytes, nozzle_bar: float, unit: Unit
) -> SimulatedCycle:
    """Key figures of the rows of one cycle; ``vacuum`` in mbar."""
    time = np.cumsum(steps) - steps[0]
    supply = np.full(len(time), nozzle_bar)
    rows = Rows(time, vacuum, supply, phase, ended=True, blown=True)
    return SimulatedCycle(figures(rows, unit), _held(vacuum, phase))


def _held(vacuum: Floats, phase: Bytes) -> float:
    """Lowest vacuum (mbar) from the first switching-off to the end of suction; else the highest."""
    sucked = np.isin(phase, (Phase.SUCTION, Phase.HOLD))
    ended = len(phase) if sucked.all() else int(np.argmin(sucked))
    off = np.flatnonzero(phase[:ended] == Phase.HOLD)
    return float(vacuum[off[0] : ended].min() if len(off) else vacuum[:ended].max(initial=0.0))
