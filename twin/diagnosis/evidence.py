"""The complete cycles of a log, and the residuals of any hypothesis in them.

A hypothesis is a set of causes; the calibrated unchanged twin is the empty one. Its residuals
are measured minus expected pressure, averaged over short bins, and measured minus expected vacuum
at the switchings of the air saving.
"""

import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, pairwise
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from twin.config import Config
from twin.inference.sensitivities import derivatives
from twin.live import Twin
from twin.log.columns import decode, encode
from twin.model import kernel
from twin.model import theta as c
from twin.model.catalogue import CatalogueEffect, effects_in
from twin.model.courses import Cause, Schedule, schedule
from twin.model.dataset import coefficients
from twin.model.effects import Effect, acting_on
from twin.model.plant import reading_of, sensed_of
from twin.model.term import Term, Terms
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, binned
from twin.monitor.cycles import cut, figures, met_no_part, now_and_then
from twin.monitor.detector_window import detector_of, select_window
from twin.monitor.healthy import Healthy
from twin.monitor.measured_supply import is_gauge, lower_by
from twin.monitor.rows import drawn_rows, time_steps
from twin.monitor.scatter_covariance import least_time_ms
from twin.monitor.simulated_switching import DetectedSwitching, detected_switching
from twin.monitor.smoothed_nozzle import smoothed
from twin.monitor.surroundings import medians_of, surrounded
from twin.monitor.switching_detector import DetectorSettings
from twin.monitor.uncertain_data import Shift, shifted
from twin.quality import UNUSABLE, Quality
from twin.signals import (
    MBAR,
    MS,
    NS,
    SAMPLE,
    TICK,
    Command,
    Phase,
    Samples,
    Ticks,
    bridged,
    joined,
    sampling_ms,
)

OVERFLOW = int(Quality.OVERFLOW)  # a plain number: NumPy compares bytes with it
CORES: ContextVar[int] = ContextVar("CORES", default=2)  # number of cores for a diagnosis
NEARBY = 0.1  # sigmas of a data set's uncertainty within which the response is linear
FASTEST, PIECE = 1, 100_000  # zlib's level, at which a row takes 4 bytes; rows of a piece
LATER, LONGEST_SUCTION = 1.3, 10_000  # simulated suction over that of cycles; largest, in rows

Phases = npt.NDArray[np.uint8]
Hypothesis = tuple[Cause, ...]
HEALTHY: Hypothesis = ()
Item = TypeVar("Item")
Result = TypeVar("Result")


def at_once(run: Callable[[Item], Result], over: Sequence[Item]) -> list[Result]:
    """Results of ``run`` in order; uses threads, since compiled code releases the lock."""
    if len(over) < 2 or CORES.get() == 1:
        return [run(item) for item in over]
    with ThreadPoolExecutor(CORES.get()) as pool:
        return list(pool.map(run, over))


class ParameterSensitivity(NamedTuple):
    """Changes of healthy bins (mbar) by each uncertainty of the data set, (bins, uncertainties)."""

    nearby: Floats  # linear response to one sigma
    up: Floats  # by a whole sigma up, then down
    down: Floats


