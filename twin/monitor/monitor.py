"""The monitor: what happens in the stream, and when measurement and model part.

Each cycle is boiled down to its figures; a figure is judged in sigmas of what healthy cycles
scatter. An alarm is raised when one figure is far out, or when the isolation says that cycles
differ where no single one does. It is cleared, with hysteresis, when all are back for some cycles.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field

from twin.events import Event, Kind
from twin.model.effects import EFFECTS, UNKNOWN
from twin.model.theta import Theta
from twin.monitor.clock import ClockWatch
from twin.monitor.cycles import (
    LONGEST_PIECE,
    MEASURED,
    Cycle,
    CycleCutter,
    CycleView,
    Teller,
    Told,
    figures,
)
from twin.monitor.gaps import gap_event
from twin.monitor.healthy import NOT_COMMISSIONED, Healthy
from twin.monitor.likeness import Likeness
from twin.monitor.signal_checks import ReportWatch
from twin.monitor.surroundings import following
from twin.settings import Settings
from twin.signals import (
    BREAK,
    NEW_TIME,
    NS,
    SAMPLE,
    TICK,
    Quality,
    Samples,
    Ticks,
    joined,
)

if TYPE_CHECKING:  # its SciPy would be imported with every configuration
    from twin.monitor.baseline import Baseline
    from twin.monitor.isolation import Heard, Isolation, Verdict

_UNFIT = int(Quality.OUT_OF_RANGE | Quality.OVERFLOW | Quality.STALE | Quality.BAD)
# Of a cycle's samples, to judge it: commands seen late look like a deviation. Usual records lack up
# to a twentieth of their rows.
FEWEST_SHARE = 0.9
RIVAL = 0.05  # probability from which on another cause is named as well, or a standing name holds
# Probability of something unlisted, from which on a cause found by its signature does not suit, and
# is sought in the size that it has. Where one suits, that is 0.01 to 0.05; else up to a third.
UNSUITED = 0.1
ALIKE = 0.2  # of how far out a cycle is: by so much its figures may move before the cause is sought
RENAMED = 3  # cycles in a row that must agree on another name before a standing alarm gets it
LONGEST_RING_NS = 120_000_000_000  # of rows that a PLC keeps while nobody reads them
CLEARS = 3.5  # sigmas of a figure, below which a cycle is as healthy ones
LARGE = 6.0  # sigmas: from less nothing else is told to begin
SHORTEST_S = 0.1  # that a cycle takes
GREW = 2.0  # times as far out as any cycle before: something else has begun
PHASES = {"h1": "suction", "h1_low": "hold"}  # which a level of the air saving ends


class MonitorSettings(Settings):
    """When a deviation is an alarm."""

    false_alarm_days: float = Field(30.0, gt=0.0)  # between false alarms of any kind, of a unit
    clear_cycles: int = Field(3, ge=1)  # so many usual ones in a row clear the alarm
    smallest_mbar: float = Field(0.5, ge=0.0)  # deviations below are never worth an alarm
    stale_ms: float = Field(500.0, gt=0.0)  # without a new row, after which the PLC is stale
    isolate: bool = True  # step a bank of hypotheses beside the twin, and sum over cycles
    healthy: Healthy = Healthy()


class Outlier(NamedTuple):
    """The figure of a cycle that is farthest from healthy."""

    figure: str
    excess: float  # mbar
    sigmas: float
    normal: float  # the standard normal value that is as improbable

    @property
    def place(self) -> str:
        """Where in the cycle it is, a phase or a level."""
        return self.figure.rsplit("_", 1)[0].replace("_", "-")

    @property
    def phase(self) -> str:
        """The phase it is measured in, for people."""
        where = self.figure.rsplit("_", 1)[0]
        return PHASES.get(where, where).replace("_", "-")

    def plain(self) -> dict[str, float | int | str]:
        """As JSON has it."""
        phase = self.phase.replace("-", "_")
        return {
            "figure": self.figure,
            "phase": phase,
            "excess_mbar": self.excess,
            "sigma": self.sigmas,
        }


@dataclass
class Monitor:
    """Takes rows in, gives events out; all of it in PLC time, so a replay gives the same."""

    settings: MonitorSettings
    theta: Theta
    teller: Teller | None = None  # of key figures, for what is said of each cycle
    active: str = ""  # the standing alarm's effect, or UNKNOWN; empty while there is none
    isolation: "Isolation | None" = None
    clocks: ClockWatch | None = field(default_factory=ClockWatch)  # None: the PLC has none
    reports: ReportWatch | None = None  # of signals beside pressure and commands
    judges: bool = True  # cycles; not where nobody recorded the commands
    _cutter: CycleCutter = field(default_factory=CycleCutter)
    _before: Cycle | None = None
    _cycles: int = 0  # that were judged, and how long they took (s)
    _seconds: float = 0.0
    _sought: Mapping[str, float] = field(default_factory=dict)  # figures, as the cause was sought
    _mixed: int | None = None  # the cycle in which something may have begun, not yet named
    _rival: tuple[str, int] = ("", 0)  # another name for the standing alarm, cycles that gave it
    _farthest: float = 0.0  # sigmas by which a cycle was out since the alarm was raised
    _quiet_cycles: int = 0
    _last: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))  # row of the stream
    _fresh: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))  # the last that was
    _silences: set[int] = field(default_factory=set)  # told of, by PLC time of the row before
    _unfit: int = 0  # quality bits that stand
    _baseline: "Baseline" = field(init=False)  # what each figure is in healthy cycles

    def __post_init__(self) -> None:
        """Have what is compiled at hand, not to fall into a block."""
        from twin.monitor import naming  # noqa: PLC0415 - with SciPy
        from twin.monitor.baseline import Baseline  # noqa: PLC0415 - with SciPy

        self._baseline = Baseline(self.settings.healthy)
        nothing = Cycle(0, np.zeros(1, SAMPLE), np.zeros(1, TICK), complete=False)
        figures(nothing, self.theta)
        naming.compiled_for(nothing)

    def update(self, samples: Samples, ticks: Ticks) -> list[Event]:
        """Take rows with the twin's ticks; give what they make happen."""
        return [event for _, _, events in self.over(samples, ticks) for event in events]

    def over(
        self, samples: Samples, ticks: Ticks, happened: Sequence[Event] = ()
    ) -> Iterator[tuple[Samples, Ticks, list[Event]]]:
        """Take rows with the twin's ticks; give them with what they make happen, in order of time.

        Each part is of one PLC time: what a row with another one ends comes with the rows before
        it. ``happened`` is what is known already since the rows of the last call. The last part
        may be empty.
        """
        events, part = [*happened], 0
        new_time = np.flatnonzero(samples["quality"] & NEW_TIME)
        breaks = np.flatnonzero(samples["quality"] & BREAK)
        bounds = {0, *breaks.tolist(), *(new_time + 1).tolist(), len(samples)}
        for begin, end in pairwise(sorted(bounds)):
            found = self._watch(samples[begin:end], ticks[begin:end])
            if samples["quality"][begin] & NEW_TIME:  # then it is this row alone
                now_ns = int(samples["time_ns"][begin])
                events += [event for event in found if event.time_ns != now_ns]
                if events or part < begin:
                    yield samples[part:begin], ticks[part:begin], in_order(events)
                events, part = [event for event in found if event.time_ns == now_ns], begin
            else:
                events += found
        yield samples[part:], ticks[part:], in_order(events)
        if self.teller:
            self.teller.ahead(*self._cutter.begun)
        if self.isolation:
            self.isolation.ahead(*self._cutter.begun)

    def _watch(self, samples: Samples, ticks: Ticks) -> list[Event]:
        """What rows make happen; a break may stand before the first one only."""
        found = list(self._stream_events(samples))
        silent = any(event.kind is Kind.PLC_BACK for event in found)
        silent |= bool(samples["quality"][0] & Quality.OURS)
        found += self._judge(list(self._cutter.push(samples, ticks)), silent)
        return found + (self.clocks.push(samples) if self.clocks else [])

    def silent(self, last: np.void, listened_ns: int) -> list[Event]:
        """PLC_STALE, once, if the twin has listened too long since the ``last`` fresh row (ns)."""
        if self.is_stale(last) or listened_ns <= self.stale_ns:
            return []
        return [self._stale(int(last["time_ns"]))]

    def is_stale(self, last: np.void) -> bool:
        """Whether PLC_STALE was said after this fresh row."""
        return int(last["time_ns"]) in self._silences

    @property
    def stale_ns(self) -> int:
        """How long nothing fresh may come."""
        return round(self.settings.stale_ms * 1e6)

    def close(self) -> list[Event]:
        """Judge the cycle that the end cut off, and say what is still to be said of the clocks."""
        stale = bool(self._silences)
        events = self._judge(list(self._cutter.flush()), stale)
        return events + (self.clocks.close() if self.clocks else [])

    # --- the stream -----------------------------------------------------------------------------

    def _stream_events(self, samples: Samples) -> Iterator[Event]:
        """Find the rows at which something happened to the stream; most blocks have none."""
        if not len(samples):
            return
        if self._nothing_happens(samples):
            self._last = self._fresh = samples[-1:].copy()
            return
        rows = joined(self._fresh, self._last, samples)
        first = len(rows) - len(samples)
        quality = rows["quality"]
        changes = np.diff(quality & _UNFIT, prepend=np.uint8(self._unfit)) != 0
        changes |= (quality & BREAK) != 0
        fresh = (quality & Quality.STALE) == 0
        latest = np.maximum.accumulate(np.where(fresh, np.arange(len(rows)), -1))
        before = np.concatenate([[-1], latest[:-1]])  # the last fresh row before each
        silent = rows["host_ns"] - rows["host_ns"][before] > self.stale_ns
        silent &= (quality & Quality.OURS) == 0
        silent |= np.isin(rows["time_ns"][before], list(self._silences))  # it was said while it was
        silent &= before >= 0
        changes |= silent & (fresh | ~np.concatenate([[False], (silent & ~fresh)[:-1]]))
        for row in np.flatnonzero(changes):
            if row >= first:
                heard = rows[before[row]] if silent[row] else None
                yield from self._row_events(rows[row - 1] if row else None, rows[row], heard)
        self._last = rows[-1:].copy()
        self._fresh = rows[fresh][-1:].copy()

    def _nothing_happens(self, samples: Samples) -> bool:
        """Whether rows are all good, and all came since the last fresh one without a silence."""
        if self._unfit or self._silences or samples["quality"].any():
            return False
        came = np.concatenate([self._fresh["host_ns"], samples["host_ns"]])
        return int(np.diff(came).max(initial=0)) <= self.stale_ns

    def _row_events(
        self, before: np.void | None, row: np.void, heard: np.void | None
    ) -> list[Event]:
        """What a row brings; ``heard`` is the last fresh one, if that was too long ago."""
        time_ns, quality = int(row["time_ns"]), int(row["quality"])
        events = []
        if heard is not None:
            events += self._silence_events(row, heard)
        if quality & Quality.RESTART:
            text = f"the PLC restarted; its sequence goes on at {int(row['sequence'])}"
            events.append(Event(time_ns, Kind.PLC_RESTARTED, text))
        if quality & Quality.CLOCK and before is not None:
            jump = (time_ns - int(before["time_ns"])) * NS
            text = f"PLC time jumped by {jump:+.3f} s"
            events.append(Event(time_ns, Kind.CLOCK_JUMPED, text, {"jump_s": jump}))
        if quality & Quality.GAP and before is not None:
            events.append(gap_event(before, row))
        if (quality ^ self._unfit) & _UNFIT:
            self._unfit = quality & _UNFIT
            what = str(Quality(self._unfit).name).lower().replace("_", " ").replace("|", ", ")
            kind = Kind.SIGNAL_BAD if self._unfit else Kind.SIGNAL_GOOD
            text = f"pressure signal: {what}" if self._unfit else "pressure signal is good again"
            events.append(Event(time_ns, kind, text, {"quality": self._unfit}))
        return events

    def _silence_events(self, row: np.void, heard: np.void) -> list[Event]:
        """One that it is stale, unless that was told, and one that it is back, once it is."""
        since_ns = int(heard["time_ns"])
        events = [] if since_ns in self._silences else [self._stale(since_ns)]
        if not row["quality"] & Quality.STALE:
            self._silences.remove(since_ns)
            silence_ns = max(_apart_ns(heard, row), self.stale_ns)
            silence_ms = silence_ns * NS * 1e3
            text = f"the PLC is back after {silence_ms / 1e3:.2f} s"
            data = {"silence_ms": silence_ms}
            time_ns = int(row["time_ns"])
            if not row["quality"] & NEW_TIME:
                time_ns = max(time_ns, since_ns + self.stale_ns)  # a ring may have filled the pause
            events.append(Event(time_ns, Kind.PLC_BACK, text, data))
        return events

    def _stale(self, last_time_ns: int) -> Event:
        self._silences.add(last_time_ns)
        text = f"no fresh sample for {self.settings.stale_ms:.0f} ms: check PLC and network"
        return Event(last_time_ns + self.stale_ns, Kind.PLC_STALE, text, {"since_ns": last_time_ns})

    # --- the cycles -----------------------------------------------------------------------------

    def _judge(self, cycles: Sequence[Cycle], silent: bool) -> list[Event]:
        """Their figures, and alarms; none of one that a ``silent`` PLC cut off.

        Each step is taken for all of them before the next one. So its code stays in the processor's
        caches, and what a cycle costs while a log is replayed is a third less.
        """
        looks = [self._look(cycle, silent and cycle.cut_short) for cycle in cycles]
        told = [self.teller.take(one) if self.teller else None for one in cycles]
        heard = self.isolation.hear(looks) if self.isolation else [None] * len(cycles)
        found = map(self._conclude, looks, told, heard)
        checked = [[*self.reports.take(one)] if self.reports else [] for one in cycles]
        return [
            one for some in zip(found, checked, strict=True) for events in some for one in events
        ]

    def _look(self, cycle: Cycle, silent: bool) -> CycleView:
        """Its figures, and whether it can be judged."""
        before, self._before = self._before, cycle
        whole = cycle.complete or len(cycle.samples) >= LONGEST_PIECE
        stale = silent or cycle.stale or (before is not None and before.stale)
        fit = (
            self.judges and whole and cycle.settled and cycle.coverage >= FEWEST_SHARE and not stale
        )
        found = figures(cycle, following(self.theta, cycle.samples))
        if not self.judges:  # what hangs on the model
            found = {name: value for name, value in found.items() if name in MEASURED}
        return CycleView(cycle, before, found, fit)

    def _conclude(self, look: CycleView, told: Told | None, heard: "Heard | None") -> list[Event]:
        """What there is to say of a cycle, and an alarm if it is one."""
        cycle, before, found, judged = look
        worst, is_out = self._worst(cycle, found) if judged else (None, False)
        far = abs(worst.sigmas) if worst else 0.0
        begins = is_out and self._begins(cycle, far)
        verdict = self._isolate(heard, far if is_out else 0.0, begins)
        events = [_summary(cycle, found, told, verdict)] if cycle.complete or told else []
        if not judged or (worst is None and verdict is None):
            return events
        quiet, self._quiet_cycles = self._quiet_cycles, 0
        if worst and is_out:
            if begins:
                events.append(self._begin(worst, cycle))
            elif not self._stands(cycle, worst, found, verdict):
                self._sought = found
                events += self._deviation(worst, before, cycle, verdict)
        elif verdict and self._is_to_tell(verdict):
            events.append(self._change(cycle, verdict))
        elif self.active and not self._is_far(worst) and not self._differs:
            self._quiet_cycles = quiet + 1
            if self._quiet_cycles >= self.settings.clear_cycles:
                events.append(self._cleared(cycle))
                self.active, self._rival = "", ("", 0)
        if not is_out:
            self._mixed = None
        self._farthest = max(self._farthest, far) if self.active else 0.0
        return events

    def _cleared(self, cycle: Cycle) -> Event:
        was = f"it had looked like {self.active}"
        if self.active == UNKNOWN:
            was = "its cause was not named"
        text = f"measurement and model agree again; {was}"
        return Event(cycle.end_ns, Kind.DEVIATION_CLEARED, text, {"effect": self.active})

    def _begins(self, cycle: Cycle, far: float) -> bool:
        """Whether something begins with a cycle that is ``far`` out (sigma).

        So it does where none stands, and where it is much farther out than any since. After the
        cycle in which it began the next one may be, for that one had a part of it only.
        """
        if not self.active:
            return True
        grew = far > GREW * max(self._farthest, LARGE)
        return grew and self._mixed is None and not cycle.cut_short

    def _is_to_tell(self, verdict: "Verdict") -> bool:
        """Whether the isolation has an alarm to raise, or a name for one that has none."""
        if not self.active:
            return verdict.raised and bool(verdict.causes)
        return self.active == UNKNOWN and _names(verdict)

    @property
    def _is_commissioned(self) -> bool:
        """Whether the twin is near enough to the unit that what it gets wrong names a cause."""
        return self.settings.healthy.is_known

    @property
    def _differs(self) -> bool:
        """Whether cycles differ together, if no single one does."""
        return self.isolation is not None and self.isolation.stands

    def _isolate(self, heard: "Heard | None", far: float, begins: bool) -> "Verdict | None":
        """What the isolation holds; it does not learn what is usual from what is far out."""
        if self.isolation is None or heard is None:
            return None
        verdict = self.isolation.judge(heard, far, begins=begins)
        return verdict if self._is_commissioned or verdict is None else verdict.unnamed()

    def _worst(self, cycle: Cycle, found: Mapping[str, float]) -> tuple[Outlier | None, bool]:
        """The figure that is farthest from healthy, and whether this alone is an alarm.

        An alarm that stands without a name is named by less.
        """
        self._cycles, self._seconds = self._cycles + 1, self._seconds + cycle.seconds
        normal = self._baseline.normal(found, self.settings.smallest_mbar)
        excess = self._baseline.excess(found)
        sigmas = excess / self._baseline.sigma
        columns = zip(self._baseline.names, excess, sigmas, normal, strict=True)
        outliers = [
            Outlier(name, *map(float, numbers)) for name, *numbers in columns if name in found
        ]
        if not outliers:
            return None, False
        seconds = max(self._seconds / self._cycles, SHORTEST_S)
        limit = self._baseline.limit(self.settings.false_alarm_days, seconds, len(outliers))
        worst = max(outliers, key=lambda one: _weight(one, limit))
        if not self.active:
            self._baseline.learn(found, normal)
        return worst, abs(worst.normal) >= (CLEARS if self.active == UNKNOWN else limit)

    def _is_far(self, worst: Outlier | None) -> bool:
        """Whether one figure of a cycle keeps an alarm from being over."""
        return worst is not None and abs(worst.normal) >= CLEARS

    def _change(self, cycle: Cycle, verdict: "Verdict") -> Event:
        """Raise the alarm for what no single cycle shows, or name the one that stands."""
        self.active, self._sought = verdict.causes[0].effect, {}
        what = f"{verdict.since} cycles: {abs(verdict.sigmas):.1f} sigma off in each"
        measured: dict[str, float | int | str] = {"figure": "cycles", "cycles": verdict.since}
        measured["sigma"] = verdict.sigmas
        return self._raised(cycle, what, measured, verdict.causes)

    def _begin(self, worst: Outlier, cycle: Cycle) -> Event:
        """Raise the alarm with the first cycle that shows it.

        It has no name: nobody knows when in this cycle it began.
        """
        self.active, self._mixed, self._sought = UNKNOWN, cycle.index, {}
        what = (
            f"something has changed, most in {worst.phase}:"
            f" {worst.excess:+.1f} mbar from healthy ({worst.sigmas:+.0f} sigma)"
        )
        return self._raised(cycle, what, worst.plain(), [Likeness(UNKNOWN, None, "", 1.0)])

    def _stands(
        self, cycle: Cycle, worst: Outlier, found: Mapping[str, float], verdict: "Verdict | None"
    ) -> bool:
        """Whether the standing alarm holds for a cycle without its cause being sought again.

        So it does in one that was cut short, and in one that is off as that was in which it was
        last sought: no other would be found, and to seek it takes long. What the isolation says is
        there already. The first cycle that is off in another way may be off in a part of it only:
        the cause is sought in the next one.
        """
        if cycle.cut_short or cycle.index == self._mixed:
            return True
        if self._small(verdict) or self._rival[1]:
            return False
        if found.keys() == self._sought.keys():
            names = [name for name in self.settings.healthy.figures if name in found]
            moved = max(abs(found[name] - self._sought[name]) for name in names)
            if moved < ALIKE * abs(worst.excess):
                self._mixed = None
                return True
        if self._mixed is not None:
            return False
        self._mixed = cycle.index
        return True

    def _deviation(
        self, worst: Outlier, before: Cycle | None, cycle: Cycle, verdict: "Verdict | None"
    ) -> list[Event]:
        """Name the alarm, or name it anew when another cause than the standing one fits."""
        if not self._is_commissioned:
            return []
        ranking = self._name(worst, before, cycle, verdict)
        self._mixed = None
        if not ranking:
            self._rival = ("", 0)
            return []
        if not self._is_renamed(ranking):
            return []
        self.active = ranking[0].effect
        what = f"{worst.place}: {worst.excess:+.1f} mbar from healthy ({worst.sigmas:+.0f} sigma)"
        return [self._raised(cycle, what, worst.plain(), ranking)]

    def _small(self, verdict: "Verdict | None") -> Sequence[Likeness]:
        """Causes by the isolation, if the foremost is as small as its signatures are and suits.

        None against another name that stands: of something large they say nothing.
        """
        if not verdict or not verdict.causes or not verdict.causes[0].is_small:
            return ()
        causes = verdict.where_changed().causes
        suits = causes[-1].share < UNSUITED
        return causes if suits and self.active in (UNKNOWN, causes[0].effect) else ()

    def _is_renamed(self, ranking: Sequence[Likeness]) -> bool:
        """Whether the best of a ranking becomes the alarm's name.

        The first name does at once. Another one does after ``RENAMED`` cycles in a row in which
        the standing name is improbable, so that a single odd cycle changes nothing.
        """
        best = ranking[0]
        standing = max((one.share for one in ranking if one.effect == self.active), default=0.0)
        if standing >= RIVAL and self.active != UNKNOWN:
            self._rival = ("", 0)
            return False
        name, cycles = self._rival
        self._rival = (best.effect, cycles + 1 if name == best.effect else 1)
        if self.active != UNKNOWN and self._rival[1] < RENAMED:
            return False
        self._rival = ("", 0)
        return True

    def _raised(
        self,
        cycle: Cycle,
        what: str,
        measured: Mapping[str, float | int | str],
        causes: Sequence[Likeness],
    ) -> Event:
        """The alarm: ``what`` is off, and what fits it, the most probable first."""
        best, *others = causes
        also = [one.effect for one in others if one.effect != UNKNOWN and one.share >= RIVAL]
        why = best.words if self._is_commissioned else NOT_COMMISSIONED
        text = "; ".join([what, why]) + "".join(f", or {', '.join(also)}" for _ in also[:1])
        data = {"cycle": cycle.index, **measured, **best.plain(), "also": ",".join(also)}
        if not self._is_commissioned:
            data["commissioned"] = False
        return Event(cycle.end_ns, Kind.DEVIATION, text, data)

    def _name(
        self, worst: Outlier, before: Cycle | None, cycle: Cycle, verdict: "Verdict | None"
    ) -> Sequence[Likeness]:
        """Rank the causes of a cycle's deviation; the cycle before lets the model swing in.

        Empty where nothing in the table fits.
        """
        from twin.inference.unmodelled import MOST_SURE  # noqa: PLC0415 - with SciPy
        from twin.monitor.naming import likenesses  # noqa: PLC0415 - with SciPy

        if small := self._small(verdict):
            return small
        if worst.figure.endswith("_level"):  # and nothing else: only the thresholds moved
            if verdict is not None and _names(verdict):
                return verdict.where_changed().causes
            shift = EFFECTS["threshold_drift"].parameters[0]
            size = shift.reported(worst.excess, self.theta)
            return [Likeness("threshold_drift", size, shift.unit, MOST_SURE)]
        parts = [cycle] if before is None else [before, cycle]
        samples = np.concatenate([part.samples for part in parts])
        ticks = np.concatenate([part.ticks for part in parts])
        begin = len(samples) - len(cycle.samples)
        known = self.isolation.known if self.isolation else ()
        theta = following(self.theta, samples)
        return likenesses(theta, self.settings.healthy, samples, ticks, begin, known)


