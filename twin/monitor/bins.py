"""Rows averaged into bins that suit how a model errs.

What a model gets wrong after a switching goes on for about as long as the switching is past. So
bins, correlations and all else run in warped time: logarithmic from an edge on, then uniform.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from twin.model.compiled import compiled, per_row
from twin.model.kernel import LONGEST_BRIDGE
from twin.model.term import AGAIN
from twin.signals import MS, Phase

EARLIEST_S, LATEST_S = 5e-3, 0.3  # how long an error goes on, at an edge and long after it
PER_UNIT = 4  # bins in each unit of warped time
SPARSE, FARTHEST = 20, 10  # rows kept: one in as many as a SPARSEth of those past, at most FARTHEST
ROWS = 10_000  # of a stretch; where bins begin in so many is looked up
Bytes = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
_SUCTION, _HOLD = int(Phase.SUCTION), int(Phase.HOLD)  # plain: enumerations are slow to compare


@dataclass(frozen=True)
class Bins:
    """What each bin is, in order of time; no bin crosses a phase change."""

    number: Ints  # of the bin of each row; -1 where nothing can be compared
    count: Ints  # rows
    cycle: Ints
    stretch: Ints  # of one phase, counted over all rows
    kind: Ints  # of stretch, index into KINDS
    since: Ints  # rows since the stretch began
    step: Ints  # in warped time, counted in it

    @cached_property
    def time(self) -> Floats:
        """Warped, since the stretch began."""
        return warped(self.since * np.float64(MS))

    @property
    def place(self) -> Ints:
        """The same number for what is alike from cycle to cycle: kind and time."""
        return (self.kind << 16) + self.step

    @property
    def place_by_turn(self) -> Ints:
        """The same, where the second hold of a cycle is another place than the first."""
        stretches, first, number = np.unique(self.stretch, return_index=True, return_inverse=True)
        cycle, kind = self.cycle[first], self.kind[first]
        turn = np.zeros(len(stretches), np.int64)
        for one in np.unique(kind):
            here = np.flatnonzero(kind == one)
            begins = np.searchsorted(cycle[here], cycle[here])  # stretches go by time
            turn[here] = np.arange(len(here)) - begins
        return (turn[number] << 24) + self.place

    def mean(self, values: Floats) -> Floats:
        """Mean over each bin of row-by-row ``values``, (rows, ...) to (bins, ...)."""
        used = np.flatnonzero(self.number >= 0)
        if not len(used):
            return values[:0]
        first = np.searchsorted(self.number[used], np.arange(len(self.count)))
        sums: Floats = np.add.reduceat(values[used], first, axis=0)
        return sums / self.count.reshape(-1, *[1] * (values.ndim - 1))

    def through(self, kept: Ints, values: Floats) -> Floats:
        """The mean over each bin of straight lines through ``values`` at the rows ``kept``.

        From (kept, n) to (bins, n); what is in a bin lies between the first and the last kept row.
        """
        sums = np.zeros((len(self.count), values.shape[1]))
        _add_lines(self.number, kept, values, sums)
        return sums / self.count[:, None]


def warped(seconds: Floats) -> Floats:
    """Warped time: it passes by 1 while an error goes on being about the same."""
    early = np.minimum(seconds, LATEST_S - EARLIEST_S)
    late: Floats = (seconds - early) / LATEST_S
    return np.log1p(early / EARLIEST_S) + late


def unwarped(time: Floats) -> Floats:
    """Seconds after which warped time is ``time``."""
    turn = np.log1p((LATEST_S - EARLIEST_S) / EARLIEST_S)
    early = EARLIEST_S * np.expm1(np.minimum(time, turn))
    seconds: Floats = early + np.maximum(time - turn, 0.0) * LATEST_S
    return seconds


def binned(phase: Bytes, usable: Bools, starts: Ints, per_unit: int = PER_UNIT) -> Bins:
    """Bins of rows whose phases are given; ``starts`` are the first rows of cycles.

    What comes before the first of them belongs to cycle -1.
    """
    number = np.empty(len(phase), np.int64)
    begins = _begins(len(phase) // ROWS + 1, per_unit)
    return Bins(number, *_number(np.array(phase), usable, starts, begins, number).T)


def averaged(
    phase: Bytes, off: Floats, drawn: Ints, expected: Floats, per_unit: int = PER_UNIT
) -> tuple[Bins, Floats, Floats]:
    """Bins of the rows of one cycle, and over each the means of ``off`` and of what is expected.

    The latter goes straight between rows that are ``drawn``: from (drawn, n) to (bins, n). What is
    not known, or lies beside drawn rows at which something is not, is in no bin.
    """
    number = np.empty(len(phase), np.int64)
    begins = _begins(len(phase) // ROWS + 1, per_unit)
    found, *means = _averaged(np.array(phase), off, drawn, expected, begins, number)
    return Bins(number, *found.T), *means


@lru_cache(maxsize=16)
def _begins(times: int, per_unit: int) -> Ints:
    """Rows of a stretch before each step of warped time, up to so many ``times`` ROWS or more."""
    steps = np.arange(int(warped(np.array(times * ROWS * MS)) * per_unit) + 2)
    return np.ceil(unwarped(steps / per_unit) / MS).astype(np.int64)


@compiled
def _averaged(phase, off, drawn, expected, begins, number):  # type: ignore[no-untyped-def]
    """What each bin is, and the means of what is off and of what is expected in it."""
    usable = _between(drawn, expected, off)
    found = _number(phase, usable, np.zeros(1, np.int64), begins, number)
    mean, through = np.zeros(len(found)), np.zeros((len(found), expected.shape[1]))
    for row in range(len(number)):
        if number[row] >= 0:
            mean[number[row]] += off[row]
    _add_lines(number, drawn, expected, through)
    for one in range(len(found)):
        mean[one] /= found[one, 0]
        for i in range(expected.shape[1]):
            through[one, i] /= found[one, 0]
    return found, mean, through


@compiled
def _between(drawn, expected, off):  # type: ignore[no-untyped-def]
    """Where there is a deviation and all is known at the drawn rows on either side."""
    usable = np.zeros(len(off), np.bool_)
    before, first = False, len(off)
    for i in range(len(drawn)):
        unknown = 0
        for j in range(expected.shape[1]):  # so written, several at a time
            unknown += 0 if expected[i, j] - expected[i, j] == 0.0 else 1
        last, known = drawn[i], unknown == 0
        for row in range(first, last if before and known else first):
            usable[row] = math.isfinite(off[row])
        usable[last] = known and math.isfinite(off[last])
        before, first = known, last + 1
    return usable


@compiled
def _add_lines(number, drawn, values, sums):  # type: ignore[no-untyped-def]
    """Add what lines through ``values`` are at each row to the sum of its bin."""
    for after in range(len(drawn)):
        before = max(after - 1, 0)
        first, last = drawn[before], drawn[after]
        row = first + 1
        while row < last:
            here, rows, share = number[row], 0, 0.0
            while row < last and number[row] == here:  # of one bin they are summed together
                rows, share, row = rows + 1, share + (last - row) / (last - first), row + 1
            if here >= 0:
                _add(sums[here], share, values[before])
                _add(sums[here], rows - share, values[after])
        if number[last] >= 0:  # whatever is beside it
            _add(sums[number[last]], 1.0, values[after])


@per_row
def _add(total, times, values):  # type: ignore[no-untyped-def]
    """Add so many times the values."""
    for i in range(len(total)):
        total[i] += times * values[i]


@compiled
def _number(phase, usable, starts, begins, number):  # type: ignore[no-untyped-def]
    """Number the bin of each row, and tell of each bin, (bins, 6).

    Rows, cycle, stretch, its kind, rows since it began, and steps in warped time.
    """
    found = np.empty((len(phase), 6), np.int64)
    bins, cycle, stretch, first, again = 0, -1, -1, 0, False
    step, used = 0, -1  # the last that has a bin
    for row in range(len(phase)):
        begun = row == 0 or phase[row] != phase[row - 1]
        while cycle + 1 < len(starts) and starts[cycle + 1] <= row:
            cycle, begun = cycle + 1, True
        if begun:
            again = row > 0 and phase[row] == _SUCTION and phase[row - 1] == _HOLD
            stretch, first, step, used = stretch + 1, row, 0, -1
        while begins[step + 1] <= row - first:
            step += 1
        number[row] = -1
        if usable[row]:
            if step != used:
                kind = AGAIN if again else phase[row]
                found[bins] = 0, cycle, stretch, kind, row - first, step
                bins, used = bins + 1, step
            found[bins - 1, 0] += 1
            number[row] = bins - 1
    return found[:bins].copy()


def drawn(dt: Floats, begins: npt.NDArray[np.bool_]) -> Ints:
    """Rows, ``dt`` seconds apart, that suffice to draw a course whose bends begin at some of them.

    Those about a missing row are among them, as lines are drawn by rows. Where rows are so far
    apart that the model would not step over those left out, all are.
    """
    apart = dt[dt > 0.0]
    period = float(np.median(apart)) if len(apart) else MS
    if 1.5 * period * FARTHEST > LONGEST_BRIDGE:
        return np.arange(len(dt))
    odd = np.flatnonzero((dt < 0.5 * period) | (dt > 1.5 * period))
    return np.unique(np.concatenate([sparse(begins), odd, np.maximum(odd - 1, 0)]))


def sparse(begins: npt.NDArray[np.bool_], since: int = -1) -> Ints:
    """Rows that suffice to draw a curve whose bends begin at some rows: fewer, the later after.

    Before the first row the last bend began ``since`` rows ago.
    """
    kept: Ints = sparse_rows(np.ascontiguousarray(begins), since)
    return kept


@compiled
def sparse_rows(begins, since):  # type: ignore[no-untyped-def]
    """The same, compiled."""
    kept = np.empty(len(begins), np.int64)
    count, due = 0, 0  # rows after a bend
    while due <= since:
        due += _apart(due)
    for row in range(len(begins)):
        since += 1
        if begins[row]:
            since = due = 0
        if since == due or row + 1 == len(begins) or begins[row + 1]:  # the last before as well
            kept[count] = row
            count += 1
        if since == due:
            due += _apart(due)
    return kept[:count].copy()


@per_row
def _apart(since):  # type: ignore[no-untyped-def]
    """Rows from one that is kept so many rows after a bend to the next."""
    return min(max(since // SPARSE, 1), FARTHEST)
