"""Rows averaged into bins that suit how a model errs.

What a model gets wrong after a switching goes on for about as long as the switching is past. So
bins, correlations and all else run in warped time: logarithmic from an edge on, then uniform.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model.compiled import compiled
from twin.model.term import kinds
from twin.signals import MS

EARLIEST_S, LATEST_S = 5e-3, 0.3  # how long an error goes on, at an edge and long after it
PER_UNIT = 4  # bins in each unit of warped time
SPARSE, FARTHEST = 20, 10  # rows kept: one in as many as a SPARSEth of those past, at most FARTHEST
Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Bins:
    """What each bin is, in order of time; no bin crosses a phase change."""

    number: Ints  # of the bin of each row; -1 where nothing can be compared
    count: Ints  # rows
    cycle: Ints
    stretch: Ints  # of one phase, counted over all rows
    kind: Ints  # of stretch, index into KINDS
    time: Floats  # warped, since the stretch began
    place: Ints  # the same number for what is alike from cycle to cycle: kind and time

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


@compiled
def _add_lines(number, kept, values, sums):  # type: ignore[no-untyped-def]
    """Add what lines through ``values`` are at each row to the sum of its bin."""
    for after in range(len(kept)):
        before = max(after - 1, 0)
        first, last = kept[before], kept[after]
        left, right = values[before], values[after]
        for row in range(first + 1, last):
            if number[row] >= 0:
                share = (last - row) / (last - first)
                total = sums[number[row]]
                for i in range(len(total)):
                    total[i] += share * left[i] + (1.0 - share) * right[i]
        if number[last] >= 0:  # whatever is beside it
            total = sums[number[last]]
            for i in range(len(total)):
                total[i] += right[i]


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


def binned(
    phase: npt.NDArray[np.uint8],
    usable: npt.NDArray[np.bool_],
    starts: Ints,
    per_unit: int = PER_UNIT,
) -> Bins:
    """Bins of rows whose phases are given; ``starts`` are the first rows of cycles.

    What comes before the first of them belongs to cycle -1.
    """
    begins = _changes(phase)
    begins[starts[starts < len(phase)]] = True
    first = np.flatnonzero(begins)
    stretch = np.cumsum(begins) - 1
    time = warped((np.arange(len(phase)) - first[stretch]) * MS)
    step = np.floor(time * per_unit).astype(np.int64)
    place = (stretch << 16) + step
    used = np.flatnonzero(usable)
    new = _changes(place[used])  # places only grow
    at = np.flatnonzero(new)
    here, count = used[at], np.diff(np.append(at, len(used)))
    kind = kinds(phase[first], phase[np.maximum(first - 1, 0)])[stretch[here]]
    result = np.full(len(phase), -1)
    result[used] = np.cumsum(new) - 1
    cycle = np.searchsorted(starts, here, "right") - 1
    alike = (kind << 16) + step[here]
    return Bins(result, count, cycle, stretch[here], kind, time[here], alike)


def _changes(values: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Where a value is not the one before it; so is the first one."""
    changes = np.ones(len(values), np.bool_)
    np.not_equal(values[1:], values[:-1], out=changes[1:])
    return changes


def sparse(begins: npt.NDArray[np.bool_]) -> Ints:
    """Rows that suffice to draw a curve whose bends begin at some rows: fewer, the later after."""
    rows = np.arange(len(begins))
    since = rows - np.maximum.accumulate(np.where(begins, rows, 0))
    kept = drawn(since) | np.roll(begins, -1)  # the last ones before as well
    kept[-1:] = True
    return np.flatnonzero(kept)


def drawn(since: Ints) -> npt.NDArray[np.bool_]:
    """Whether a row is one of those, by how many rows ago a bend began."""
    late = since - _LAST
    found: npt.NDArray[np.bool_] = _IS_EARLY[np.minimum(since, _LAST + 1)]
    found |= (late > 0) & (late % FARTHEST == 0)
    return found


def _early() -> list[int]:
    """The first of them, until they are as far apart as they get."""
    offsets = [0]
    while offsets[-1] < SPARSE * FARTHEST:
        offsets.append(offsets[-1] + max(offsets[-1] // SPARSE, 1))
    return offsets


_LAST = _early()[-1]
_IS_EARLY = np.isin(np.arange(_LAST + 2), _early())  # and one that is late
