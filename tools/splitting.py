"""How often sums over healthy cycles exceed their limit, by multilevel splitting (RESTART).

An alarm in a month is one in a million cycles. Between nothing and the limit lie levels, each
``COPIES`` times the one before. A device whose sum rises above a level goes on as that many copies,
each of which counts as much less; a copy ends when its sum falls below the level at which it began.
So many see an alarm, and their weighted number is that of alarms without any copies.

Cycles are drawn from simulated ones in stretches of random length (the stationary bootstrap), so
that a cycle follows the one that it followed.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.monitor.change_detection import ChangeDetector, limit

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

COPIES = 3
LOWEST = 1.0  # logarithm of the sum, above which copies are made; healthy cycles reach 2 to 3
STRETCH = 10.0  # mean number of cycles in a row: gas and walls keep their heat for one or two
SETTLES = 300  # cycles from a start until the sums are those of a device that runs


class Split(NamedTuple):
    """The result of a splitting."""

    times: float  # alarms over the wanted number
    cycles: int  # of all devices and copies


@dataclass
class _Devices:
    """Devices and their copies, a row each."""

    at: Ints  # the cycle that each is at
    born: Ints  # level at which a copy began; 0 for a device
    level: Ints  # level that its sum is at

    def select(self, rows: Ints, born: Ints, level: Ints) -> None:
        """Go on with these rows."""
        self.at, self.born, self.level = self.at[rows], born, level[rows]


def rate(
    scores: Floats,
    changes: ChangeDetector,
    wanted: float,
    rng: np.random.Generator,
    *,
    devices: int,
    cycles: int,
) -> Split:
    """Alarms over the wanted number, which is one in ``wanted`` cycles.

    ``scores`` are the normal scores of healthy cycles, (cycles, suspects). As many ``devices`` run
    for so many ``cycles`` each; the first SETTLES do not count.
    """
    highest = limit(wanted)
    levels = np.arange(highest - np.log(COPIES), LOWEST, -np.log(COPIES))[::-1]
    rows = _Devices(rng.integers(len(scores), size=devices), *np.zeros((2, devices), np.int64))
    changes.take(np.full((devices, scores.shape[1]), np.nan))  # as many as that
    alarms, run = 0.0, 0
    for cycle in range(cycles):
        _next(rows, len(scores), rng)
        changes.take(scores[rows.at])
        sums = changes.log_sums
        run += len(sums)
        raised = sums >= highest
        if cycle >= SETTLES:
            alarms += float(np.sum(float(COPIES) ** -rows.level[raised]))
        changes.begin_some(raised)
        level = np.where(raised, 0, np.searchsorted(levels, sums, side="right"))
        kept, born = _split(rows, level, len(levels))
        changes.go_on_with(kept)
        rows.select(kept, born, level)
    return Split(alarms * wanted / devices / (cycles - SETTLES), run)


def _next(rows: _Devices, cycles: int, rng: np.random.Generator) -> None:
    """Draw the next cycle of each device: the one that follows, or any."""
    jumps = rng.random(len(rows.at)) < 1.0 / STRETCH
    drawn = rng.integers(cycles, size=len(rows.at))
    rows.at = np.where(jumps, drawn, (rows.at + 1) % cycles)


def _split(rows: _Devices, level: Ints, levels: int) -> tuple[Ints, Ints]:
    """The rows to go on with, and where each began: ended copies left out, new ones added."""
    kept = np.flatnonzero(level >= rows.born)
    born = rows.born[kept]
    for number in range(1, levels + 1):
        crosses = (level[kept] >= number) & (rows.level[kept] < number)
        copies = np.repeat(kept[crosses], COPIES - 1)
        kept = np.concatenate([kept, copies])
        born = np.concatenate([born, np.full(len(copies), number)])
    return kept, born
