"""Phases from commands and pressure, with switchings of the air saving that the PLC does not see.

A compact ejector switches its nozzle off at H1 and on again below it by itself. The switching shows
as a breakpoint in the pressure: its slope changes. The finder fits a straight line on each side, so
its output lags behind the measurement where there may be a breakpoint. The model steps only over
rows whose phase is known, and is synchronised to the measured level at each breakpoint. Rows that
cannot be at a breakpoint are given out at once.

If suction ends too soon after a switching, the breakpoint does not show. Then the level decides:
the nozzle went off where the pressure fell below the level of the last switching.

If the ejector reports its nozzle, breakpoints are searched about its reports and nowhere else. If
the pressure does not show a reported switching, it is placed where the valve must have acted. In a
diagnosis, the switchings found in the whole log take the place of reports.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from twin.model import theta as c
from twin.model.compiled import compiled, per_row
from twin.model.control import effective_commands, new_timer
from twin.quality import BREAK, UNUSABLE
from twin.signals import MBAR, MS, NS, SAMPLE, Phase, Reported, Samples, joined

_Floats = npt.NDArray[np.float64]
_Bytes = npt.NDArray[np.uint8]

IDLE_ROWS = 20  # rows of idle whose mean is the level before a cycle
FEWEST_IDLE_ROWS = 5
SIGNIFICANT = 7.0  # least sigmas of a breakpoint's change of slope
JUMP = 8.0  # times the noise; a larger change from row to row is no breakpoint
ALONE = 2.0  # least ratio of a jump to the changes beside it: a ringing line rises for longer
BEYOND = 10.0 * MBAR  # Pa below the last switching level; in a record that scatters by 2 mbar rms
SHORTEST_WINDOW = 8  # rows
MOST_MISSING = 0.5  # largest share of unusable rows in a line

# Indices of the finder's state.
# Ages are in rows; that of suction restarts at a breakpoint, and is −1 without a suction command.
# The level of the last breakpoint is NaN before the first one of a suction.
_NOZZLE, _AGE, _BEST, _BEST_AGE, _BEST_LEVEL, _BREAK_LEVEL = range(6)
_IDLE_AGE, _IDLE_SUM, _ANCHORED = range(6, 9)
# In this suction: breakpoints, rows since it began, reported switchings that were overdue, and the
# reported nozzle after these (1 on, 0 off, -1 none yet).
_SWITCHED, _SINCE, _REPORTS, _SAID = range(9, 13)
_OFF_LEVEL = 13  # pressure when the nozzle last went off, in this or an earlier suction; or NaN
_BEGINNING = (0.0, -1.0, 0.0, 0.0, 0.0, math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, math.nan)
_KNOWN, _ON = int(Reported.NOZZLE_KNOWN), int(Reported.NOZZLE_KNOWN | Reported.NOZZLE)
_IDLE, _SUCTION, _HOLD, _BLOW_OFF = (int(phase) for phase in Phase)


@dataclass(frozen=True)
class DetectorSettings:
    """Settings of the detector: rows of the window, noise (Pa), delays from valve to breakpoint.

    Rows come each ``period`` (s). The nozzle's closing shows ``off_shift`` rows later, its opening
    ``on_shift``. No breakpoint is searched in the first ``settled`` rows of suction. The next
    breakpoint is at least ``again`` rows after the last one, and ``apart`` (Pa) from it. A window
    of more than ``longest`` rows could take the approach of the end pressure for a breakpoint. If
    the ejector reports its nozzle, a breakpoint is within ``about`` rows of the report, and the
    valve acts ``acts`` rows after it (closing, opening). In a free run the detector sees the nozzle
    go off at ``goes_off`` (Pa); NaN if it does not.
    """

    window: int
    noise: float
    off_shift: int
    on_shift: int
    settled: int
    again: int
    longest: int
    apart: float = 0.0
    blow_off: tuple[float, float] = (float(c.EXTERNAL), 0.0)  # the ejector's own: mode, pulse (s)
    about: int = 50
    acts: tuple[int, int] = (10, 10)
    period: float = MS
    goes_off: float = math.nan

    @property
    def settles(self) -> int:
        """Rows that must follow a breakpoint to show the whole peak of its significance."""
        return self.window + self.window // 2

    @property
    def lag(self) -> int:
        """Largest lag of the finder in rows: to see the peak, and to reach back by the shift."""
        return self.settles + max(self.off_shift, self.on_shift) + 1


@per_row
def _line(pressure: _Floats, start: int, rows: int) -> tuple[float, float]:
    """Slope (Pa per row) and mean of a straight line through ``rows`` values from ``start``.

    Unusable values (NaN) are left out; with too many of them the result is NaN.
    """
    total, moment, missing = 0.0, 0.0, 0
    middle, half = 0.5 * (rows - 1), rows // 2
    for i in range(half):  # from both ends inwards
        early, late = pressure[start + i], pressure[start + rows - 1 - i]
        total += early + late
        moment += (middle - i) * (late - early)
    total += pressure[start + half] if rows % 2 else 0.0
    if not math.isnan(total):
        return moment * 12.0 / (rows * (rows * rows - 1.0)), total / rows
    total, moment = 0.0, 0.0
    for i in range(rows):
        if math.isnan(pressure[start + i]):
            missing += 1
        else:
            total += pressure[start + i]
            moment += (i - middle) * pressure[start + i]
    if missing > MOST_MISSING * rows:
        return math.nan, math.nan
    offset_sum, offset_squares = 0.0, 0.0  # of usable rows, about the middle
    for i in range(rows):
        if not math.isnan(pressure[start + i]):
            offset_sum += i - middle
            offset_squares += (i - middle) ** 2
    usable = rows - missing
    slope = (usable * moment - offset_sum * total) / (
        usable * offset_squares - offset_sum * offset_sum
    )
    return slope, (total - slope * offset_sum) / usable


@compiled
def _greatest_jump(pressure: _Floats, first: int, last: int) -> tuple[int, float]:
    """Row after the largest isolated jump of the pressure, and its height (Pa)."""
    row, greatest = first, 0.0
    before, change, at = 0.0, 0.0, first
    for i in range(first, last + 1):
        after = pressure[i + 1] - pressure[i] if i < last else 0.0
        if after == 0.0 and i < last:  # a sensor slower than the rows holds its reading
            continue
        jump = abs(change - 0.5 * (before + after))
        alone = abs(change) > ALONE * max(abs(before), abs(after))
        if alone and jump > greatest:
            row, greatest = at, jump
        before, change, at = change, after, i
    return row, greatest


@compiled
def _bends_at(pressure: _Floats, first: int, jump: int, last: int, noise: float) -> float:
    """Significance of the difference in slope before and after a jump, without the jump."""
    before, after = jump + 1 - first, last - jump
    if min(before, after) < SHORTEST_WINDOW // 2:
        return 0.0
    left, _ = _line(pressure, first, before)
    right, _ = _line(pressure, jump + 1, after)
    return (right - left) / (noise * math.sqrt(12.0 / before**3 + 12.0 / after**3))


@per_row
def _break_at(
    pressure: _Floats, row: int, window: int, noise: float, nozzle_on: bool
) -> tuple[float, float]:
    """Significance of the slope's break at ``row`` and the level there; 0 if it is no breakpoint.

    Nozzle going off: the pressure fell, and stops falling. Nozzle going on: it begins to fall.
    Slopes also differ across a jump (a loose sensor), so that is excluded.
    """
    sigma = noise * math.sqrt(12.0 / float(window + 1) ** 3)
    right, _ = _line(pressure, row, window + 1)
    may_follow = right > -3.0 * sigma if nozzle_on else right < -3.0 * sigma
    if not may_follow:  # so for nearly all rows: saves the line before
        return 0.0, math.nan
    left, left_mean = _line(pressure, row - window, window + 1)
    significance = (right - left) / (math.sqrt(2.0) * sigma)
    if nozzle_on:
        is_breakpoint = left < 3.0 * sigma
    else:
        significance = -significance
        is_breakpoint = left > -3.0 * sigma
    level = left_mean + left * window / 2.0  # by the line before: the pressure may ring after it
    if not is_breakpoint or significance < SIGNIFICANT:
        return 0.0, level
    jump, height = _greatest_jump(pressure, row - window, row + window)
    if height > JUMP * noise:
        bend = _bends_at(pressure, row - window, jump, row + window, noise)
        if (bend if nozzle_on else -bend) < SIGNIFICANT:
            return 0.0, level
    return significance, level


@compiled
def _find(
    state: _Floats,
    pressure: _Floats,
    reported: _Bytes,
    commands: _Bytes,
    first: int,
    settings: _Floats,
    phase: _Bytes,
    level: _Floats,
) -> int:
    """Fill ``phase`` and ``level`` from ``first`` on; returns the first row that needs later ones.

    ``settings`` = window, noise, off shift, on shift, settled, again, apart, about, acts (2).
    Window 0 searches none (at the end of a stretch, where the rows after are missing). A breakpoint
    changes phases back by its shift.
    """
    window, settled = int(settings[0]), settings[4]
    end = first  # first row after those with the same command
    for row in range(first, len(pressure)):
        if row == end:
            end = _end_of(commands, row)
        suction = commands[row] & 1 and not commands[row] & 2
        starts = suction and state[_AGE] < 0.0
        may_bend = suction and window > 0 and state[_AGE] >= settled + window
        same = end - row - 1
        is_told = suction and reported[row] & _KNOWN
        if same < _rows_behind(may_bend, is_told, settings) and end == len(commands):
            return row
        if suction:
            state[_AGE] = 0.0 if starts else state[_AGE] + 1.0
        else:
            state[_AGE] = -1.0
        if starts:
            _start(state, pressure, row, level)
        if commands[row] == 0:
            _idle(state, pressure, row, level)
            phase[row] = _IDLE
        else:
            state[_IDLE_AGE] = state[_IDLE_SUM] = 0.0
            phase[row] = _BLOW_OFF if commands[row] & 2 else _HOLD
            if suction and state[_NOZZLE] > 0.0:
                phase[row] = _SUCTION
        if suction and window > 0:
            looks = may_bend and same >= window
            _track_break(state, pressure, reported[:end], row, settings, looks, phase, level)
            if is_told:
                _follow_reports(state, pressure, reported, row, settings, same == 0, phase, level)
            else:
                _decide_by_level(state, pressure, row, settings, may_bend and same == 0, phase)
    return len(pressure)


@compiled
def _rows_behind(may_bend: bool, is_told: bool, settings: _Floats) -> int:
    """Rows with the same command that must follow a row before it is searched."""
    window = int(settings[0])
    if may_bend:
        return max(window, int(settings[7])) if is_told else window
    return 1 if is_told and window > 0 else 0


@per_row
def _start(state: _Floats, pressure: _Floats, row: int, level: _Floats) -> None:
    """Begin a suction, with the nozzle on."""
    state[_NOZZLE], state[_BEST], state[_BREAK_LEVEL] = 1.0, 0.0, math.nan
    state[_SWITCHED] = state[_REPORTS] = 0.0
    state[_SINCE] = state[_SAID] = -1.0
    if state[_IDLE_AGE] >= FEWEST_IDLE_ROWS:
        level[row] = _idle_level(state, pressure, row)
        state[_ANCHORED] = 1.0


@compiled
def _end_of(commands: _Bytes, row: int) -> int:
    """The first row after ``row`` with another command."""
    end = row + 1
    while end < len(commands) and commands[end] == commands[row]:
        end += 1
    return end


@compiled
def _unsettled(state: _Floats, settings: _Floats) -> int:
    """Number of searched rows that a later breakpoint may still change."""
    if state[_AGE] < 0.0 or settings[0] == 0.0:
        return 0
    reach = int(settings[2] if state[_NOZZLE] > 0.0 else settings[3])
    reach += int(state[_BEST_AGE]) + 1 if state[_BEST] > 0.0 else 0
    return max(reach, _overdue(settings)) if state[_SINCE] >= 0.0 else reach


@per_row
def _idle(state: _Floats, pressure: _Floats, row: int, level: _Floats) -> None:
    """Keep the mean of the last idle rows; the first mean of a stretch sets the model."""
    if math.isnan(pressure[row]):
        return
    if state[_IDLE_AGE] >= IDLE_ROWS:  # drop the oldest row
        state[_IDLE_SUM] -= state[_IDLE_SUM] / state[_IDLE_AGE]
        state[_IDLE_AGE] -= 1.0
    state[_IDLE_SUM] += pressure[row]
    state[_IDLE_AGE] += 1.0
    if state[_ANCHORED] == 0.0 and state[_IDLE_AGE] >= IDLE_ROWS:
        level[row] = _idle_level(state, pressure, row + 1)
        state[_ANCHORED] = 1.0


@compiled
def _idle_level(state: _Floats, pressure: _Floats, row: int) -> float:
    """Pressure (Pa) at ``row`` by a line through the idle rows: gas in a closed vessel may cool."""
    mean = state[_IDLE_SUM] / state[_IDLE_AGE]
    if state[_IDLE_AGE] < IDLE_ROWS or row < IDLE_ROWS:
        return mean
    slope, middle = _line(pressure, row - IDLE_ROWS, IDLE_ROWS)
    level = middle + slope * 0.5 * (IDLE_ROWS + 1)
    return mean if math.isnan(level) else level


@per_row
def _track_break(
    state: _Floats,
    pressure: _Floats,
    reported: _Bytes,
    row: int,
    settings: _Floats,
    may_bend: bool,
    phase: _Bytes,
    level: _Floats,
) -> None:
    """Track the break's significance over the rows, and set a breakpoint at its peak."""
    window, noise, nozzle_on = int(settings[0]), settings[1], state[_NOZZLE] > 0.0
    significance, break_level = 0.0, 0.0
    if may_bend:
        significance, break_level = _break_at(pressure, row, window, noise, nozzle_on)
        level_change = (
            break_level - state[_BREAK_LEVEL]
        )  # up while the nozzle is off, down while it is on
        if (-level_change if nozzle_on else level_change) < settings[6]:  # a line that rings
            significance = 0.0
        if significance > SIGNIFICANT and _is_denied(state, reported, row, settings):
            significance = 0.0
    if significance > max(state[_BEST], SIGNIFICANT):
        state[_BEST], state[_BEST_AGE], state[_BEST_LEVEL] = significance, 0.0, break_level
        return
    if state[_BEST] == 0.0:
        return
    state[_BEST_AGE] += 1.0
    if state[_BEST_AGE] >= window // 2:
        break_row = row - int(state[_BEST_AGE])
        shift = int(settings[2] if nozzle_on else settings[3])
        level[break_row] = state[_BREAK_LEVEL] = state[_BEST_LEVEL]
        phase[break_row - shift : row + 1] = _HOLD if nozzle_on else _SUCTION
        if nozzle_on:
            state[_OFF_LEVEL] = _level_before(pressure, break_row - shift)
        state[_NOZZLE], state[_BEST] = 0.0 if nozzle_on else 1.0, 0.0
        state[_SWITCHED] += 1.0
        state[_AGE] = (
            state[_BEST_AGE] + window + settings[4] - settings[5]
        )  # the valve has acted already


