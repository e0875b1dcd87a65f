"""Rows averaged into bins that suit the errors of a model.

An error of the model after a switching lasts about as long as the time since the switching. So bins
and correlations use warped time: logarithmic after an edge, then uniform.
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

EARLIEST_S, LATEST_S = 5e-3, 0.3  # correlation time of an error, at an edge and long after it
PER_UNIT = 4  # bins per unit of warped time
SPARSE, FARTHEST = 20, 10  # spacing of kept rows: rows since a break / SPARSE, up to FARTHEST
ROWS = 10_000  # of a stretch, by which the table of bins' first rows grows
Bytes = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
_SUCTION, _HOLD = int(Phase.SUCTION), int(Phase.HOLD)  # plain: enumerations are slow to compare


@dataclass(frozen=True)
class Bins:
    """Bins in order of time; no bin crosses a phase change."""

    number: Ints  # bin of each row; -1 if the row cannot be compared
    count: Ints  # rows in each bin
    cycle: Ints
    stretch: Ints  # number of the stretch of one phase, counted over all rows
    kind: Ints  # kind of stretch, index into KINDS
    since: Ints  # rows since the stretch began
    step: Ints  # steps of warped time since the stretch began

    @cached_property
    def time(self) -> Floats:
        """Warped time since the stretch began."""
        return warped(self.since * np.float64(MS))

    @property
    def place(self) -> Ints:
        """Identity of each bin that is the same from cycle to cycle: kind and time."""
        return (self.kind << 16) + self.step

    @property
    def place_by_turn(self) -> Ints:
        """Identity of each bin as in ``place``, but different for the second hold of a cycle."""
        stretches, first, number = np.unique(self.stretch, return_index=True, return_inverse=True)
        cycle, kind = self.cycle[first], self.kind[first]
        turn = np.zeros(len(stretches), np.int64)
        for stretch_kind in np.unique(kind):
            of_kind = np.flatnonzero(kind == stretch_kind)
            begins = np.searchsorted(cycle[of_kind], cycle[of_kind])  # ordered by time
            turn[of_kind] = np.arange(len(of_kind)) - begins
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
        """Mean over each bin of straight lines through ``values`` at the rows ``kept``.

        From (kept, n) to (bins, n). All rows with a bin lie between the first and the last kept.
        """
        sums = np.zeros((len(self.count), values.shape[1]))
        _add_lines(self.number, kept, values, sums)
        return sums / self.count[:, None]


def warped(seconds: Floats) -> Floats:
    """Warped time, in units of the correlation time of the model's error."""
    early = np.minimum(seconds, LATEST_S - EARLIEST_S)
    late: Floats = (seconds - early) / LATEST_S
    return np.log1p(early / EARLIEST_S) + late


def unwarped(time: Floats) -> Floats:
    """The inverse of ``warped``, in seconds."""
    turn = np.log1p((LATEST_S - EARLIEST_S) / EARLIEST_S)
    early = EARLIEST_S * np.expm1(np.minimum(time, turn))
    seconds: Floats = early + np.maximum(time - turn, 0.0) * LATEST_S
    return seconds


