"""Batches of a table in, samples out: what is bad in them is refused, or kept and marked."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.errors import SourceError
from twin.signals import BREAK, SAMPLE, Quality, Samples
from twin.tables.date_time import Calendar
from twin.tables.decode import Batch, Spoilt, decode
from twin.tables.layout import COMMANDS, DIGITS, REPORTED, Layout
from twin.tables.numbers import Mask
from twin.tables.settings import Bad, Column, ImportSettings

_USUAL = 1_000_000  # ns, the period while none is known
_LONGEST = 2**62  # ns, of a period: longer ones cannot be counted with

_SHOULD_BE = {
    **dict.fromkeys(DIGITS, "a time"),
    **dict.fromkeys((*COMMANDS, *REPORTED), "0 or 1"),
    Column.TIME_NS: "a whole number",
    Column.HOST_NS: "a whole number",
    Column.SEQUENCE: "a whole number",
    Column.QUALITY: "a sum of quality flags",
}


class _Breaks(NamedTuple):
    """Rows before which the stream breaks off and whose quality does not say so itself."""

    clock: Mask  # time does not go forward
    restart: Mask  # the sequence does not go forward
    gap: Mask
    missing: npt.NDArray[np.int64]  # samples, before each row


class _Trouble(NamedTuple):
    row: int
    column: Column
    what: str
    setting: str  # that lets it pass


@dataclass
class Intake:
    """The rows of one file, batch after batch; ``ambient`` in Pa."""

    layout: Layout
    settings: ImportSettings
    ambient: float
    calendar: Calendar
    _last: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))  # row taken
    _period: int | None = None  # ns

    def __post_init__(self) -> None:
        if self.settings.period_ms is not None:
            self._period = max(1, round(self.settings.period_ms * 1e6))

    def take(self, batch: Batch) -> Samples:
        """Give as many samples as there are rows; SourceError for the first one refused."""
        rows, bad = decode(batch, self.layout, self.ambient, self.calendar)
        run = np.concatenate((self._last, rows))
        rows = run[len(self._last) :]
        self._replace(run, bad, batch)
        breaks = self._find_breaks(run)
        self._refuse(batch, bad, breaks)
        rows["quality"][np.any(list(bad.values()), axis=0)] |= Quality.BAD.value
        rows["quality"][breaks.clock] |= Quality.CLOCK.value
        rows["quality"][breaks.restart] |= Quality.RESTART.value
        rows["quality"][breaks.gap] |= Quality.GAP.value
        self._last = rows[-1:].copy()
        return rows

    # --- what cannot be NaN goes on from the row before -----------------------------------------

    def _replace(self, run: Samples, bad: Spoilt, batch: Batch) -> None:
        lead = len(run) - batch.count
        good = {name: np.concatenate((np.ones(lead, bool), ~mask)) for name, mask in bad.items()}
        known = good[self.layout.time]
        if known.any():
            self._learn_period(run["time_ns"], known)
            _interpolate(run["time_ns"], known, self._period or _USUAL)
        elif self.settings.values is Bad.MARK:
            message = f"{batch.place(0)}: none of {batch.count} rows from here on has a time"
            raise SourceError(message, "check the column of time and its unit")
        if Column.SEQUENCE in good:
            _carry_on(run["sequence"], good[Column.SEQUENCE], 1)
        else:
            self._count(run, lead)
        for name, bit in COMMANDS.items():
            if name not in good:
                continue
            read = run["commands"] & bit.value
            state = read.copy()
            _carry_on(state, good[name], 0)
            run["commands"] ^= read ^ state
        guessed = ~good.get(Column.HOST_NS, np.arange(len(run)) < lead)
        run["host_ns"][guessed] = run["time_ns"][guessed]

    def _learn_period(self, times: npt.NDArray[np.int64], known: Mask) -> None:
        """From the first batch that has a step."""
        if self._period is None:
            steps = _distance(times)[known[1:] & known[:-1] & (times[1:] > times[:-1])]
            self._period = min(int(np.median(steps)), _LONGEST) if len(steps) else None

    def _count(self, run: Samples, lead: int) -> None:
        """Number the rows, leaving out the numbers of those that are missing."""
        steps = np.ones(len(run), np.int64)
        steps[1:] += self._missing(run["time_ns"])
        if lead:
            steps[0] = run["sequence"][0]
        else:
            steps[:1] = 0
        run["sequence"] = steps.cumsum()

    # --- where the stream breaks off ------------------------------------------------------------

    def _find_breaks(self, run: Samples) -> _Breaks:
        times, sequence = run["time_ns"], run["sequence"]
        onward = (sequence[1:] > sequence[:-1]) | (Column.SEQUENCE not in self.layout.theirs)
        missing = (_distance(sequence) - np.uint64(1)).view(np.int64)
        told = (run["quality"][1:] & BREAK) != 0
        first = int(len(self._last) == 0)  # nothing is before it
        return _Breaks(
            np.pad((times[1:] <= times[:-1]) & ~told, (first, 0)),
            np.pad(~onward & ~told, (first, 0)),
            np.pad(onward & (missing != 0) & ~told, (first, 0)),
            np.pad(missing, (first, 0)),
        )

    def _missing(self, times: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Samples missing before each row, from the second one, by time."""
        period = np.uint64(self._period or _LONGEST)
        half = (period + np.uint64(1)) // np.uint64(2)
        missing = (np.maximum(_distance(times), half) - half) // period
        return np.where(times[1:] > times[:-1], missing, np.uint64(0)).view(np.int64)

    # --- refusing -------------------------------------------------------------------------------

    def _refuse(self, batch: Batch, bad: Spoilt, breaks: _Breaks) -> None:
        """SourceError for the first row with something that the settings do not let pass."""
        found: list[_Trouble] = []
        if self.settings.values is Bad.REFUSE:
            found += _bad_cells(batch, bad, self.calendar)
        if self.settings.jumps is Bad.REFUSE:
            found += self._jumps(batch, breaks)
        if self.settings.gaps is Bad.REFUSE:
            found += self._gaps(breaks)
        if found:
            row, column, what, setting = min(found, key=lambda trouble: trouble.row)
            what = batch.broken.get(row, f"column {self.layout.theirs[column]!r}: {what}")
            hint = f'mend the file, or {setting} = "mark" under [import] keeps such rows, marked'
            raise SourceError(f"{batch.place(row)}: {what}", hint)

    def _jumps(self, batch: Batch, breaks: _Breaks) -> list[_Trouble]:
        found = []
        for name, mask in ((self.layout.time, breaks.clock), (Column.SEQUENCE, breaks.restart)):
            if mask.any():
                row = int(mask.argmax())
                what = f"{batch.cell(row, name)!r} does not go forward from the row before"
                found.append(_Trouble(row, name, what, "jumps"))
        return found

    def _gaps(self, breaks: _Breaks) -> list[_Trouble]:
        if not breaks.gap.any():
            return []
        row = int(breaks.gap.argmax())
        counted = Column.SEQUENCE in self.layout.theirs
        what = f"{breaks.missing[row]} samples are missing before this row"
        if not counted:
            what += f", at a period of {(self._period or 0) * 1e-6:g} ms"
        return [_Trouble(row, Column.SEQUENCE if counted else self.layout.time, what, "gaps")]