@per_row
def _level_before(pressure: _Floats, row: int) -> float:
    """Pressure (Pa) at ``row`` by a line through the rows up to it."""
    slope, middle = _line(pressure, max(row - SHORTEST_WINDOW + 1, 0), SHORTEST_WINDOW)
    return middle + 0.5 * (SHORTEST_WINDOW - 1) * slope


@per_row
def _decide_by_level(
    state: _Floats, pressure: _Floats, row: int, settings: _Floats, is_last: bool, phase: _Bytes
) -> None:
    """At the last row of a suction, decide by the pressure whether the nozzle went off.

    That is where the pressure fell below the one at which it went off before. If that was so long
    ago that the breakpoint would show, the nozzle did not go off.
    """
    fallen = state[_OFF_LEVEL] - pressure[row]
    least = max(SIGNIFICANT * settings[1], BEYOND)
    if not is_last or state[_NOZZLE] == 0.0 or not fallen > least:  # or one is NaN
        return
    window = int(settings[0])
    searched = int(state[_AGE] - settings[4]) - window
    first = max(row - min(window, searched) - int(settings[2]), 0)
    off = row
    while off >= first and not pressure[off] > state[_OFF_LEVEL]:
        off -= 1
    if off >= first:
        phase[off + 1 : row + 1] = _HOLD