def _weight(outlier: Outlier, limit: float) -> tuple[bool, float]:
    """Sensors move the levels too, and say more about themselves in the course."""
    far = abs(outlier.sigmas)
    level = outlier.figure.endswith("_level")
    return abs(outlier.normal) >= limit, far / 3.0 if level else far


def _names(verdict: "Verdict | None") -> bool:
    """Whether the isolation has a name for what differs."""
    return bool(verdict and verdict.causes and verdict.causes[0].effect != UNKNOWN)


def in_order(events: Iterable[Event]) -> list[Event]:
    """Events of one PLC time in the order of time; of the same moment, as they came."""
    return sorted(events, key=lambda event: event.time_ns)


def _apart_ns(heard: np.void, row: np.void) -> int:
    """Time between the receipts of two rows.

    A wall clock that was set between them shows as far more, or less, than PLC time ran on: then
    PLC time it is, less what a ring kept.
    """
    by_receipt, by_plc = (int(row[name]) - int(heard[name]) for name in ("host_ns", "time_ns"))
    was_set = not 0 <= by_receipt - by_plc <= LONGEST_RING_NS
    runs_on = not row["quality"] & NEW_TIME
    return by_plc if was_set and runs_on else by_receipt


def _summary(
    cycle: Cycle, found: Mapping[str, float], told: Told | None, verdict: "Verdict | None"
) -> Event:
    """What there is to say of a cycle; in the words of who tells most of it."""
    data: dict[str, Any] = {"cycle": cycle.index}
    data |= {name: round(value, 3) for name, value in found.items()}
    if verdict is not None:
        data["probabilities"] = verdict.plain()
    if told is not None:
        if not cycle.complete:  # a piece's own figures are not the cycle's
            data = {}
        data = {name: value for name, value in data.items() if not name.startswith("t0_")}
        return Event(told.end_ns, Kind.CYCLE, told.words, data | told.plain())
    text = f"cycle {cycle.index}"
    if "t0_measured" in found:
        text += f": evacuated to H2 in {found['t0_measured']:.0f} ms"
        if "t0_expected" in found:
            text += f" (expected {found['t0_expected']:.0f} ms)"
    return Event(cycle.end_ns, Kind.CYCLE, text, data)
