"""Cycles cut out of the stream, and the figures of each."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.compiled import compiled
from twin.model.theta import Theta
from twin.quality import BREAK, UNUSABLE, Quality
from twin.signals import MBAR, NS, Phase, Reported, Samples, Ticks, deviation, joined

BATCH = 250  # fewest new rows for which models run ahead: each call has a fixed cost
LONGEST_PIECE = 10_000  # rows; a longer cycle is judged in pieces so that alarms do not wait
FEWEST_ROWS = 20  # of a phase, to judge it
STALE = int(Quality.STALE)  # plain integers: NumPy compares bytes with them
SUCTION, BLOW_OFF, IDLE = int(Phase.SUCTION), int(Phase.BLOW_OFF), int(Phase.IDLE)
HOLD = int(Phase.HOLD)
_NAMES = tuple((int(phase), phase.name.lower()) for phase in Phase)
MEASURED = ("max_vacuum", "t0_measured")  # the ``figures`` that need no model
# Share of the usual vacuum that open cups do not reach: they draw 5 to 25 %. Leaks leave more.
OPEN_CUPS = 1.0 / 3.0
# Share of the cycles that may have met no part. If more have so little vacuum, or the last LASTING
# cycles have, something is wrong: a fault, or the unit of measurement.
MOST_WITHOUT_PART, LASTING = 1.0 / 3.0, 2
SURELY = 3  # rows beyond H1: one may be noise
FOUND_WITHIN_S = 0.1  # s after a switching of the nozzle, by which it is found live or never
PAPER_VACUUM = 600.0 * MBAR  # Pa below ambient, to which the founding paper times evacuation


@dataclass(frozen=True)
class Cycle:
    """One pick: from the suction edge to the next one, or a piece of a long one.

    ``complete``: the cycle began with a suction edge and was seen to its idle end. ``cut_short``:
    its last phase may have continued unseen.
    """

    index: int
    samples: Samples
    ticks: Ticks
    complete: bool
    cut_short: bool = False
    settled: bool = True  # a whole cycle came before without a break: the model has settled

    @property
    def coverage(self) -> float:
        """Share of its samples that were received."""
        sequence = self.samples["sequence"]
        return len(sequence) / max(int(sequence[-1] - sequence[0]) + 1, 1)

    @property
    def end_ns(self) -> int:
        """PLC time of the last row."""
        return int(self.samples["time_ns"][-1])

    @property
    def seconds(self) -> float:
        """PLC time from the first row to the last (s)."""
        return float(self.end_ns - int(self.samples["time_ns"][0])) * NS

    @cached_property
    def off(self) -> npt.NDArray[np.float64]:
        """Measured less expected pressure (mbar), row by row; NaN if either is unusable."""
        return deviation(self.samples, self.ticks) / MBAR

    @cached_property
    def stale(self) -> bool:
        """Whether commands were unknown for a part of it: the model's state is then unknown."""
        return bool((self.samples["quality"] & STALE).any())


class CycleView(NamedTuple):
    """A cycle with its figures, before it is judged."""

    cycle: Cycle
    before: Cycle | None
    figures: Mapping[str, float]
    fit: bool  # it can be judged
    theta: Theta  # coefficients in its surroundings


class CycleKeyFigures(Protocol):
    """Key figures of a whole cycle."""

    @property
    def end_ns(self) -> int:
        """PLC time of its last row."""
        ...

    @property
    def words(self) -> str:
        """One line for people."""
        ...

    def plain(self) -> dict[str, Any]:
        """Its numbers for JSON."""
        ...


class KeyFigureSource(Protocol):
    """A source of key figures."""

    def run_ahead(self, samples: Samples, ticks: Ticks, at_edge: bool) -> None:
        """Process the rows so far of the next piece, to spread the work.

        ``at_edge``: they begin with a suction edge.
        """

    def take(self, piece: Cycle) -> CycleKeyFigures | None:
        """Take pieces of a CycleCutter in order; give the key figures of a cycle that has ended."""