@per_row
def _reported_switches(
    reported: _Bytes, first: int, last: int, begin: int, about: float, on: float
) -> tuple[int, float]:
    """Number of switchings that the ejector reports in some rows, and the nozzle after them.

    ``on`` is the nozzle before: 1 on, 0 off; -1 from the beginning of suction at ``begin`` until it
    is reported on, as reports may be late.
    """
    count = 0
    for row in range(max(first, 0), last):
        report = reported[row] & _ON
        if report & _KNOWN == 0:
            continue
        if on < 0.0:
            on = 1.0 if report == _ON or row - begin >= about else on
        if on >= 0.0 and (report == _ON) != (on > 0.0):
            count += 1
            on = 1.0 - on
    return count, on


@compiled
def _is_denied(state: _Floats, reported: _Bytes, row: int, settings: _Floats) -> bool:
    """Whether the ejector reports no switching about a row that belongs to no other breakpoint."""
    if reported[row] & _KNOWN == 0:
        return False
    about, begin = int(settings[7]), row - int(state[_SINCE])
    first = max(row - _overdue(settings), begin)
    new_reports, _ = _reported_switches(
        reported, first, min(row + about + 1, len(reported)), begin, about, state[_SAID]
    )
    return state[_REPORTS] + new_reports <= state[_SWITCHED]