def _bad_cells(batch: Batch, bad: Spoilt, calendar: Calendar) -> list[_Trouble]:
    found = []
    for name, mask in bad.items():
        if mask.any():
            row = int(mask.argmax())
            cell = "" if row in batch.broken else batch.cell(row, name)
            should_be = _SHOULD_BE.get(name, "a finite number")
            if name is Column.TIME:
                should_be = calendar.should_be
            what = f"{cell!r} is not {should_be}" if cell else "the cell is empty"
            found.append(_Trouble(row, name, what, "values"))
    return found


def _carry_on(values: npt.NDArray[np.integer], good: Mask, step: int) -> None:
    """Let values that are not good go on, in steps, from the last good one or to the first."""
    at = np.arange(len(values))
    known = np.maximum.accumulate(np.where(good, at, good.argmax()))
    values[~good] = (values[known] + step * (at - known)).astype(values.dtype)[~good]


def _interpolate(times: npt.NDArray[np.int64], known: Mask, period: int) -> None:
    """Fill in the times between known ones evenly, before and behind them in steps of a period."""
    at, good = np.arange(len(times)), np.flatnonzero(known)
    since = np.interp(at, good, times[good] - times[good[0]])
    since += period * (at - at.clip(good[0], good[-1]))
    with np.errstate(invalid="ignore"):  # centuries between two rows
        times[~known] = times[good[0]] + np.rint(since).astype(np.int64)[~known]


def _distance(values: npt.NDArray[np.int64]) -> npt.NDArray[np.uint64]:
    """From row to row, where it goes up: no difference is too large for it."""
    numbers: npt.NDArray[np.uint64] = values.view(np.uint64)
    return numbers[1:] - numbers[:-1]