def binned(phase: Bytes, usable: Bools, starts: Ints, per_unit: int = PER_UNIT) -> Bins:
    """Bins of rows by their ``phase``; ``starts`` are the first rows of cycles.

    Rows before the first cycle belong to cycle -1.
    """
    number = np.empty(len(phase), np.int64)
    begins = _begins(len(phase) // ROWS + 1, per_unit)
    return Bins(number, *_number(np.array(phase), usable, starts, begins, number).T)


def averaged(
    phase: Bytes, off: Floats, drawn: Ints, expected: Floats, per_unit: int = PER_UNIT
) -> tuple[Bins, Floats, Floats]:
    """Bins of the rows of one cycle, and the means of ``off`` and ``expected`` over each.

    ``expected`` is interpolated between the rows ``drawn``: from (drawn, n) to (bins, n). A row is
    in no bin if ``off`` is unknown there, or ``expected`` at a drawn row beside it.
    """
    number = np.empty(len(phase), np.int64)
    begins = _begins(len(phase) // ROWS + 1, per_unit)
    columns, mean, expected_mean = _averaged(np.array(phase), off, drawn, expected, begins, number)
    return Bins(number, *columns.T), mean, expected_mean


@lru_cache(maxsize=16)
def _begins(times: int, per_unit: int) -> Ints:
    """First row of each step of warped time in a stretch of at least ``times`` × ROWS rows."""
    steps = np.arange(int(warped(np.array(times * ROWS * MS)) * per_unit) + 2)
    return np.ceil(unwarped(steps / per_unit) / MS).astype(np.int64)


@compiled
def _averaged(
    phase: Bytes, off: Floats, drawn: Ints, expected: Floats, begins: Ints, number: Ints
) -> tuple[Ints, Floats, Floats]:
    """Columns of the bins, and the means of deviation and expected values over each."""
    usable = _between(drawn, expected, off)
    columns = _number(phase, usable, np.zeros(1, np.int64), begins, number)
    mean, through = np.zeros(len(columns)), np.zeros((len(columns), expected.shape[1]))
    for row in range(len(number)):
        if number[row] >= 0:
            mean[number[row]] += off[row]
    _add_lines(number, drawn, expected, through)
    for index in range(len(columns)):
        mean[index] /= columns[index, 0]
        for i in range(expected.shape[1]):
            through[index, i] /= columns[index, 0]
    return columns, mean, through


@compiled
def _between(drawn: Ints, expected: Floats, off: Floats) -> Bools:
    """Rows with a deviation and with known values at the drawn rows on either side."""
    usable = np.zeros(len(off), np.bool_)
    was_known, first = False, len(off)
    for i in range(len(drawn)):
        unknown = 0
        for j in range(expected.shape[1]):  # written so that the compiler vectorises it
            unknown += 0 if expected[i, j] - expected[i, j] == 0.0 else 1
        last, is_known = drawn[i], unknown == 0
        for row in range(first, last if was_known and is_known else first):
            usable[row] = math.isfinite(off[row])
        usable[last] = is_known and math.isfinite(off[last])
        was_known, first = is_known, last + 1
    return usable


@compiled
def _add_lines(number: Ints, drawn: Ints, values: Floats, sums: Floats) -> None:
    """Interpolate ``values`` linearly at each row, and add them to the sum of its bin."""
    for after in range(len(drawn)):
        before = max(after - 1, 0)
        first, last = drawn[before], drawn[after]
        row = first + 1
        while row < last:
            bin_number, rows, share = number[row], 0, 0.0
            while row < last and number[row] == bin_number:  # rows of one bin are summed together
                rows, share, row = rows + 1, share + (last - row) / (last - first), row + 1
            if bin_number >= 0:
                _add(sums[bin_number], share, values[before])
                _add(sums[bin_number], rows - share, values[after])
        if number[last] >= 0:
            _add(sums[number[last]], 1.0, values[after])


@per_row
def _add(total: Floats, times: float, values: Floats) -> None:
    """Add ``values`` × ``times`` to ``total``."""
    for i in range(len(total)):
        total[i] += times * values[i]


@compiled
def _number(phase: Bytes, usable: Bools, starts: Ints, begins: Ints, number: Ints) -> Ints:
    """Write the bin of each row into ``number``; return the columns of each bin, (bins, 6).

    Columns: rows, cycle, stretch, its kind, rows since it began, and steps of warped time.
    """
    columns = np.empty((len(phase), 6), np.int64)
    bins, cycle, stretch, first, again = 0, -1, -1, 0, False
    step, used = 0, -1  # step of warped time, and the last step with a bin
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
                columns[bins] = 0, cycle, stretch, kind, row - first, step
                bins, used = bins + 1, step
            columns[bins - 1, 0] += 1
            number[row] = bins - 1
    return columns[:bins].copy()


def drawn(dt: Floats, begins: npt.NDArray[np.bool_]) -> Ints:
    """Subsampled rows for linear interpolation; ``begins`` marks breakpoints, ``dt`` is in seconds.

    Rows beside a missing row are kept, since interpolation counts rows. All rows are kept if the
    model cannot step over several of them at once.
    """
    intervals = dt[dt > 0.0]
    period = float(np.median(intervals)) if len(intervals) else MS
    if 1.5 * period * FARTHEST > LONGEST_BRIDGE:
        return np.arange(len(dt))
    odd = np.flatnonzero((dt < 0.5 * period) | (dt > 1.5 * period))
    return np.unique(np.concatenate([sparse(begins), odd, np.maximum(odd - 1, 0)]))


def sparse(begins: npt.NDArray[np.bool_], since: int = -1) -> Ints:
    """Subsampled rows for linear interpolation; spacing grows with the rows since a breakpoint.

    The last breakpoint before the first row was ``since`` rows ago.
    """
    return sparse_rows(np.ascontiguousarray(begins), since)


@compiled
def sparse_rows(begins: Bools, since: int) -> Ints:
    """``sparse``, compiled."""
    kept = np.empty(len(begins), np.int64)
    count, due = 0, 0  # kept rows; rows after a breakpoint at which the next one is due
    while due <= since:
        due += _spacing(due)
    for row in range(len(begins)):
        since += 1
        if begins[row]:
            since = due = 0
        if since == due or row + 1 == len(begins) or begins[row + 1]:  # or the last of a stretch
            kept[count] = row
            count += 1
        if since == due:
            due += _spacing(due)
    return kept[:count].copy()


@per_row
def _spacing(since: int) -> int:
    """Spacing of kept rows, ``since`` rows after a breakpoint."""
    return min(max(since // SPARSE, 1), FARTHEST)