@per_row
def _overdue(settings: _Floats) -> int:
    """Rows after which a reported switching that has not shown will not show."""
    return int(settings[7]) + int(settings[0]) // 2


@per_row
def _follow_reports(
    state: _Floats,
    pressure: _Floats,
    reported: _Bytes,
    row: int,
    settings: _Floats,
    is_last: bool,
    phase: _Bytes,
    level: _Floats,
) -> None:
    """Take the report that is overdue, or all at the last row of a suction."""
    state[_SINCE] += 1.0
    overdue_row, begin = row - _overdue(settings), row - int(state[_SINCE])
    for report_row in range(max(overdue_row, begin, 0), (row if is_last else overdue_row) + 1):
        _follow_report(state, pressure, reported, row, report_row, settings, phase, level)


@per_row
def _follow_report(
    state: _Floats,
    pressure: _Floats,
    reported: _Bytes,
    row: int,
    report_row: int,
    settings: _Floats,
    phase: _Bytes,
    level: _Floats,
) -> None:
    """Take a report of the past; if no breakpoint has shown it, set one by the report alone."""
    new_reports, state[_SAID] = _reported_switches(
        reported,
        report_row,
        report_row + 1,
        row - int(state[_SINCE]),
        settings[7],
        state[_SAID],
    )
    state[_REPORTS] += new_reports
    if new_reports == 0 or state[_REPORTS] <= state[_SWITCHED]:
        return
    nozzle_on, window = state[_NOZZLE] > 0.0, int(settings[0])
    acts = int(min(settings[8] if nozzle_on else settings[9], settings[7]))
    break_row = report_row + acts
    if break_row > row:  # suction ends first
        return
    level[break_row] = state[_BREAK_LEVEL] = _level_before(pressure, break_row)
    phase[break_row : row + 1] = _HOLD if nozzle_on else _SUCTION
    state[_NOZZLE], state[_BEST] = 0.0 if nozzle_on else 1.0, 0.0
    state[_SWITCHED] += 1.0
    # As after a breakpoint that shows.
    state[_AGE] = (row - break_row) + window + settings[4] - settings[5]


