"""What a log has to say: its complete cycles, and how far any hypothesis is from them.

A hypothesis is a set of causes; the calibrated twin as it stands is the empty one. Its residual is
measured minus expected pressure, averaged over short bins, and the vacuum at which the air saving
switched against the vacuum at which the hypothesis would.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from pydantic.fields import FieldInfo

from twin.config import Config
from twin.live import Twin
from twin.model import kernel
from twin.model import theta as c
from twin.model.catalogue import CatalogueEffect, effects_in
from twin.model.courses import Cause, Schedule, schedule
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import Effect, acting_on
from twin.model.plant import reading_of, sensed_of
from twin.model.term import Term, Terms
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, binned
from twin.monitor.cycles import figures, whole
from twin.monitor.detector_window import as_wide_as_needed, knees_of
from twin.monitor.healthy import Healthy
from twin.monitor.phase_detector import Knees
from twin.monitor.rows import drawn_rows, time_steps
from twin.monitor.simulated_switching import Seen, seen
from twin.monitor.surroundings import are_told, following, told
from twin.signals import (
    MBAR,
    NS,
    SAMPLE,
    TICK,
    UNUSABLE,
    Command,
    Phase,
    Samples,
    Ticks,
    bridged,
    joined,
    sampling_ms,
)

CORES: ContextVar[int] = ContextVar("CORES", default=2)  # on which a diagnosis runs
LATER, LONGEST_SUCTION = 1.3, 10_000  # cycles' suction, rows: until when H1 may be reached

# How suction and end pressure follow the supply is the type's; of its value, one sigma.
SUPPLY_UNKNOWN = {"end_pressure_slope": 0.5, "curvature": 0.5, "optimum_bar": 0.03}

Hypothesis = tuple[Cause, ...]
HEALTHY: Hypothesis = ()
OF_THE_WAY = 0.9  # to its bound, at most, an uncertain value is moved
_BOUNDS = ("ge", "gt", "le", "lt")
One = TypeVar("One")
Other = TypeVar("Other")


def at_once(run: Callable[[One], Other], over: Sequence[One]) -> list[Other]:
    """What ``run`` gives for each, in order; on several cores, as compiled code lets others run."""
    if len(over) < 2 or CORES.get() == 1:
        return [run(one) for one in over]
    with ThreadPoolExecutor(CORES.get()) as pool:
        return list(pool.map(run, over))


@dataclass(frozen=True)
class Evidence:
    """The complete cycles of a log in one stretch of rows, with all that judges a hypothesis."""

    theta: Theta  # of the calibrated twin as it stands, in the surroundings of the log
    begin_ns: int  # PLC time of the first row here
    before_s: float  # of the log, before that row
    samples: Samples
    ticks: Ticks
    starts: Ints  # first row of each cycle, and the row after the last one
    numbers: Ints  # of the cycles in the log
    judged: list[int]  # positions of those that count; in the others the model still swings in
    figures: list[dict[str, float]]  # of each cycle
    healthy: Healthy
    noise: float  # mbar
    bins: Bins
    terms: tuple[Term, ...]  # that data gave the data set
    knees: Knees  # how they were looked for
    uncertain: tuple[tuple[Theta, Theta], ...]  # a sigma either way where no log decided
    rows: Ints  # that suffice to draw what is expected
    calibrated: Theta  # the same in those of its calibration
    gauge: bool  # the pressure sensor counts from ambient
    told: frozenset[str] = frozenset()  # surroundings that somebody measures
    another_day: bool = True  # than that of the calibration
    catalogue: Mapping[str, CatalogueEffect] = field(default_factory=dict)  # known beside the table
    _seen: dict[bytes, Seen] = field(default_factory=dict)  # by coefficients

    @property
    def cycles(self) -> int:
        """How many complete cycles there are."""
        return len(self.starts) - 1

    @cached_property
    def effects(self) -> list[Effect]:
        """What can act: of the table, and of what was found before."""
        known = effects_in(self.catalogue)
        return [*acting_on(self.theta), *(one for one in known if one.acts(self.theta))]

    @cached_property
    def seconds(self) -> Floats:
        """Time (s) of each row since the first one here."""
        times: Floats = (self.samples["time_ns"] - self.begin_ns) * NS
        return times

    @cached_property
    def cycle_of_row(self) -> Ints:
        """Number of the cycle of each row."""
        return np.repeat(self.numbers, np.diff(self.starts))

    @cached_property
    def _times(self) -> Floats:
        """The same as the kernel counts it: less by 1 where time does not run on."""
        return np.cumsum(time_steps(self.samples, None))

    @cached_property
    def _measured(self) -> Floats:
        """Mean measured pressure (Pa) of each bin."""
        return self.bins.mean(self.samples["pressure"].astype(np.float64))

    def course(self, hypothesis: Hypothesis, base: Theta | None = None) -> Schedule:
        """The coefficients under a hypothesis, from which row on which."""
        base = self.theta if base is None else base
        course = schedule(base, hypothesis, self.seconds, self.cycle_of_row)
        return [(row, self._as_read(theta, base)) for row, theta in course]

    def _as_read(self, theta: Theta, base: Theta) -> Theta:
        """Readings of a gauge sensor were counted from the ambient pressure that was assumed."""
        shift = float(theta[c.AMBIENT] - base[c.AMBIENT])
        if not self.gauge or shift == 0.0:
            return theta
        theta = theta.copy()
        theta[c.SENSOR_OFFSET] -= shift
        return theta

    def expected(self, hypothesis: Hypothesis) -> Floats:
        """Pressure (Pa) that the sensor should read at each row."""
        course = self.course(hypothesis)
        phase, level = self._switched([course], self._sensing([self.theta], [course]))
        rows = np.arange(len(self.samples))
        return self._run([course], phase, level, rows, kernel.TOLERANCE)[:, 0]

    def off(
        self,
        hypotheses: Sequence[Hypothesis],
        bases: Sequence[Theta] | None = None,
        late: Sequence[int] | None = None,
    ) -> Floats:
        """Measured minus expected pressure (mbar) in each bin, (bins, hypotheses).

        ``bases`` are the coefficients that each hypothesis changes, where not the twin's own;
        ``late`` by how many rows its knees are later than they were found.
        """
        bases = [self.theta] * len(hypotheses) if bases is None else bases
        pairs = list(zip(bases, hypotheses, strict=True))
        courses = [self.course(one, base) for base, one in pairs]
        sensing = self._sensing(bases, courses)
        if late is not None:
            sensing = [_later(*both) for both in zip(sensing, late, strict=True)]
        lanes = [slice(i, i + kernel.LANES) for i in range(0, len(courses), kernel.LANES)]

        def run(lane: slice) -> Floats:
            phase, level = self._switched(courses[lane], sensing[lane])
            rows = self._drawn(courses[lane], phase)
            expected = self._run(courses[lane], phase, level, rows, kernel.ROUGHLY)
            off: Floats = (self._measured[:, None] - self.bins.through(rows, expected)) / MBAR
            return off

        found = np.empty((len(self.bins.count), len(courses)))
        for lane, off in zip(lanes, at_once(run, lanes), strict=True):
            found[:, lane] = off
        return found

    def _drawn(self, courses: Sequence[Schedule], phase: npt.NDArray[np.uint8]) -> Ints:
        """Rows that suffice to draw what these courses expect."""
        if self.terms:  # they count rows
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
        phase: npt.NDArray[np.uint8],
        level: Floats,
        rows: Ints,
        tolerance: float,
    ) -> Floats:
        """Expected pressures (Pa) at ``rows``, (rows, courses)."""
        dt = np.diff(self._times[rows], prepend=0.0)
        phase, level = phase[rows], level[rows]
        expected = np.empty((len(rows), len(courses)))
        state, before = kernel.new_state(len(courses)), None
        for first, last, theta in _together(courses, len(self.samples)):
            part = slice(*np.searchsorted(rows, (first, last)))
            if before is not None:
                kernel.take_over(state, before, theta)
            before = theta
            driven = dt[part], phase[part], level[part]
            kernel.advance(state, theta, *driven, expected[part], tolerance=tolerance)
        for phases, one in zip(np.broadcast_to(phase, expected.shape).T, expected.T, strict=True):
            Terms(self.terms, float(self.theta[c.AMBIENT])).add(phases, one)
        return expected

    def _sensing(
        self, bases: Sequence[Theta], courses: Sequence[Schedule]
    ) -> list[tuple["Sensing", ...]]:
        """How much earlier than it is seen the nozzle switches, and what that does to the level.

        It is the same for all coefficients but those of jet, line and sensor.
        """
        stretches = [self._alike(base, course) for base, course in zip(bases, courses, strict=True)]
        self.look([*bases, *(alike for some in stretches for _, alike in some)])
        return [
            tuple(Sensing.of(row, self.seen(alike), self.seen(base)) for row, alike in some)
            for base, some in zip(bases, stretches, strict=True)
        ]

    def _alike(self, base: Theta, course: Schedule) -> Schedule:
        """Coefficients of a course that hold at knees, with jet, line and sensor alone changed."""
        if all((theta[_SENSING] == base[_SENSING]).all() for _, theta in course):
            return []
        begins, found = [row for row, _ in course], []
        for number in np.unique(np.searchsorted(begins, self._knees, "right") - 1):
            row, theta = course[number]
            alike = base.copy()
            alike[_SENSING] = theta[_SENSING]
            found.append((row, alike))
        return found

    def _switched(
        self, courses: Sequence[Schedule], sensing: Sequence[tuple["Sensing", ...]]
    ) -> tuple[npt.NDArray[np.uint8], Floats]:
        """Phases and levels as the nozzle must have switched to be seen as it was.

        Both are (rows, n), or (rows, 1) where they are the same for all.
        """
        changed, moved = any(len(course) > 1 for course in courses), any(sensing)
        phase = np.repeat(self.ticks["phase"][:, None], len(sensing) if moved else 1, axis=1)
        width = len(sensing) if changed or moved else 1
        level = np.repeat(self.ticks["level"].astype(np.float64)[:, None], width, axis=1)
        for i, (course, some) in enumerate(zip(courses, sensing, strict=True)):
            if some:
                self._move(phase[:, i], level[:, i], some)
            if len(course) > 1:
                self._read_anew(level[:, i], course)
        return phase, level

    def _read_anew(self, level: Floats, course: Schedule) -> None:
        """Where coefficients change at a cycle's start, the level is what was read before that."""
        for (_, before), (row, after) in pairwise(course):
            if np.isfinite(level[row]) and self.ticks["phase"][row - 1] == Phase.IDLE:
                level[row] = reading_of(sensed_of(level[row], before), after)

    def _move(
        self, phase: npt.NDArray[np.uint8], level: Floats, sensing: Sequence["Sensing"]
    ) -> None:
        """Move the switching of one hypothesis, in place."""
        begins = [one.row for one in sensing]
        for knee in self._knees:
            here = sensing[np.searchsorted(begins, knee, "right") - 1]
            name = Phase(int(self.ticks["phase"][knee]))
            closing = name == Phase.HOLD
            earlier = here.off if closing else here.on
            known = self.knees.off_shift if closing else self.knees.on_shift
            level[knee] -= here.off_above if closing else here.on_above
            acts = max(knee - known - earlier, 0)
            phase[max(knee - known, 0) : knee] = _OTHER[name]
            phase[acts:knee] = name
            late = phase[knee : max(knee, acts)]
            late[late == name] = _OTHER[name]

    @cached_property
    def _knees(self) -> Ints:
        """Rows at which the air saving was seen to switch."""
        phase = self.ticks["phase"]
        rows = np.flatnonzero(np.isfinite(self.ticks["level"]))
        rows = rows[rows > 0]
        inside = [Phase.SUCTION, Phase.HOLD]
        return rows[np.isin(phase[rows], inside) & np.isin(phase[rows - 1], inside)]

    def knee(self, cycle: int, into: Phase) -> int:
        """First row of a cycle at which the air saving was seen to switch into a phase."""
        knees = self._knees[self._knees >= self.starts[cycle]]
        return int(knees[self.ticks["phase"][knees] == into][0])

    def seen(self, theta: Theta) -> Seen:
        """How the air saving would be seen to switch, by the finder that found it in the log."""
        if theta.tobytes() not in self._seen:
            self.look([theta])
        return self._seen[theta.tobytes()]

    def look(self, thetas: Iterable[Theta]) -> None:
        """Find out for many how the air saving would be seen to switch."""
        new = {theta.tobytes(): theta for theta in thetas}
        new = {key: theta for key, theta in new.items() if key not in self._seen}
        if not new:
            return
        cycle = slice(self.starts[self.judged[0]], self.starts[self.judged[0] + 1])
        suction = int(np.count_nonzero(self.samples["commands"][cycle] == Command.SUCTION))
        rows = min(int(LATER * suction), LONGEST_SUCTION)
        thetas = list(new.values())
        lanes = [thetas[i : i + kernel.LANES] for i in range(0, len(thetas), kernel.LANES)]
        found = at_once(lambda lane: seen(lane, rows, self.knees), lanes)
        self._seen.update(zip(new, chain.from_iterable(found), strict=True))


