"""Turn batches of a table into samples; bad rows are refused, or kept and marked."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.errors import SourceError
from twin.quality import BREAK, Quality, mark
from twin.signals import LastRow, Samples
from twin.tables.date_time import Calendar
from twin.tables.layout import COMMANDS, REPORTED, Layout
from twin.tables.numbers import Mask
from twin.tables.settings import DIGITS, Bad, Column, ImportSettings
from twin.tables.table_to_samples import Batch, Spoilt, decode

_USUAL = 1_000_000  # ns, the period while none is known
_LONGEST = 2**62  # ns, of a period: longer ones would overflow

_SHOULD_BE = {
    **dict.fromkeys(DIGITS, "a time"),
    **dict.fromkeys((*COMMANDS, *REPORTED), "0 or 1"),
    Column.TIME_NS: "a whole number",
    Column.HOST_NS: "a whole number",
    Column.SEQUENCE: "a whole number",
    Column.QUALITY: "a sum of quality flags",
}


class _Breaks(NamedTuple):
    """Rows before which the stream breaks, unless their quality already says so."""

    clock: Mask  # time does not go forward
    restart: Mask  # the sequence does not go forward
    gap: Mask
    missing: npt.NDArray[np.int64]  # samples, before each row


class _Trouble(NamedTuple):
    row: int
    column: Column
    text: str
    setting: str  # that would let it pass


@dataclass
class Intake:
    """Takes the rows of one file, batch by batch; ``ambient`` in Pa."""

    layout: Layout
    settings: ImportSettings
    ambient: float
    calendar: Calendar
    _last: LastRow = field(default_factory=LastRow)
    _period: int | None = None  # ns

    def __post_init__(self) -> None:
        if self.settings.period_ms is not None:
            self._period = max(1, round(self.settings.period_ms * 1e6))

    def take(self, batch: Batch) -> Samples:
        """Give as many samples as there are rows; SourceError for the first one refused."""
        rows, bad = decode(batch, self.layout, self.ambient, self.calendar)
        run = np.concatenate((self._last.row, rows))
        rows = run[len(self._last.row) :]
        self._replace(run, bad, batch)
        breaks = self._find_breaks(run)
        self._refuse(batch, bad, breaks)
        mark(rows["quality"], np.any(list(bad.values()), axis=0), Quality.BAD)
        mark(rows["quality"], breaks.clock, Quality.CLOCK)
        mark(rows["quality"], breaks.restart, Quality.RESTART)
        mark(rows["quality"], breaks.gap, Quality.GAP)
        self._last.keep(rows)
        return rows

    # --- values that cannot be NaN continue from the row before ---------------------------------

    def _replace(self, run: Samples, bad: Spoilt, batch: Batch) -> None:
        lead = len(run) - batch.count
        good = {name: np.concatenate((np.ones(lead, bool), ~mask)) for name, mask in bad.items()}
        timed = good[self.layout.time]
        if timed.any():
            self._learn_period(run["time_ns"], timed)
            _interpolate(run["time_ns"], timed, self._period or _USUAL)
        elif self.settings.values is Bad.MARK:
            message = f"{batch.location(0)}: none of {batch.count} rows from here on has a time"
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

    def _learn_period(self, times: npt.NDArray[np.int64], timed: Mask) -> None:
        """Take the period from the first batch that has a step."""
        if self._period is None:
            steps = _distance(times)[timed[1:] & timed[:-1] & (times[1:] > times[:-1])]
            self._period = min(int(np.median(steps)), _LONGEST) if len(steps) else None

    def _count(self, run: Samples, lead: int) -> None:
        """Number the rows; missing rows leave out their numbers."""
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
        onward = (sequence[1:] > sequence[:-1]) | (Column.SEQUENCE not in self.layout.file_names)
        missing = (_distance(sequence) - np.uint64(1)).view(np.int64)
        marked = (run["quality"][1:] & BREAK) != 0
        first = int(len(self._last.row) == 0)  # 1 if no row comes before
        return _Breaks(
            np.pad((times[1:] <= times[:-1]) & ~marked, (first, 0)),
            np.pad(~onward & ~marked, (first, 0)),
            np.pad(onward & (missing != 0) & ~marked, (first, 0)),
            np.pad(missing, (first, 0)),
        )

    def _missing(self, times: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Number of samples missing before each row, from the second one on, by time."""
        period = np.uint64(self._period or _LONGEST)
        half = (period + np.uint64(1)) // np.uint64(2)
        missing = (np.maximum(_distance(times), half) - half) // period
        return np.where(times[1:] > times[:-1], missing, np.uint64(0)).view(np.int64)

    # --- refusing -------------------------------------------------------------------------------

    def _refuse(self, batch: Batch, bad: Spoilt, breaks: _Breaks) -> None:
        """SourceError for the first row that the settings do not let pass."""
        troubles: list[_Trouble] = []
        if self.settings.values is Bad.REFUSE:
            troubles += _bad_cells(batch, bad, self.calendar)
        if self.settings.jumps is Bad.REFUSE:
            troubles += self._jumps(batch, breaks)
        if self.settings.gaps is Bad.REFUSE:
            troubles += self._gaps(breaks)
        if troubles:
            row, column, text, setting = min(troubles, key=lambda trouble: trouble.row)
            text = batch.broken.get(row, f"column {self.layout.file_names[column]!r}: {text}")
            hint = f'mend the file, or {setting} = "mark" under [import] keeps such rows, marked'
            raise SourceError(f"{batch.location(row)}: {text}", hint)

    def _jumps(self, batch: Batch, breaks: _Breaks) -> list[_Trouble]:
        troubles = []
        for name, mask in ((self.layout.time, breaks.clock), (Column.SEQUENCE, breaks.restart)):
            if mask.any():
                row = int(mask.argmax())
                text = f"{batch.cell(row, name)!r} does not go forward from the row before"
                troubles.append(_Trouble(row, name, text, "jumps"))
        return troubles

    def _gaps(self, breaks: _Breaks) -> list[_Trouble]:
        if not breaks.gap.any():
            return []
        row = int(breaks.gap.argmax())
        counted = Column.SEQUENCE in self.layout.file_names
        text = f"{breaks.missing[row]} samples are missing before this row"
        if not counted:
            text += f", at a period of {(self._period or 0) * 1e-6:g} ms"
        return [_Trouble(row, Column.SEQUENCE if counted else self.layout.time, text, "gaps")]