Found = tuple[Samples, npt.NDArray[np.uint8], npt.NDArray[np.float64]]


def commanded(samples: Samples, blow_off: tuple[float, float]) -> Found:
    """Phases of a whole record by commands alone, and levels before its cycles.

    ``blow_off`` is the ejector's own, as in ``DetectorSettings``.
    """
    finder = PhaseFinder(DetectorSettings(0, 0.0, 0, 0, 0, 0, 0, blow_off=blow_off))
    early, late = finder.push(samples), finder.flush()
    return (
        joined(early[0], late[0]),
        np.concatenate([early[1], late[1]]),
        np.concatenate([early[2], late[2]]),
    )


@dataclass
class PhaseFinder:
    """Gives blocks back a little later, with phases and synchronisation levels.

    ``nozzle`` replaces what the ejector reports of it: bits as in ``Reported`` of all rows to come.
    """

    detector: DetectorSettings
    nozzle: npt.NDArray[np.uint8] | None = None
    _state: npt.NDArray[np.float64] = field(default_factory=lambda: np.array(_BEGINNING))
    _rows: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))
    _valve_commands: npt.NDArray[np.uint8] = field(
        default_factory=lambda: np.empty(0, "u1")
    )  # of each row
    _timer: npt.NDArray[np.float64] = field(default_factory=new_timer)  # of the blow-off
    _phase: npt.NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, "u1"))
    _level: npt.NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    _searched: int = 0  # rows of _rows that were searched
    _given: int = 0  # rows of _rows that were given out and stay as context
    _dropped: int = 0  # rows so far that are no more among _rows

    def push(self, block: Samples) -> Found:
        """Take a block; give the rows that are settled, their phases and their levels (Pa)."""
        breaks = np.flatnonzero(block["quality"] & BREAK).tolist()
        if not breaks:
            return self._search(block)
        parts = [self._search(block[: breaks[0]])]
        for begin, end in pairwise([*breaks, len(block)]):
            parts += [self.flush(), self._search(block[begin:end])]
        samples, phase, level = zip(*parts, strict=True)
        return joined(*samples), np.concatenate(phase), np.concatenate(level)

    def flush(self) -> Found:
        """Give all remaining rows, and begin anew: rows after a break are independent."""
        self._run(window=0)
        remaining_rows = slice(self._given, None)
        remaining = (
            self._rows[remaining_rows],
            self._phase[remaining_rows],
            self._level[remaining_rows],
        )
        self._dropped += len(self._rows)
        self._state, self._rows = np.array(_BEGINNING), np.empty(0, SAMPLE)
        self._valve_commands, self._timer = np.empty(0, "u1"), new_timer()
        self._phase, self._level = np.empty(0, "u1"), np.empty(0)
        self._searched = self._given = 0
        return remaining

    def _search(self, stretch: Samples) -> Found:
        self._valve_commands = np.concatenate([self._valve_commands, self._timed_commands(stretch)])
        self._rows = joined(self._rows, stretch)
        self._phase = np.concatenate([self._phase, np.zeros(len(stretch), "u1")])
        self._level = np.concatenate([self._level, np.full(len(stretch), np.nan)])
        settled = self._run(self.detector.window)
        ready = slice(self._given, max(settled, self._given))
        settled_rows = self._rows[ready], self._phase[ready], self._level[ready]
        self._given = ready.stop
        reach = self.detector.window + self.detector.lag + self.detector.about
        context = max(reach, IDLE_ROWS)  # rows that later rows need
        drop = min(max(self._searched - context, 0), self._given)
        self._rows, self._phase = self._rows[drop:], self._phase[drop:]
        self._level, self._valve_commands = self._level[drop:], self._valve_commands[drop:]
        self._searched -= drop
        self._dropped += drop
        self._given -= drop
        return settled_rows

    def _timed_commands(self, stretch: Samples) -> npt.NDArray[np.uint8]:
        """Commands to the valves: the ejector's blow-off timer adds and ends pulses."""
        times = np.concatenate([self._rows["time_ns"][-1:], stretch["time_ns"]])
        dt = np.diff(times, prepend=times[:1])[-len(stretch) :] * NS
        valve_commands = np.empty(len(stretch), "u1")
        effective_commands(
            self._timer,
            np.ascontiguousarray(stretch["commands"]),
            dt,
            *self.detector.blow_off,
            valve_commands,
        )
        return valve_commands

    def _run(self, window: int) -> int:
        """Search as far as the rows reach; returns the first row that may still change."""
        pressure = self._rows["pressure"].astype(np.float64)
        pressure[(self._rows["quality"] & UNUSABLE) != 0] = np.nan
        detector = self.detector
        shifts = detector.off_shift, detector.on_shift
        again = max(detector.again, window)
        settings = np.array(
            [
                *(window, detector.noise, *shifts, detector.settled, again),
                *(detector.apart, detector.about, *detector.acts),
            ],
            np.float64,
        )
        rows = pressure, self._reported(), self._valve_commands
        self._searched = _find(
            self._state, *rows, self._searched, settings, self._phase, self._level
        )
        return self._searched - int(_unsettled(self._state, settings))

    def _reported(self) -> npt.NDArray[np.uint8]:
        """The reported nozzle in each row: the ejector's reports, or ``nozzle`` instead."""
        if self.nozzle is None:
            return np.ascontiguousarray(self._rows["reported"])
        told = self.nozzle[self._dropped : self._dropped + len(self._rows)]
        return np.pad(told, (0, len(self._rows) - len(told)))  # a log may have grown meanwhile