@dataclass(frozen=True)
class Sensing:
    """How much earlier than in the calibrated twin the nozzle switches to be seen when it was."""

    row: int  # from which on
    off: int  # rows, closing
    on: int  # rows, opening
    off_above: float  # Pa, by how much more the level found is above what is read there
    on_above: float

    @classmethod
    def of(cls, row: int, here: Seen, as_it_is: Seen) -> "Sensing":
        """Compare with the calibrated twin."""
        return cls(
            row,
            here.off_rows - as_it_is.off_rows,
            here.on_rows - as_it_is.on_rows,
            here.off_above - as_it_is.off_above,
            here.on_above - as_it_is.on_above,
        )


_OTHER = {Phase.HOLD: Phase.SUCTION, Phase.SUCTION: Phase.HOLD}
_SENSING = [c.SENSOR_LAG, c.SLOW_SENSOR, c.RAMP_UP, c.SLOW_RAMP_UP, c.JET_FULL_AT, c.RAMP_DOWN]
_SENSING += [c.NEAR_RESISTANCE, c.RESISTANCE, c.PLACE]  # a drop along the line vanishes at a knee


def _later(sensing: tuple[Sensing, ...], rows: int) -> tuple[Sensing, ...]:
    """The same with knees later by so many rows."""
    if not rows:
        return sensing
    some = sensing or (Sensing(0, 0, 0, 0.0, 0.0),)
    return tuple(replace(one, off=one.off - rows, on=one.on - rows) for one in some)