@dataclass
class CycleCutter:
    """Cuts rows into cycles, and gives each as soon as it has ended.

    Cycles with more rows than ``longest`` come in pieces.
    """

    longest: float = LONGEST_PIECE
    _parts: list[tuple[Samples, Ticks]] = field(default_factory=list)
    _count: int = 0  # rows in them
    _shown: int = 0  # of these rows, those that ``begun`` has given
    _phase: int = Phase.SUCTION  # of the newest row; the first row cannot begin a cycle
    _index: int = -1  # of the collected cycle; −1 before the first suction edge
    _at_edge: bool = False  # the collected rows begin with a suction edge
    _edges_on_end: int = 0  # suction edges since the start or the last break

    def push(self, samples: Samples, ticks: Ticks) -> Iterator[Cycle]:
        """Give every cycle that these rows end."""
        breaks = (samples["quality"] & BREAK) != 0
        edges = self._edges(ticks["phase"])
        ends = np.flatnonzero(edges | breaks).tolist()
        begin = 0
        for end in [*ends, len(samples)]:
            while self._count + end - begin > self.longest:
                cut = begin + int(self.longest) - self._count
                self._keep(samples[begin:cut], ticks[begin:cut])
                yield self._cut()
                begin = cut
            self._keep(samples[begin:end], ticks[begin:end])
            if end < len(samples) and self._count:
                yield self._cut(bool(edges[end]), bool(breaks[end]))
            begin = end

    def begun(self) -> tuple[Samples, Ticks, bool] | None:
        """Rows so far of the unfinished piece, and whether they begin with a suction edge.

        None until BATCH rows are new since the last call that gave rows.
        """
        if self._count - self._shown < BATCH:
            return None
        self._shown = self._count
        self._parts = [self._joined()]
        return *self._parts[0], self._at_edge

    def flush(self) -> Iterator[Cycle]:
        """Give the remaining rows as a cycle; it is complete if it had come to idle."""
        if self._count:
            yield self._cut()
        self._phase = Phase.SUCTION

    def _edges(self, phase: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """Mark the rows at which suction begins."""
        before = np.concatenate([[np.uint8(self._phase)], phase])
        self._phase = int(before[-1])
        edges: npt.NDArray[np.bool_] = before[1:] == SUCTION
        edges &= (before[:-1] == IDLE) | (before[:-1] == BLOW_OFF)
        return edges

    def _keep(self, samples: Samples, ticks: Ticks) -> None:
        if len(samples):
            self._parts.append((samples, ticks))
            self._count += len(samples)

    def _joined(self) -> tuple[Samples, Ticks]:
        """The collected rows in one piece."""
        samples, ticks = zip(*self._parts, strict=True)
        return joined(*samples), joined(*ticks)

    def _cut(self, at_edge: bool = False, at_break: bool = False) -> Cycle:
        """The collected rows as a cycle; the next row is at an edge, at a break, or neither."""
        begins, self._at_edge = self._at_edge, at_edge and not at_break
        self._edges_on_end += begins
        settled = self._edges_on_end >= 2
        if at_break:
            self._edges_on_end = 0
        samples, ticks = self._joined()
        self._parts, self._count, self._shown = [], 0, 0
        self._index += begins
        whole = begins and int(ticks["phase"][-1]) in (IDLE, BLOW_OFF)
        cut_short = not self._at_edge and len(samples) < self.longest
        return Cycle(self._index, samples, ticks, whole, cut_short, settled)


def cut(blocks: Iterable[tuple[Samples, Ticks]], longest: float = LONGEST_PIECE) -> Iterator[Cycle]:
    """All cycles of rows by a CycleCutter, flushed at the end."""
    cutter = CycleCutter(longest)
    for samples, ticks in blocks:
        yield from cutter.push(samples, ticks)
    yield from cutter.flush()


def whole(blocks: Iterable[tuple[Samples, Ticks]]) -> list[Cycle]:
    """The complete cycles of rows; long ones are not cut into pieces."""
    return [cycle for cycle in cut(blocks, math.inf) if cycle.complete]


def met_no_part(cycle: Cycle, theta: Theta) -> bool:
    """Whether cups that release parts had none in ``cycle``.

    The vacuum stays far below the model's then. A vessel, or cups whose part stays, have no such
    cycle.
    """
    if math.isnan(theta[c.RELEASE]):
        return False
    usable = (cycle.samples["quality"] & UNUSABLE) == 0
    lowest = np.fmin.reduce(cycle.samples["pressure"][usable], initial=np.nan)
    expected = np.fmin.reduce(cycle.ticks["expected"], initial=np.nan)
    ambient = float(theta[c.AMBIENT])
    return bool(ambient - float(lowest) < OPEN_CUPS * (ambient - float(expected)))


def lost_a_switching(cycle: Cycle, theta: Theta) -> bool:
    """Whether the nozzle must have switched off in ``cycle``, and no switching was found.

    The vacuum reached H1 long before suction ended, and no row is in hold. Then the expected
    pressure is that of a nozzle that runs on, and says nothing of the rig. Where the ejector
    reports its nozzle, none is lost.
    """
    if (cycle.ticks["phase"] == HOLD).any():
        return False
    if (cycle.samples["reported"] & np.uint8(Reported.NOZZLE_KNOWN)).any():
        return False
    in_suction = cycle.ticks["phase"] == SUCTION
    usable = (cycle.samples["quality"] & UNUSABLE) == 0
    vacuum = float(theta[c.AMBIENT]) - cycle.samples["pressure"]
    reached = np.flatnonzero(in_suction & usable & (vacuum >= theta[c.H1]))
    if len(reached) < SURELY:
        return False
    begin, end = reached[SURELY - 1], np.flatnonzero(in_suction)[-1]
    times = cycle.samples["time_ns"]
    return float(times[end] - times[begin]) * NS > FOUND_WITHIN_S


def now_and_then(without_part: Sequence[int], total: int) -> list[int]:
    """Cycles that met no part, or none if they are many of the ``total``, or last until its end."""
    lasts = set(range(total - LASTING, total)) <= set(without_part)
    return [] if lasts or len(without_part) > MOST_WITHOUT_PART * total else list(without_part)


def time_to_vacuum(
    vacuum: float,
    pressure: npt.NDArray[np.float64],
    times: npt.NDArray[np.int64],
    ambient: float,
) -> float:
    """Time (s) from the first row until ``pressure`` is ``vacuum`` Pa below ambient; or NaN."""
    reached = np.flatnonzero(ambient - pressure >= vacuum)
    return float(times[reached[0]] - times[0]) * NS if len(reached) else float("nan")


def figures(cycle: Cycle, theta: Theta) -> dict[str, float]:
    """Figures of a cycle, pressures in mbar and times in ms; unknown ones are left out.

    Deviation per phase as mean and rms; the vacuum at which the air saving switched; evacuation
    times to H2, measured and expected; the highest vacuum. Ambient pressure and H2 are those of
    ``theta``.
    """
    ambient, h2 = float(theta[c.AMBIENT]), float(theta[c.H2])
    result: dict[str, float] = {}
    broken_off = int(cycle.ticks["phase"][-1]) if cycle.cut_short else None
    by_phase = _by_phase(cycle.off, cycle.ticks, ambient)[:, : len(Phase)]
    rows, sums, squares, breakpoints, levels = by_phase.tolist()
    for phase, name in _NAMES:
        # The beginning of a phase that was cut short does not represent it.
        if phase != broken_off and rows[phase] >= FEWEST_ROWS:
            result[f"{name}_mean"] = sums[phase] / rows[phase]
            result[f"{name}_rms"] = math.sqrt(squares[phase] / rows[phase])
    for name, entered in (("h1_level", HOLD), ("h1_low_level", SUCTION)):
        if breakpoints[entered]:
            result[name] = levels[entered] / breakpoints[entered]
    if cycle.complete:
        usable = (cycle.samples["quality"] & UNUSABLE) == 0
        measured = np.where(usable, cycle.samples["pressure"], np.nan).astype(np.float64)
        expected = cycle.ticks["expected"].astype(np.float64)
        times = cycle.samples["time_ns"]
        result["max_vacuum"] = float((ambient - np.fmin.reduce(measured)) / MBAR)
        result["t0_measured"] = time_to_vacuum(h2, measured, times, ambient) * 1e3
        result["t0_expected"] = time_to_vacuum(h2, expected, times, ambient) * 1e3
    return {name: value for name, value in result.items() if math.isfinite(value)}


@compiled
def _by_phase(
    off: npt.NDArray[np.float64], ticks: Ticks, ambient: float
) -> npt.NDArray[np.float64]:
    """Sums by phase, (5, 256).

    Rows with a deviation, its sum and that of its squares; rows with a level, and the sum of their
    vacua, by the phase that begins there.
    """
    sums = np.zeros((5, 256))
    for row in range(len(off)):
        phase, level = ticks[row].phase, np.float64(ticks[row].level)
        if math.isfinite(off[row]):
            sums[0, phase] += 1.0
            sums[1, phase] += off[row]
            sums[2, phase] += off[row] * off[row]
        if row > 0 and math.isfinite(level):
            sums[3, phase] += 1.0
            sums[4, phase] += (ambient - level) / MBAR
    return sums