def _bad_cells(batch: Batch, bad: Spoilt, calendar: Calendar) -> list[_Trouble]:
    troubles = []
    for name, mask in bad.items():
        if mask.any():
            row = int(mask.argmax())
            cell = "" if row in batch.broken else batch.cell(row, name)
            should_be = _SHOULD_BE.get(name, "a finite number")
            if name is Column.TIME:
                should_be = calendar.should_be
            text = f"{cell!r} is not {should_be}" if cell else "the cell is empty"
            troubles.append(_Trouble(row, name, text, "values"))
    return troubles


def _carry_on(values: npt.NDArray[np.integer], good: Mask, step: int) -> None:
    """Replace bad values: count on by ``step`` from the last good one, or back from the first."""
    rows = np.arange(len(values))
    source = np.maximum.accumulate(np.where(good, rows, good.argmax()))
    values[~good] = (values[source] + step * (rows - source)).astype(values.dtype)[~good]


def _interpolate(times: npt.NDArray[np.int64], timed: Mask, period: int) -> None:
    """Fill in missing times: evenly between known ones, by the period before and after them."""
    rows, anchors = np.arange(len(times)), np.flatnonzero(timed)
    elapsed = np.interp(rows, anchors, times[anchors] - times[anchors[0]])
    elapsed += period * (rows - rows.clip(anchors[0], anchors[-1]))
    with np.errstate(invalid="ignore"):  # centuries between two rows
        times[~timed] = times[anchors[0]] + np.rint(elapsed).astype(np.int64)[~timed]


def _distance(values: npt.NDArray[np.int64]) -> npt.NDArray[np.uint64]:
    """Increase from row to row; as unsigned numbers no increase overflows."""
    numbers: npt.NDArray[np.uint64] = values.view(np.uint64)
    return numbers[1:] - numbers[:-1]