def _together(courses: Sequence[Schedule], rows: int) -> Iterator[tuple[int, int, Theta]]:
    """Stretches of rows in which no course changes, with the coefficients of all, (·, courses)."""
    changes = sorted({row for course in courses for row, _ in course})
    now = [course[0][1] for course in courses]
    at = [dict(course) for course in courses]
    for first, last in zip(changes, [*changes[1:], rows], strict=True):
        now = [changed.get(first, before) for changed, before in zip(at, now, strict=True)]
        yield first, last, np.stack(now, axis=1)


def collect(config: Config, blocks: Iterable[Samples]) -> Evidence:
    """Run the calibrated twin over a log and collect its complete cycles."""
    blocks = list(blocks)
    theta = coefficients(config.data)
    knees = knees_of(config.data, sampling_ms(max(blocks, key=len, default=np.empty(0, SAMPLE))))
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
        noise=config.data.sensor.noise_mbar,
        bins=_binned(np.empty(0, SAMPLE), np.empty(0, TICK), np.zeros(1, np.int64), [], knees),
        rows=np.empty(0, np.int64),
        terms=config.data.terms,
        knees=knees,
        uncertain=tuple(_uncertain(config)),
        calibrated=theta,
        gauge=config.gauge,
        catalogue=config.data.catalogue,
    )
    return of_log(nothing, blocks)