@dataclass(frozen=True)
class Evidence:
    """The complete cycles of a log in one stretch of rows, and the model for hypotheses."""

    theta: Theta  # coefficients of the calibrated twin in the surroundings of the log
    begin_ns: int  # PLC time of the first of these rows
    before_s: float  # duration of the log before that row
    samples: Samples
    ticks: Ticks
    starts: Ints  # first row of each cycle, and the row after the last one
    numbers: Ints  # number of each cycle in the log
    judged: list[int]  # positions of cycles that count; in the others the model settles
    figures: list[dict[str, float]]  # figures of each cycle
    healthy: Healthy
    noise: float  # mbar, of a row
    bins: Bins
    terms: tuple[Term, ...]  # empirical terms of the data set
    detector: DetectorSettings  # settings of the detector that found the switchings
    uncertain: tuple[Shift, ...]  # uncertainties of the data set, one sigma each
    rows: Ints  # subsampled for interpolation of the expected pressure
    calibrated: Theta  # ``theta`` in the surroundings of the calibration
    told: frozenset[str] = frozenset()  # measured surroundings
    another_day: bool = True  # the log is of another day than the calibration
    volumes_within: float = 1.0  # accuracy factor (95 %) of the volumes in the data set
    catalogue: Mapping[str, CatalogueEffect] = field(default_factory=dict)  # stored effects
    # Cache by coefficients.
    _detected_switchings: dict[bytes, DetectedSwitching] = field(default_factory=dict)

    @property
    def cycles(self) -> int:
        """Number of complete cycles."""
        return len(self.starts) - 1

    def only(self, cycles: Sequence[int], judged: list[int]) -> "Evidence":
        """Evidence with only some of these cycles; ``judged`` are positions among them."""
        parts = [slice(*self.starts[cycle : cycle + 2]) for cycle in cycles]
        return _of_rows(
            self,
            [(self.samples[part], self.ticks[part]) for part in parts],
            numbers=self.numbers[np.array(cycles, np.int64)],
            judged=judged,
            figures=[self.figures[cycle] for cycle in cycles],
        )

    @cached_property
    def effects(self) -> list[Effect]:
        """Effects that can act: of the table, and of the catalogue."""
        stored = effects_in(self.catalogue)
        return [*acting_on(self.theta), *(effect for effect in stored if effect.acts(self.theta))]

    @cached_property
    def seconds(self) -> Floats:
        """Time (s) of each row since the first one."""
        times: Floats = (self.samples["time_ns"] - self.begin_ns) * NS
        return times

    @cached_property
    def least_time_ms(self) -> float:
        """One sigma (ms) of a command's time, due to the sampling of rows."""
        return least_time_ms(sampling_ms(self.samples))

    @cached_property
    def cycle_of_row(self) -> Ints:
        """Number of the cycle of each row."""
        return np.repeat(self.numbers, np.diff(self.starts))

    @cached_property
    def supply_drops(self) -> Floats:
        """How much less (bar) a gauge of the supply reads in each cycle than in healthy ones.

        NaN without a gauge, here or in the healthy cycles.
        """
        if not is_gauge(self.samples):
            return np.full(len(self.starts) - 1, np.nan)
        parts = [slice(first, last) for first, last in pairwise(self.starts.tolist())]
        return np.array(
            [lower_by(self.healthy, self.samples[part], self.ticks[part]) for part in parts]
        )

    @cached_property
    def nozzle_on(self) -> list[int]:
        """A row of each cycle half-way through the time that its nozzle is on."""
        on = self.ticks["phase"] == Phase.SUCTION
        rows = [first + np.flatnonzero(on[first:last]) for first, last in pairwise(self.starts)]
        return [
            int(of_cycle[len(of_cycle) // 2]) if len(of_cycle) else int(first)
            for of_cycle, first in zip(rows, self.starts[:-1], strict=True)
        ]

    @cached_property
    def _times(self) -> Floats:
        """Cumulative time (s) as the kernel uses it; −1 s marks a break."""
        return np.cumsum(time_steps(self.samples))

    @cached_property
    def clock(self) -> Floats:
        """Time (s) at each row that the kernel has counted since the first: breaks do not count."""
        return np.cumsum(np.maximum(time_steps(self.samples), 0.0))

    @cached_property
    def _measured(self) -> Floats:
        """Mean measured pressure (Pa) of each bin."""
        return self.bins.mean(self.samples["pressure"].astype(np.float64))

    def course(self, hypothesis: Hypothesis, base: Theta | None = None) -> Schedule:
        """Schedule of coefficients under a hypothesis: first row, and coefficients from there."""
        base = self.theta if base is None else base
        return schedule(base, hypothesis, self.seconds, self.cycle_of_row)

    def expected(self, hypothesis: Hypothesis) -> Floats:
        """Pressure (Pa) that the sensor should read at each row."""
        course = self.course(hypothesis)
        sensing, rows = self._sensing([self.theta], [course]), np.arange(len(self.samples))
        phase, level = self._phases(sensing), self._levels(rows, [course], sensing)
        return self._run([course], phase, level, rows, kernel.TOLERANCE)[:, 0]

    def off(
        self,
        hypotheses: Sequence[Hypothesis],
        bases: Sequence[Theta] | None = None,
        late: Sequence[int] | None = None,
    ) -> Floats:
        """Measured minus expected pressure (mbar) in each bin, (bins, hypotheses).

        ``bases`` are the coefficients that each hypothesis changes, by default the twin's;
        ``late`` are rows by which its breakpoints are later than they were found.
        """
        bases = [self.theta] * len(hypotheses) if bases is None else bases
        pairs = list(zip(bases, hypotheses, strict=True))
        courses = [self.course(hypothesis, base) for base, hypothesis in pairs]
        sensing = self._sensing(bases, courses)
        if late is not None:
            sensing = [_later(*pair) for pair in zip(sensing, late, strict=True)]
        return self._off(courses, sensing, bases)

    def off_where(
        self,
        hypothesis: Hypothesis,
        rows: Sequence[npt.NDArray[np.bool_]],
        change: Callable[[Theta], Theta],
    ) -> Floats:
        """As ``off``, with coefficients that ``change`` moves in some rows, (bins, len(rows)).

        The air saving is seen to switch as without the change.
        """
        course = self.course(hypothesis)
        sensing = self._sensing([self.theta], [course]) * len(rows)
        courses = [_changed_where(course, chosen, change) for chosen in rows]
        return self._off(courses, sensing, [self.theta] * len(rows))

    def _off(
        self,
        courses: Sequence[Schedule],
        sensing: Sequence[tuple["Sensing", ...]],
        bases: Sequence[Theta],
    ) -> Floats:
        """Measured minus expected pressure (mbar) in each bin, (bins, courses)."""
        lanes = [slice(i, i + kernel.LANES) for i in range(0, len(courses), kernel.LANES)]

        def run(lane: slice) -> Floats:
            phase = self._phases(sensing[lane])
            rows = self._drawn(courses[lane], phase)
            level = self._levels(rows, courses[lane], sensing[lane])
            sooner = [base[_DELAYS].min() < 0.0 for base in bases[lane]]
            driven, phase, level = self._given_sooner(sooner, courses[lane], phase[rows], level)
            expected = self._run(driven, phase, level, rows, kernel.COARSE_TOLERANCE)
            off: Floats = (self._measured[:, None] - self.bins.through(rows, expected)) / MBAR
            return off

        deviations = np.empty((len(self.bins.count), len(courses)))
        for lane, off in zip(lanes, at_once(run, lanes), strict=True):
            deviations[:, lane] = off
        return deviations

    def states(self, hypothesis: Hypothesis, rows: Ints) -> Floats:
        """The model's state after each of some ascending rows, (kernel.STATE, rows)."""
        course = self.course(hypothesis)
        sensing, every = self._sensing([self.theta], [course]), np.arange(len(self.samples))
        phase, level = self._phases(sensing), self._levels(every, [course], sensing)
        dt, expected = np.diff(self._times, prepend=0.0), np.empty((len(every), 1))
        state, before, states = kernel.new_state(1), None, list[Floats]()
        for first, last, theta in _constant_stretches([course], len(every)):
            if before is not None:
                kernel.take_over(state, before, theta)
            before = theta
            inside = rows[(rows >= first) & (rows < last)]
            for begin, end in pairwise(np.unique([first, *(inside + 1), last])):
                part = slice(begin, end)
                kernel.advance(state, theta, dt[part], phase[part], level[part], expected[part])
                if end - 1 in inside:
                    states.append(state[:, 0].copy())
        return np.array(states).T

    @cached_property
    def parameter_sensitivity(self) -> ParameterSensitivity:
        """Responses of the twin without causes to each uncertainty of its data set."""
        ups, downs = ([getattr(shift, side) for shift in self.uncertain] for side in ("up", "down"))
        near = [shift.near(self.theta, NEARBY) for shift in self.uncertain]
        bases = [self.theta, *near, *ups, *downs]
        _, changes = derivatives(self.off([HEALTHY] * len(bases), bases))
        nearby, up, down = np.split(changes, 3, axis=1)
        return ParameterSensitivity(nearby / NEARBY, up, down)

    def _drawn(self, courses: Sequence[Schedule], phase: Phases) -> Ints:
        """Subsampled rows for interpolation of the pressure expected by these courses."""
        if self.terms:  # terms need every row
            return np.arange(len(phase))
        changes = np.concatenate(
            [
                np.flatnonzero(np.diff(phase, axis=0).any(axis=1)) + 1,
                *([row for row, _ in course if row] for course in courses),
            ]
        ).astype(np.int64)
        return np.unique(np.concatenate([self.rows, changes - 1, changes]))

    def _run(
        self,
        courses: Sequence[Schedule],
        phase: Phases,
        level: Floats,
        rows: Ints,
        tolerance: float,
    ) -> Floats:
        """Expected pressures (Pa) at ``rows``, (rows, courses); inputs are given at these rows."""
        dt = np.diff(self._times[rows], prepend=0.0)
        expected = np.empty((len(rows), len(courses)))
        state, before = kernel.new_state(len(courses)), None
        for first, last, theta in _constant_stretches(courses, len(self.samples)):
            part = slice(*np.searchsorted(rows, (first, last)))
            if before is not None:
                kernel.take_over(state, before, theta)
            before = theta
            driven = dt[part], phase[part], level[part]
            kernel.advance(state, theta, *driven, expected[part], tolerance=tolerance)
        for phases, pressure in zip(
            np.broadcast_to(phase, expected.shape).T, expected.T, strict=True
        ):
            Terms(self.terms, float(self.theta[c.AMBIENT])).add(phases, pressure)
        return expected

    def _sensing(
        self, bases: Sequence[Theta], courses: Sequence[Schedule]
    ) -> list[tuple["Sensing", ...]]:
        """Shifts of the nozzle's time and of a breakpoint's level, against the calibrated twin.

        They depend only on coefficients of jet, line and sensor.
        """
        stretches = [
            self._sensing_stretches(base, course)
            for base, course in zip(bases, courses, strict=True)
        ]
        self.look([*bases, *(theta for stretch in stretches for _, theta in stretch)])
        return [
            tuple(
                Sensing.of(row, self.detected_switching(theta), self.detected_switching(base))
                for row, theta in stretch
            )
            for base, stretch in zip(bases, stretches, strict=True)
        ]

    def _sensing_stretches(self, base: Theta, course: Schedule) -> Schedule:
        """Coefficients at the breakpoints, with only jet, line and sensor as in a course."""
        if all((theta[_SENSING] == base[_SENSING]).all() for _, theta in course):
            return []
        begins, stretches = [row for row, _ in course], []
        for number in np.unique(np.searchsorted(begins, self._switching_rows, "right") - 1):
            row, theta = course[number]
            changed = base.copy()
            changed[_SENSING] = theta[_SENSING]
            stretches.append((row, changed))
        return stretches

    def _phases(self, sensing: Sequence[tuple["Sensing", ...]]) -> Phases:
        """Phases of all rows with which the detector would have found the same switchings.

        They are (rows, n), or (rows, 1) if they are the same for all.
        """
        width = len(sensing) if any(sensing) else 1
        phase = np.repeat(self.ticks["phase"][:, None], width, axis=1)
        for i, shifts in enumerate(sensing):
            if shifts:
                self._move(phase[:, i], shifts)
        return phase

    def _levels(
        self, rows: Ints, courses: Sequence[Schedule], sensing: Sequence[tuple["Sensing", ...]]
    ) -> Floats:
        """Levels at ``rows``, shaped as ``_phases``; ``rows`` contain all rows with a level."""
        changed = any(len(course) > 1 for course in courses)
        width = len(sensing) if changed or any(sensing) else 1
        level = np.repeat(self.ticks["level"][rows].astype(np.float64)[:, None], width, axis=1)
        switchings = np.searchsorted(rows, self._switching_rows)
        for i, (course, shifts) in enumerate(zip(courses, sensing, strict=True)):
            if shifts:
                level[switchings, i] -= [
                    self._shift_at(break_row, shifts)[1] for break_row in self._switching_rows
                ]
            if len(course) > 1:
                self._read_anew(rows, level[:, i], course)
        return level

    def _given_sooner(
        self, sooner: Sequence[bool], courses: Sequence[Schedule], phase: Phases, level: Floats
    ) -> tuple[Sequence[Schedule], Phases, Floats]:
        """Inputs of the kernel if valves of some courses act before their commands show in a row.

        Commands of the courses that are ``sooner`` come a row sooner, and their delays are longer
        by that. A negative delay is thus exact, if it is shorter than a row. ``phase`` and
        ``level`` are at some rows, those beside each command among them.
        """
        if not any(sooner):
            return courses, phase, level
        shape = (len(phase), len(courses))
        phase, level = np.broadcast_to(phase, shape).copy(), np.broadcast_to(level, shape).copy()
        commands = np.where(phase == Phase.HOLD, Phase.SUCTION, phase)
        row, lane = np.nonzero((np.diff(commands, axis=0) != 0) & sooner)
        phase[row, lane] = phase[row + 1, lane]
        level[row, lane], level[row + 1, lane] = level[row + 1, lane], np.nan
        period = sampling_ms(self.samples) * MS
        driven = [
            [(first, _after(theta, period)) for first, theta in course] if is_sooner else course
            for course, is_sooner in zip(courses, sooner, strict=True)
        ]
        return driven, phase, level

    def _read_anew(self, rows: Ints, level: Floats, course: Schedule) -> None:
        """Correct levels at starts of cycles where a course changes coefficients of the sensor."""
        for (_, before), (row, after) in pairwise(course):
            at = np.searchsorted(rows, row)
            if np.isfinite(level[at]) and self.ticks["phase"][row - 1] == Phase.IDLE:
                level[at] = reading_of(sensed_of(level[at], before), after)

    def _move(self, phase: Phases, sensing: Sequence["Sensing"]) -> None:
        """Move the switching of one hypothesis, in place."""
        for break_row in self._switching_rows:
            name = Phase(int(self.ticks["phase"][break_row]))
            known_shift = self._known_shift(break_row)
            earlier, _ = self._shift_at(break_row, sensing)
            acts = max(break_row - known_shift - earlier, 0)
            phase[max(break_row - known_shift, 0) : break_row] = _OTHER[name]
            phase[acts:break_row] = name
            late = phase[break_row : max(break_row, acts)]
            late[late == name] = _OTHER[name]

    def _known_shift(self, break_row: int) -> int:
        """Rows by which a breakpoint shows late; 0 if it was found by the whole log instead."""
        name = self.ticks["phase"][break_row]
        shift = self.detector.off_shift if name == Phase.HOLD else self.detector.on_shift
        return shift if shift and self.ticks["phase"][break_row - 1] == name else 0

    def _shift_at(self, break_row: int, sensing: Sequence["Sensing"]) -> tuple[int, float]:
        """Rows by which a switching acts earlier, and the level (Pa) by which it is seen higher."""
        begins = [part.row for part in sensing]
        shift = sensing[int(np.searchsorted(begins, break_row, "right")) - 1]
        is_off = self.ticks["phase"][break_row] == Phase.HOLD
        late = self.detector.off_shift if is_off else self.detector.on_shift
        is_read = late and not self._known_shift(break_row)  # the level is a plain reading
        above = 0.0 if is_read else shift.off_above if is_off else shift.on_above
        return shift.off if is_off else shift.on, above

    @cached_property
    def _switching_rows(self) -> Ints:
        """Rows at which the detector saw the air saving switch."""
        phase = self.ticks["phase"]
        rows = np.flatnonzero(np.isfinite(self.ticks["level"]))
        rows = rows[rows > 0]
        inside = [Phase.SUCTION, Phase.HOLD]
        return rows[np.isin(phase[rows], inside) & np.isin(phase[rows - 1], inside)]

    def switching_row(self, cycle: int, into: Phase) -> int:
        """First row of a cycle at which the detector saw a switching to a phase."""
        switchings = self._switching_rows[self._switching_rows >= self.starts[cycle]]
        return int(switchings[self.ticks["phase"][switchings] == into][0])

    def detected_switching(self, theta: Theta) -> DetectedSwitching:
        """Simulated detection of the switching by the log's detector; cached."""
        if theta.tobytes() not in self._detected_switchings:
            self.look([theta])
        return self._detected_switchings[theta.tobytes()]

    def look(self, thetas: Iterable[Theta]) -> None:
        """Simulate and cache the detection of the switching for many coefficients."""
        new = {theta.tobytes(): theta for theta in thetas}
        new = {key: theta for key, theta in new.items() if key not in self._detected_switchings}
        if not new:
            return
        cycle = slice(self.starts[self.judged[0]], self.starts[self.judged[0] + 1])
        suction = int(np.count_nonzero(self.samples["commands"][cycle] == Command.SUCTION))
        rows = min(int(LATER * suction), LONGEST_SUCTION)
        thetas = list(new.values())
        lanes = [thetas[i : i + kernel.LANES] for i in range(0, len(thetas), kernel.LANES)]
        detected_by_lane = at_once(
            lambda lane: detected_switching(lane, rows, self.detector), lanes
        )
        self._detected_switchings.update(
            zip(new, chain.from_iterable(detected_by_lane), strict=True)
        )


@dataclass(frozen=True)
class Sensing:
    """Shifts against the calibrated twin with which the switching shows at the same row."""

    row: int  # first row with these shifts
    off: int  # rows by which the nozzle closes earlier
    on: int  # rows by which it opens earlier
    off_above: float  # Pa, increase of the detected level over the reading there
    on_above: float

    @classmethod
    def of(cls, row: int, changed: DetectedSwitching, calibrated: DetectedSwitching) -> "Sensing":
        """Shifts between two simulated detections, ``changed`` and ``calibrated``."""
        return cls(
            row,
            changed.off_rows - calibrated.off_rows,
            changed.on_rows - calibrated.on_rows,
            changed.off_above - calibrated.off_above,
            changed.on_above - calibrated.on_above,
        )


_OTHER = {Phase.HOLD: Phase.SUCTION, Phase.SUCTION: Phase.HOLD}
_DELAYS = [c.RESPONSE, c.RESPONSE_OFF, c.BLOW_OFF_RESPONSE, c.BLOW_OFF_RESPONSE_OFF]
_SENSING = [c.SENSOR_LAG, c.SLOW_SENSOR, c.RAMP_UP, c.SLOW_RAMP_UP, c.JET_FULL_AT, c.RAMP_DOWN]
# A drop along the line vanishes at a breakpoint.
_SENSING += [c.NEAR_RESISTANCE, c.RESISTANCE, c.PLACE]


def _after(theta: Theta, period: float) -> Theta:
    """Coefficients for commands that come ``period`` (s) sooner, with all actions unchanged."""
    later = theta.copy()
    later[_DELAYS] += period
    later[c.CONTACT] += period * (theta[c.CONTACT] > 0.0)
    return later


def _later(sensing: tuple[Sensing, ...], rows: int) -> tuple[Sensing, ...]:
    """``sensing`` with breakpoints later by ``rows``."""
    if not rows:
        return sensing
    shifts = sensing or (Sensing(0, 0, 0, 0.0, 0.0),)
    return tuple(replace(shift, off=shift.off - rows, on=shift.on - rows) for shift in shifts)


def _changed_where(
    course: Schedule, chosen: npt.NDArray[np.bool_], change: Callable[[Theta], Theta]
) -> Schedule:
    """A course whose coefficients are changed in the chosen rows."""
    begins = [row for row, _ in course]
    rows = {*begins, *(np.flatnonzero(np.diff(chosen)) + 1).tolist()}
    at = [(row, course[int(np.searchsorted(begins, row, "right")) - 1][1]) for row in sorted(rows)]
    return [(row, change(theta) if chosen[row] else theta) for row, theta in at]


def _constant_stretches(courses: Sequence[Schedule], rows: int) -> Iterator[tuple[int, int, Theta]]:
    """Stretches of rows in which no course changes, with coefficients (·, courses)."""
    changes = sorted({row for course in courses for row, _ in course})
    current = [course[0][1] for course in courses]
    changes_by_row = [dict(course) for course in courses]
    for first, last in zip(changes, [*changes[1:], rows], strict=True):
        current = [
            changed.get(first, previous)
            for changed, previous in zip(changes_by_row, current, strict=True)
        ]
        yield first, last, np.stack(current, axis=1)


@dataclass(frozen=True)
class LogCycles:
    """The complete cycles of a log, compressed, since an hour has 3.6 million rows.

    Evidence is made of some of them at a time.
    """

    base: Evidence  # evidence without cycles
    begins: Floats  # time (s) of the first row of each, since the first row of the log
    judged: list[int]  # as in Evidence
    figures: list[dict[str, float]]
    saturated: float  # share of saturated rows
    packed: list[list[bytes]]  # compressed pieces of each cycle
    without_part: list[int]  # cycles in which cups met no part; they are not judged

    @property
    def cycles(self) -> int:
        """Number of complete cycles."""
        return len(self.packed)

    def rows(self, cycle: int) -> tuple[Samples, Ticks]:
        """Rows of a cycle."""
        pieces = [decode(zlib.decompress(piece)) for piece in self.packed[cycle]]
        samples, ticks = (joined(*column) for column in zip(*pieces, strict=True))
        return samples, ticks

    def whole(self) -> Evidence:
        """Evidence of all cycles; all rows are held in memory."""
        return self.only(range(self.cycles), self.judged)

    def only(self, cycles: Sequence[int], judged: list[int]) -> Evidence:
        """Evidence of some cycles; ``judged`` are positions among them."""
        return _of_rows(
            self.base,
            [self.rows(cycle) for cycle in cycles],
            numbers=np.array(cycles, np.int64),
            judged=judged,
            figures=[self.figures[cycle] for cycle in cycles],
        )


def collect(config: Config, blocks: Iterable[Samples]) -> Evidence:
    """Run the calibrated twin over a log and collect its complete cycles, with all their rows."""
    return read_cycles(config, blocks).whole()


def read_cycles(config: Config, blocks: Iterable[Samples]) -> LogCycles:
    """Run the calibrated twin over a log and keep its complete cycles.

    ``blocks`` are read several times; those of an iterator are kept meanwhile.
    """
    blocks = read_again(blocks)
    theta = coefficients(config.data)
    sampling = sampling_ms(max(blocks, key=len, default=np.empty(0, SAMPLE)))
    detector = detector_of(config.data, sampling)
    nothing = Evidence(
        theta=theta,
        begin_ns=0,
        before_s=0.0,
        samples=np.empty(0, SAMPLE),
        ticks=np.empty(0, TICK),
        starts=np.zeros(1, np.int64),
        numbers=np.empty(0, np.int64),
        judged=[],
        figures=[],
        healthy=config.monitor.healthy,
        volumes_within=config.data.system.volumes_within_factor,
        noise=config.data.sensor.noise_in_means(sampling),
        bins=_binned(np.empty(0, SAMPLE), np.empty(0, TICK), np.zeros(1, np.int64), [], detector),
        rows=np.empty(0, np.int64),
        terms=config.data.terms,
        detector=detector,
        uncertain=tuple(shifted(config.data, config.monitor.healthy)),
        calibrated=theta,
        catalogue=config.data.catalogue,
    )
    return _read(nothing, blocks)


def read_again(blocks: Iterable[Samples]) -> Iterable[Samples]:
    """Blocks that can be read again and again: those of an iterator are kept."""
    return list(blocks) if isinstance(blocks, Iterator) else blocks


def of_log(base: Evidence, blocks: Iterable[Samples]) -> Evidence:
    """Evidence of another log for the same twin."""
    return _read(base, read_again(blocks)).whole()


def _read(base: Evidence, blocks: Iterable[Samples]) -> LogCycles:
    """The complete cycles of a log for the twin of ``base``, in the log's surroundings."""
    medians = medians_of(blocks)
    theta = surrounded(base.theta, medians)
    detector = select_window(base.detector, _Bridged(blocks))
    base = replace(
        base,
        theta=theta,
        uncertain=tuple(
            shift._replace(up=surrounded(shift.up, medians), down=surrounded(shift.down, medians))
            for shift in base.uncertain
        ),
        told=frozenset(medians),
        detector=detector,
        begin_ns=next((int(block["time_ns"][0]) for block in blocks if len(block)), 0),
        _detected_switchings={},  # depends on the settings of the detector
    )
    begins, judged, packed = list[int](), list[int](), list[list[bytes]]()
    without_part = list[int]()
    figures_of_cycles, rows, saturated = list[dict[str, float]](), 0, 0
    told_detector, nozzle = smoothed(theta, detector, _Bridged(blocks))
    twin = Twin(base.theta, told_detector, base.terms, nozzle)
    for cycle in cut(twin.over(_Bridged(blocks)), math.inf):
        if not cycle.complete:
            continue
        if cycle.settled:
            judged.append(len(packed))
        if met_no_part(cycle, theta):
            without_part.append(len(packed))
        begins.append(int(cycle.samples["time_ns"][0]))
        figures_of_cycles.append(figures(cycle, theta))
        packed.append(_packed(cycle.samples, cycle.ticks))
        rows += len(cycle.samples)
        saturated += int(np.count_nonzero(cycle.samples["quality"] & OVERFLOW))
    seconds = (np.array(begins, np.int64) - base.begin_ns).astype(np.float64) * NS
    share = saturated / max(rows, 1)
    without_part = now_and_then(without_part, len(packed))
    judged = [cycle for cycle in judged if cycle not in without_part]
    return LogCycles(base, seconds, judged, figures_of_cycles, share, packed, without_part)


def _packed(samples: Samples, ticks: Ticks) -> list[bytes]:
    """Rows compressed without loss, in pieces, since a cycle may last a night."""
    parts = [slice(first, first + PIECE) for first in range(0, len(samples), PIECE)]
    return [zlib.compress(encode(samples[part], ticks[part]), FASTEST) for part in parts]


@dataclass(frozen=True)
class _Bridged:
    """Blocks passed through a ``Bridge``, as often as they are read."""

    blocks: Iterable[Samples]

    def __iter__(self) -> Iterator[Samples]:
        return bridged(self.blocks)


def thinned(source: Evidence | LogCycles, cycles: Sequence[int], most: int) -> Evidence:
    """Evidence of about ``most`` of the judged ``cycles`` at most, evenly spread in pairs."""
    if len(cycles) <= most:
        return of_cycles(source, cycles)
    first = np.linspace(0, len(cycles) - 2, most // 2).astype(int)
    return of_cycles(source, [cycles[i] for i in sorted({*first, *(first + 1)})])


def of_cycles(source: Evidence | LogCycles, cycles: Sequence[int]) -> Evidence:
    """Evidence of some cycles, each with the cycle before it, in which the model settles."""
    kept = sorted({number for cycle in cycles for number in (cycle - 1, cycle) if number >= 0})
    return source.only(kept, [kept.index(cycle) for cycle in cycles])


def _of_rows(
    base: Evidence,
    rows: Sequence[tuple[Samples, Ticks]],
    numbers: Ints,
    judged: list[int],
    figures: list[dict[str, float]],
) -> Evidence:
    """Evidence of cycles with these ``rows``, for the twin of ``base``."""
    samples = joined(np.empty(0, SAMPLE), *(samples for samples, _ in rows))
    ticks = joined(np.empty(0, TICK), *(ticks for _, ticks in rows))
    starts = np.cumsum([0, *(len(samples) for samples, _ in rows)])
    return replace(
        base,
        samples=samples,
        ticks=ticks,
        starts=starts,
        numbers=numbers,
        judged=judged,
        figures=figures,
        bins=_binned(samples, ticks, starts, judged, base.detector),
        rows=drawn_rows(samples, ticks),
    )


def _binned(
    samples: Samples, ticks: Ticks, starts: Ints, judged: Sequence[int], detector: DetectorSettings
) -> Bins:
    """Bins of the rows of judged cycles that can be compared."""
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    usable &= np.isfinite(ticks["expected"])
    usable &= np.isin(np.searchsorted(starts, np.arange(len(samples)), "right") - 1, judged)
    usable &= ~_unsettled(ticks["phase"], detector)
    return binned(ticks["phase"], usable, starts)


def _unsettled(phase: Phases, detector: DetectorSettings) -> npt.NDArray[np.bool_]:
    """Rows after a breakpoint that is too close to the end of suction to be precise.

    Rows of the blow-off or idle after them count as well: its initial pressure is unknown.
    """
    begins = np.flatnonzero(np.diff(phase, prepend=255))
    lengths = np.diff(begins, append=len(phase))
    kind = phase[begins]
    before = np.concatenate([[255], kind[:-1]])
    sucks, sucked = (np.isin(phases, [Phase.SUCTION, Phase.HOLD]) for phases in (kind, before))
    after_break = lengths - np.where(kind == Phase.SUCTION, detector.on_shift, detector.off_shift)
    soon = sucks & sucked & (after_break < detector.settles)
    soon[1:] |= soon[:-1] & ~sucks[1:]
    return np.repeat(soon, lengths)