def of_log(beside: Evidence, blocks: Iterable[Samples]) -> Evidence:
    """What another log says beside the same twin."""
    blocks = list(bridged(blocks))
    rows = joined(np.empty(0, SAMPLE), *(block for block in blocks if are_told(block)))
    uncertain = tuple((following(up, rows), following(down, rows)) for up, down in beside.uncertain)
    theta = following(beside.theta, rows)
    beside = replace(beside, theta=theta, uncertain=uncertain, told=frozenset(told(rows)))
    knees = as_wide_as_needed(beside.knees, blocks)
    cycles = whole(Twin(beside.theta, knees, beside.terms).over(blocks))
    samples = np.concatenate([np.empty(0, SAMPLE), *(cycle.samples for cycle in cycles)])
    ticks = np.concatenate([np.empty(0, TICK), *(cycle.ticks for cycle in cycles)])
    starts = np.cumsum([0, *(len(cycle.samples) for cycle in cycles)])
    judged = [number for number, cycle in enumerate(cycles) if cycle.settled]
    return replace(
        beside,
        begin_ns=next((int(block["time_ns"][0]) for block in blocks if len(block)), 0),
        samples=samples,
        ticks=ticks,
        starts=starts,
        numbers=np.arange(len(cycles)),
        judged=judged,
        figures=[figures(cycle, beside.theta) for cycle in cycles],
        bins=_binned(samples, ticks, starts, judged, knees),
        rows=drawn_rows(samples, ticks),
        knees=knees,
        _seen={},  # by a finder with other knees
    )


def _uncertain(config: Config) -> Iterator[tuple[Theta, Theta]]:
    """Coefficients one sigma to either side, each way that calibration left the data set open.

    And each that calibration says nothing about: only one supply was ever measured.
    """
    for key, share in SUPPLY_UNKNOWN.items():
        known = getattr(config.data.supply, key)
        yield _aside(config.data, {f"supply.{key}": share * known})
    rows = config.monitor.healthy.uncertain
    for way in range(len(rows)):
        yield _aside(config.data, {name: row[way] for name, row in list(rows.items())[way:]})


def _aside(data: DataSet, changes: Mapping[str, float]) -> tuple[Theta, Theta]:
    """Coefficients with values (``table.key``) changed by so much, and by as much less."""
    up, down = (_changed(data, changes, sign) for sign in (1.0, -1.0))
    return coefficients(up), coefficients(down)


def _changed(data: DataSet, changes: Mapping[str, float], sign: float) -> DataSet:
    """A data set, unchecked as a whole: it need be no ejector. Each value keeps to its bounds."""
    for name, change in changes.items():
        table, key = name.split(".")
        part = getattr(data, table)
        value = _kept(type(part).model_fields[key], getattr(part, key), sign * change)
        data = data.model_copy(update={table: part.model_copy(update={key: value})})
    return data


def _kept(field_info: FieldInfo, value: float, change: float) -> float:
    """A value changed, but at most by OF_THE_WAY to a bound: no flow or volume is negative."""
    bounds = (getattr(one, name, None) for one in field_info.metadata for name in _BOUNDS)
    for bound in (one for one in bounds if one is not None):
        if (bound - value) * change > 0.0:
            change = math.copysign(min(abs(change), OF_THE_WAY * abs(bound - value)), change)
    return value + change


def thinned(evidence: Evidence, cycles: Sequence[int], most: int) -> Evidence:
    """The same with at most about ``most`` of its judged ``cycles``, evenly spread in pairs."""
    if len(cycles) <= most:
        return of_cycles(evidence, cycles)
    first = np.linspace(0, len(cycles) - 2, most // 2).astype(int)
    return of_cycles(evidence, [cycles[i] for i in sorted({*first, *(first + 1)})])


def of_cycles(evidence: Evidence, cycles: Sequence[int]) -> Evidence:
    """The same with only some cycles and the one before each, in which the model swings in."""
    kept = sorted({near for cycle in cycles for near in (cycle - 1, cycle) if near >= 0})
    rows = np.concatenate([np.arange(evidence.starts[k], evidence.starts[k + 1]) for k in kept])
    starts = np.cumsum([0, *(evidence.starts[k + 1] - evidence.starts[k] for k in kept)])
    judged = [kept.index(cycle) for cycle in cycles]
    samples, ticks = evidence.samples[rows], evidence.ticks[rows]
    return replace(
        evidence,
        samples=samples,
        ticks=ticks,
        starts=starts,
        numbers=evidence.numbers[kept],
        judged=judged,
        figures=[evidence.figures[k] for k in kept],
        bins=_binned(samples, ticks, starts, judged, evidence.knees),
        rows=drawn_rows(samples, ticks),
    )


def _binned(
    samples: Samples, ticks: Ticks, starts: Ints, judged: Sequence[int], knees: Knees
) -> Bins:
    """Bins of the rows of judged cycles that can be compared."""
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    usable &= np.isfinite(ticks["expected"])
    usable &= np.isin(np.searchsorted(starts, np.arange(len(samples)), "right") - 1, judged)
    usable &= ~_unsettled(ticks["phase"], knees)
    return binned(ticks["phase"], usable, starts)


def _unsettled(phase: npt.NDArray[np.uint8], knees: Knees) -> npt.NDArray[np.bool_]:
    """Rows after a knee that suction's end followed too soon for it to be found well.

    And the blow-off or idle after them, which begins at a pressure that nobody can tell.
    """
    begins = np.flatnonzero(np.diff(phase, prepend=255))
    lengths = np.diff(begins, append=len(phase))
    kind = phase[begins]
    before = np.concatenate([[255], kind[:-1]])
    sucks, sucked = (np.isin(one, [Phase.SUCTION, Phase.HOLD]) for one in (kind, before))
    after_knee = lengths - np.where(kind == Phase.SUCTION, knees.on_shift, knees.off_shift)
    soon = sucks & sucked & (after_knee < knees.settles)
    soon[1:] |= soon[:-1] & ~sucks[1:]
    return np.repeat(soon, lengths)
