"""The monitor: events of the stream, and alarms when measurement and model differ.

Each cycle is reduced to its figures; a figure is judged in sigmas of the scatter of healthy cycles.
An alarm is raised if one figure is far out, or if the isolation finds that cycles differ although
no single one does. It is cleared, with hysteresis, when all figures are back for some cycles.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from twin.events import Event, Kind
from twin.model import theta as c
from twin.model.effects import UNKNOWN, standing_for
from twin.model.theta import Theta
from twin.monitor.clock import ClockWatch
from twin.monitor.cycles import (
    LONGEST_PIECE,
    MEASURED,
    Cycle,
    CycleCutter,
    CycleKeyFigures,
    CycleView,
    KeyFigureSource,
    figures,
    lost_a_switching,
    met_no_part,
)
from twin.monitor.gaps import gap_event
from twin.monitor.healthy import NOT_COMMISSIONED
from twin.monitor.likeness import Likeness
from twin.monitor.settings import MonitorSettings
from twin.monitor.signal_checks import ReportWatch
from twin.monitor.surroundings import Surroundings, following
from twin.quality import BREAK, NEW_TIME, Quality
from twin.signals import NS, SAMPLE, TICK, LastRow, Samples, Ticks, joined

if TYPE_CHECKING:  # its SciPy would be imported with every configuration
    from twin.monitor.baseline import Baseline
    from twin.monitor.isolation import CycleScores, Isolation, Verdict

_UNFIT = int(Quality.OUT_OF_RANGE | Quality.OVERFLOW | Quality.STALE | Quality.BAD)
# Share of a cycle's samples needed to judge it: commands seen late look like a deviation. Usual
# records lack up to a twentieth of their rows.
FEWEST_SHARE = 0.9
RIVAL = 0.05  # least probability to name another cause as well, or to keep a standing name
# Probability of something unlisted above which a cause found by its signature does not suit: the
# cause is then searched with its full size. If one suits, it is 0.01 to 0.05; else up to a third.
UNSUITED = 0.1
# Probability of a moved threshold where switching levels alone are off: of six drawn faults in two
# worlds that were named so, four were one (tools.naming_trial).
LEVELS_ALONE = 0.65
ALIKE = 0.2  # largest change of figures, over the excess, without a new search for the cause
RENAMED = 3  # cycles in a row that must agree on another name before a standing alarm gets it
LONGEST_RING_NS = 120_000_000_000  # longest time of rows that a PLC keeps while nobody reads them
CLEARS = 3.5  # sigmas of a figure, below which a cycle counts as healthy
LARGE = 6.0  # sigmas: a cycle must exceed GREW times this for a second cause to begin
SHORTEST_S = 0.1  # shortest duration of a cycle
GREW = 2.0  # factor over the farthest cycle so far from which something else has begun
PHASES = {"h1": "suction", "h1_low": "hold"}  # phases that end at a level of the air saving


class Outlier(NamedTuple):
    """The figure of a cycle that is farthest from healthy."""

    figure: str
    excess: float  # mbar
    sigmas: float
    normal: float  # the equally improbable standard normal value

    @property
    def place(self) -> str:
        """Place in the cycle: a phase or a level."""
        return self.figure.rsplit("_", 1)[0].replace("_", "-")

    @property
    def phase(self) -> str:
        """The phase it is measured in, for people."""
        place = self.figure.rsplit("_", 1)[0]
        return PHASES.get(place, place).replace("_", "-")

    def plain(self) -> dict[str, float | int | str]:
        """The outlier for JSON."""
        phase = self.phase.replace("-", "_")
        return {
            "figure": self.figure,
            "phase": phase,
            "excess_mbar": self.excess,
            "sigma": self.sigmas,
        }


@dataclass
class Monitor:
    """Turns rows into events; all in PLC time, so a replay gives the same."""

    settings: MonitorSettings
    theta: Theta
    # Source of key figures for the event of each cycle.
    key_figure_source: KeyFigureSource | None = None
    active: str = ""  # the standing alarm's effect, or UNKNOWN; empty while there is none
    isolation: "Isolation | None" = None
    clocks: ClockWatch | None = field(default_factory=ClockWatch)  # None: the PLC has none
    reports: ReportWatch | None = None  # checks signals beside pressure and commands
    judges: bool = True  # judge cycles; not if the commands were not recorded
    _cutter: CycleCutter = field(default_factory=CycleCutter)
    _before: Cycle | None = None
    _cycles: int = 0  # judged so far, and their duration (s)
    _seconds: float = 0.0
    _diagnosed: Mapping[str, float] = field(
        default_factory=dict
    )  # figures at the last search for the cause
    _mixed_cycle: int | None = None  # cycle in which something may have begun, not yet named
    _rival: tuple[str, int] = ("", 0)  # another name for the standing alarm, cycles that gave it
    _farthest: float = 0.0  # largest excess (sigmas) of a cycle since the alarm was raised
    _quiet_cycles: int = 0
    _without_part: tuple[bool, bool] = False, False  # whether the last two whole cycles met no part
    _without_switching: tuple[bool, bool] = False, False  # whether they lost the nozzle's switching
    _last: LastRow = field(default_factory=LastRow)
    _fresh: LastRow = field(default_factory=LastRow)  # that is not stale
    _silences: set[int] = field(default_factory=set)  # reported, by PLC time of the row before
    _unfit: int = 0  # quality bits that are set now
    _baseline: "Baseline" = field(init=False)  # figures of healthy cycles

    def __post_init__(self) -> None:
        """Compile now, so that no block has to wait for it."""
        from twin.monitor import naming  # noqa: PLC0415 - with SciPy
        from twin.monitor.baseline import Baseline  # noqa: PLC0415 - with SciPy

        self._baseline = Baseline(self.settings.healthy)
        self._surroundings = Surroundings(self.theta)
        nothing = Cycle(0, np.zeros(1, SAMPLE), np.zeros(1, TICK), complete=False)
        figures(nothing, self.theta)
        naming.compiled_for(nothing)

    def adjust(self, settings: MonitorSettings) -> None:
        """Judge by other settings from the next cycle on; ``healthy`` must be the same."""
        self.settings = settings
        if self.isolation:
            self.isolation.days = settings.false_alarm_days

    def update(self, samples: Samples, ticks: Ticks) -> list[Event]:
        """Take rows with the twin's ticks; give their events."""
        return [event for _, _, events in self.over(samples, ticks) for event in events]

    def over(
        self, samples: Samples, ticks: Ticks, happened: Sequence[Event] = ()
    ) -> Iterator[tuple[Samples, Ticks, list[Event]]]:
        """Take rows with the twin's ticks; give them in parts with their events, in order of time.

        Each part has one PLC time: if a row begins a new time, events of the old one come with the
        rows before it. ``happened`` are other events since the last call. The last part may be
        empty.
        """
        events, part = [*happened], 0
        new_time = np.flatnonzero(samples["quality"] & NEW_TIME)
        breaks = np.flatnonzero(samples["quality"] & BREAK)
        bounds = {0, *breaks.tolist(), *(new_time + 1).tolist(), len(samples)}
        for begin, end in pairwise(sorted(bounds)):
            new_events = self._watch(samples[begin:end], ticks[begin:end])
            if samples["quality"][begin] & NEW_TIME:  # then it is this row alone
                now_ns = int(samples["time_ns"][begin])
                events += [event for event in new_events if event.time_ns != now_ns]
                if events or part < begin:
                    yield samples[part:begin], ticks[part:begin], in_order(events)
                events, part = [event for event in new_events if event.time_ns == now_ns], begin
            else:
                events += new_events
        yield samples[part:], ticks[part:], in_order(events)
        if begun := self._cutter.begun():
            if self.key_figure_source:
                self.key_figure_source.run_ahead(*begun)
            if self.isolation:
                self.isolation.run_ahead(*begun)

    def _watch(self, samples: Samples, ticks: Ticks) -> list[Event]:
        """Events of rows; only the first row may have a break before it."""
        events = list(self._stream_events(samples))
        silent = any(event.kind is Kind.PLC_BACK for event in events)
        silent |= bool(samples["quality"][0] & Quality.OURS)
        events += self._judge(list(self._cutter.push(samples, ticks)), silent)
        return events + (self.clocks.push(samples) if self.clocks else [])

    def silent(self, last: np.void, listened_ns: int) -> list[Event]:
        """PLC_STALE, once, if the twin has listened too long (ns) since the ``last`` fresh row."""
        if self.is_stale(last) or listened_ns <= self.stale_ns:
            return []
        return [self._stale(int(last["time_ns"]))]

    def is_stale(self, last: np.void) -> bool:
        """Whether PLC_STALE was reported after this fresh row."""
        return int(last["time_ns"]) in self._silences

    @property
    def stale_ns(self) -> int:
        """Longest time (ns) without a fresh row."""
        return round(self.settings.stale_ms * 1e6)

    def close(self) -> list[Event]:
        """Judge the cycle that the end cut off, and report the clocks."""
        stale = bool(self._silences)
        events = self._judge(list(self._cutter.flush()), stale)
        return events + (self.clocks.close() if self.clocks else [])

    # --- the stream -----------------------------------------------------------------------------

    def _stream_events(self, samples: Samples) -> Iterator[Event]:
        """Events of the stream itself; most blocks have none."""
        if not len(samples):
            return
        if self._is_uneventful(samples):
            self._last.keep(samples)
            self._fresh.keep(samples)
            return
        rows = joined(self._fresh.row, self._last.row, samples)
        first = len(rows) - len(samples)
        quality = rows["quality"]
        changes = np.diff(quality & _UNFIT, prepend=np.uint8(self._unfit)) != 0
        changes |= (quality & BREAK) != 0
        fresh = (quality & Quality.STALE) == 0
        latest = np.maximum.accumulate(np.where(fresh, np.arange(len(rows)), -1))
        before = np.concatenate([[-1], latest[:-1]])  # the last fresh row before each
        silent = rows["host_ns"] - rows["host_ns"][before] > self.stale_ns
        silent &= (quality & Quality.OURS) == 0
        silent |= np.isin(rows["time_ns"][before], list(self._silences))  # reported while it lasted
        silent &= before >= 0
        changes |= silent & (fresh | ~np.concatenate([[False], (silent & ~fresh)[:-1]]))
        for row in np.flatnonzero(changes):
            if row >= first:
                last_fresh = rows[before[row]] if silent[row] else None
                yield from self._row_events(rows[row - 1] if row else None, rows[row], last_fresh)  # pyright: ignore[reportArgumentType]
        self._last.keep(samples)
        self._fresh.keep(rows[fresh])

    def _is_uneventful(self, samples: Samples) -> bool:
        """Whether all rows are good, and there was no silence since the last fresh one."""
        if self._unfit or self._silences or samples["quality"].any():
            return False
        came = np.concatenate([self._fresh.row["host_ns"], samples["host_ns"]])
        return int(np.diff(came).max(initial=0)) <= self.stale_ns

    def _row_events(
        self, before: np.void | None, row: np.void, last_fresh: np.void | None
    ) -> list[Event]:
        """Events of a row; ``last_fresh`` is the last fresh row if that was too long ago."""
        time_ns, quality = int(row["time_ns"]), int(row["quality"])
        events = []
        if last_fresh is not None:
            events += self._silence_events(row, last_fresh)
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
            quality_text = (
                str(Quality(self._unfit).name).lower().replace("_", " ").replace("|", ", ")
            )
            kind = Kind.SIGNAL_BAD if self._unfit else Kind.SIGNAL_GOOD
            text = (
                f"pressure signal: {quality_text}"
                if self._unfit
                else "pressure signal is good again"
            )
            events.append(Event(time_ns, kind, text, {"quality": self._unfit}))
        return events

    def _silence_events(self, row: np.void, last_fresh: np.void) -> list[Event]:
        """PLC_STALE, unless reported already, and PLC_BACK if the row is fresh."""
        since_ns = int(last_fresh["time_ns"])
        events = [] if since_ns in self._silences else [self._stale(since_ns)]
        if not row["quality"] & Quality.STALE:
            self._silences.remove(since_ns)
            silence_ns = max(_silence_ns(last_fresh, row), self.stale_ns)
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
        """Events of cycles: figures and alarms; no alarm for one that a ``silent`` PLC cut off.

        Each step is taken for all cycles before the next step. So its code stays in the processor's
        caches, and the time for a cycle in a replay is a third less.
        """
        views = [self._view(cycle, silent and cycle.cut_short) for cycle in cycles]
        key_figures = [
            self.key_figure_source.take(cycle) if self.key_figure_source else None
            for cycle in cycles
        ]
        scores = self.isolation.extract(views) if self.isolation else [None] * len(cycles)
        concluded = map(self._conclude, views, key_figures, scores)
        checked = [[*self.reports.take(cycle)] if self.reports else [] for cycle in cycles]
        return [
            event
            for event_lists in zip(concluded, checked, strict=True)
            for events in event_lists
            for event in events
        ]

    def _view(self, cycle: Cycle, silent: bool) -> CycleView:
        """The figures of a cycle, and whether it can be judged."""
        before, self._before = self._before, cycle
        whole = cycle.complete or len(cycle.samples) >= LONGEST_PIECE
        stale = silent or cycle.stale or (before is not None and before.stale)
        is_beside = self._is_beside_an_empty_pick(cycle)
        fit = (
            self.judges
            and whole
            and cycle.settled
            and cycle.coverage >= FEWEST_SHARE
            and not stale
            and not is_beside
        )
        *_, (_, theta) = self._surroundings.over(cycle.samples, cycle.ticks)
        theta = following(theta, cycle.samples)
        fit = not self._is_blind_to_the_nozzle(cycle, theta) and fit
        cycle_figures = figures(cycle, theta)
        if not self.judges:  # leave out figures that depend on the model
            cycle_figures = {
                name: value for name, value in cycle_figures.items() if name in MEASURED
            }
        return CycleView(cycle, before, cycle_figures, fit, theta)

    def _is_beside_an_empty_pick(self, cycle: Cycle) -> bool:
        """Whether a cycle alone met no part, or comes after one: the model has to settle then.

        If one of the two cycles before met none either, something is wrong, and each is judged.
        """
        if not cycle.complete:
            return False
        has_no_part, (second_last, last) = met_no_part(cycle, self.theta), self._without_part
        self._without_part = last, has_no_part
        if has_no_part:
            return not (last or second_last)
        return last and not second_last

    def _is_blind_to_the_nozzle(self, cycle: Cycle, theta: Theta) -> bool:
        """Whether a cycle alone has lost its switching.

        If one of the two cycles before had too, the nozzle may not switch at all: it is judged.
        """
        if not cycle.complete:
            return False
        has_lost, (second_last, last) = lost_a_switching(cycle, theta), self._without_switching
        self._without_switching = last, has_lost
        return has_lost and not (last or second_last)

    def _conclude(
        self, view: CycleView, key_figures: CycleKeyFigures | None, scores: "CycleScores | None"
    ) -> list[Event]:
        """Events of a cycle: its summary, and its alarm or clearing."""
        cycle, _, cycle_figures, judged, _ = view
        doubts = self.isolation.doubts(scores) if self.isolation and scores else {}
        worst, is_out = self._worst(cycle, cycle_figures, doubts) if judged else (None, False)
        far = abs(worst.sigmas) if worst else 0.0
        begins = is_out and self._begins(cycle, far)
        verdict = self._isolate(scores, far if is_out else 0.0, begins)
        events = (
            [_summary(cycle, cycle_figures, key_figures, verdict)]
            if cycle.complete or key_figures
            else []
        )
        if not judged or (worst is None and verdict is None):
            return events
        quiet, self._quiet_cycles = self._quiet_cycles, 0
        if worst and is_out:
            if begins:
                events.append(self._raise_unnamed(worst, cycle))
            elif not self._stands(cycle, worst, cycle_figures, verdict):
                self._diagnosed = cycle_figures
                events += self._deviation(worst, view, verdict)
        elif verdict and self._raises_or_names(verdict):
            events.append(self._raise_by_cycles(cycle, verdict))
        elif self.active and not self._is_far(worst) and not self._differs:
            self._quiet_cycles = quiet + 1
            if self._quiet_cycles >= self.settings.clear_cycles:
                events.append(self._clear(cycle))
        if not is_out:
            self._mixed_cycle = None
        self._farthest = max(self._farthest, far) if self.active else 0.0
        return events

    def _clear(self, cycle: Cycle) -> Event:
        """Clear the standing alarm."""
        name_text = f"it had looked like {self.active}"
        if self.active == UNKNOWN:
            name_text = "its cause was not named"
        text = f"measurement and model agree again; {name_text}"
        event = Event(cycle.end_ns, Kind.DEVIATION_CLEARED, text, {"effect": self.active})
        self.active, self._rival = "", ("", 0)
        return event

    def _begins(self, cycle: Cycle, far: float) -> bool:
        """Whether something new begins with a cycle that is ``far`` out (sigma).

        It does if no alarm stands, or if the cycle is much farther out than all since the alarm.
        The cycle after the first one does not count, as the first showed only a part of the change.
        """
        if not self.active:
            return True
        grew = far > GREW * max(self._farthest, LARGE)
        return grew and self._mixed_cycle is None and not cycle.cut_short

    def _raises_or_names(self, verdict: "Verdict") -> bool:
        """Whether the isolation raises an alarm, or names one that has no name."""
        if not self.active:
            return verdict.raised and bool(verdict.causes)
        return self.active == UNKNOWN and _has_name(verdict)

    @property
    def _is_commissioned(self) -> bool:
        """Whether the twin is fitted to the unit, so that deviations can name a cause."""
        return self.settings.healthy.is_known

    @property
    def _differs(self) -> bool:
        """Whether the isolation finds that cycles differ together."""
        return self.isolation is not None and self.isolation.stands

    def _isolate(self, scores: "CycleScores | None", far: float, begins: bool) -> "Verdict | None":
        """The isolation's verdict; it learns no cycle that is far out."""
        if self.isolation is None or scores is None:
            return None
        verdict = self.isolation.judge(scores, far, begins=begins)
        return verdict if self._is_commissioned or verdict is None else verdict.unnamed()

    def _worst(
        self, cycle: Cycle, cycle_figures: Mapping[str, float], doubts: Mapping[str, float]
    ) -> tuple[Outlier | None, bool]:
        """The figure that is farthest from healthy, and whether it alone is an alarm.

        ``doubts`` (mbar) by figure are what its day may have done. The limit is lower while an
        alarm without a name stands.
        """
        self._cycles, self._seconds = self._cycles + 1, self._seconds + cycle.seconds
        normal = self._baseline.normal(cycle_figures, self.settings.smallest_mbar, doubts)
        excess = self._baseline.excess(cycle_figures)
        sigmas = excess / self._baseline.sigma
        columns = zip(self._baseline.names, excess, sigmas, normal, strict=True)
        outliers = [
            Outlier(name, *map(float, numbers))
            for name, *numbers in columns
            if name in cycle_figures
        ]
        if not outliers:
            return None, False
        seconds = max(self._seconds / self._cycles, SHORTEST_S)
        limit = self._baseline.limit(self.settings.false_alarm_days, seconds, len(outliers))
        worst = max(outliers, key=lambda outlier: _ranking_key(outlier, limit))
        if not self.active:
            self._baseline.learn(cycle_figures, normal)
        return worst, abs(worst.normal) >= (CLEARS if self.active == UNKNOWN else limit)

    def _is_far(self, worst: Outlier | None) -> bool:
        """Whether one figure of a cycle prevents the clearing of an alarm."""
        return worst is not None and abs(worst.normal) >= CLEARS

    def _raise_by_cycles(self, cycle: Cycle, verdict: "Verdict") -> Event:
        """Raise the alarm for a change that no single cycle shows, or name the standing one."""
        self.active, self._diagnosed = verdict.causes[0].effect, {}
        observation = f"{verdict.since} cycles: {abs(verdict.sigmas):.1f} sigma off in each"
        measured: dict[str, float | int | str] = {"figure": "cycles", "cycles": verdict.since}
        measured["sigma"] = verdict.sigmas
        return self._raised(cycle, observation, measured, verdict.causes)

    def _raise_unnamed(self, worst: Outlier, cycle: Cycle) -> Event:
        """Raise the alarm with the first cycle that shows it.

        It has no name, as the time in the cycle at which it began is unknown.
        """
        self.active, self._mixed_cycle, self._diagnosed = UNKNOWN, cycle.index, {}
        observation = (
            f"something has changed, most in {worst.phase}:"
            f" {worst.excess:+.1f} mbar from healthy ({worst.sigmas:+.0f} sigma)"
        )
        return self._raised(cycle, observation, worst.plain(), [Likeness(UNKNOWN, None, "", 1.0)])

    def _stands(
        self,
        cycle: Cycle,
        worst: Outlier,
        cycle_figures: Mapping[str, float],
        verdict: "Verdict | None",
    ) -> bool:
        """Whether the standing alarm holds for a cycle without a new search for its cause.

        It holds for a cycle that was cut short, and for one with figures like those of the last
        search: the result would be the same, and a search takes long. The isolation's verdict costs
        nothing, so it is used first. A cycle that differs in another way may show only a part of
        the change: the cause is searched in the next one.
        """
        if cycle.cut_short or cycle.index == self._mixed_cycle:
            return True
        if self._small_causes(verdict) or self._rival[1]:
            return False
        if cycle_figures.keys() == self._diagnosed.keys():
            names = [name for name in self.settings.healthy.figures if name in cycle_figures]
            moved = max(abs(cycle_figures[name] - self._diagnosed[name]) for name in names)
            if moved < ALIKE * abs(worst.excess):
                self._mixed_cycle = None
                return True
        if self._mixed_cycle is not None:
            return False
        self._mixed_cycle = cycle.index
        return True

    def _deviation(self, worst: Outlier, view: CycleView, verdict: "Verdict | None") -> list[Event]:
        """Name the alarm, or rename it if another cause than the standing one fits."""
        if not self._is_commissioned:
            return []
        ranking = self._rank_causes(worst, view, verdict)
        self._mixed_cycle = None
        if not ranking:
            self._rival = ("", 0)
            return []
        if not self._is_renamed(ranking):
            return []
        self.active = ranking[0].effect
        observation = (
            f"{worst.place}: {worst.excess:+.1f} mbar from healthy ({worst.sigmas:+.0f} sigma)"
        )
        return [self._raised(view.cycle, observation, worst.plain(), ranking)]

    def _small_causes(self, verdict: "Verdict | None") -> Sequence[Likeness]:
        """Causes by the isolation, if the first one is small enough for signatures, and suits.

        Empty if the alarm has another name: signatures do not hold for large causes.
        """
        if not verdict or not verdict.causes or not verdict.causes[0].is_small:
            return ()
        causes = verdict.where_changed().causes
        suits = causes[-1].share < UNSUITED
        return causes if suits and self.active in (UNKNOWN, causes[0].effect) else ()

    def _is_renamed(self, ranking: Sequence[Likeness]) -> bool:
        """Whether the best of a ranking becomes the alarm's name.

        The first name does at once. Another name needs ``RENAMED`` cycles in a row in which the
        standing name is improbable, so that a single odd cycle changes nothing.
        """
        best = ranking[0]
        standing = max(
            (likeness.share for likeness in ranking if likeness.effect == self.active), default=0.0
        )
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
        observation: str,
        measured: Mapping[str, float | int | str],
        causes: Sequence[Likeness],
    ) -> Event:
        """The alarm: the observation, and the causes that fit, the most probable first."""
        best, *rivals = causes
        rival_names = [
            rival.effect for rival in rivals if rival.effect != UNKNOWN and rival.share >= RIVAL
        ]
        cause_text = best.words if self._is_commissioned else NOT_COMMISSIONED
        text = "; ".join([observation, cause_text]) + "".join(
            f", or {', '.join(rival_names)}" for _ in rival_names[:1]
        )
        data = {"cycle": cycle.index, **measured, **best.plain(), "also": ",".join(rival_names)}
        if not self._is_commissioned:
            data["commissioned"] = False
        return Event(cycle.end_ns, Kind.DEVIATION, text, data)

    def _rank_causes(
        self, worst: Outlier, view: CycleView, verdict: "Verdict | None"
    ) -> Sequence[Likeness]:
        """Rank the causes of a cycle's deviation; the model settles in the cycle before.

        Empty if nothing in the table fits.
        """
        from twin.monitor.naming import likenesses  # noqa: PLC0415 - with SciPy

        if small := self._small_causes(verdict):
            return small
        if worst.figure.endswith("_level"):  # only the thresholds moved
            if verdict is not None and _has_name(verdict):
                return verdict.where_changed().causes
            drift, shift = standing_for(c.H1)
            size = shift.reported(worst.excess, self.theta)
            return [
                Likeness(drift.name, size, shift.unit, LEVELS_ALONE),
                Likeness(UNKNOWN, None, "", 1.0 - LEVELS_ALONE),
            ]
        cycle, before, *_, theta = view
        parts = [cycle] if before is None else [before, cycle]
        samples = np.concatenate([part.samples for part in parts])
        ticks = np.concatenate([part.ticks for part in parts])
        begin = len(samples) - len(cycle.samples)
        known_effects = self.isolation.known if self.isolation else ()
        return likenesses(theta, self.settings.healthy, samples, ticks, begin, known_effects)


def _ranking_key(outlier: Outlier, limit: float) -> tuple[bool, float]:
    """Rank of an outlier: levels count a third, as sensors move them too, and the course more."""
    far = abs(outlier.sigmas)
    level = outlier.figure.endswith("_level")
    return abs(outlier.normal) >= limit, far / 3.0 if level else far


def _has_name(verdict: "Verdict | None") -> bool:
    """Whether the isolation names a cause."""
    return bool(verdict and verdict.causes and verdict.causes[0].effect != UNKNOWN)


def in_order(events: Iterable[Event]) -> list[Event]:
    """Events of one PLC time in order of time; the sort is stable."""
    return sorted(events, key=lambda event: event.time_ns)


def _silence_ns(last_fresh: np.void, row: np.void) -> int:
    """Time (ns) between the receipts of two rows.

    If the wall clock was set between them, that differs from the PLC time between them by more than
    a ring can explain. Then the PLC time counts.
    """
    by_receipt, by_plc = (int(row[name]) - int(last_fresh[name]) for name in ("host_ns", "time_ns"))
    was_set = not 0 <= by_receipt - by_plc <= LONGEST_RING_NS
    runs_on = not row["quality"] & NEW_TIME
    return by_plc if was_set and runs_on else by_receipt


def _summary(
    cycle: Cycle,
    cycle_figures: Mapping[str, float],
    key_figures: CycleKeyFigures | None,
    verdict: "Verdict | None",
) -> Event:
    """The event of a cycle, with the text of the key figures if there are any."""
    data: dict[str, Any] = {"cycle": cycle.index}
    data |= {name: round(value, 3) for name, value in cycle_figures.items()}
    if verdict is not None:
        data["probabilities"] = verdict.plain()
    if key_figures is not None:
        if not cycle.complete:  # figures of a piece are not those of the cycle
            data = {}
        data = {name: value for name, value in data.items() if not name.startswith("t0_")}
        return Event(key_figures.end_ns, Kind.CYCLE, key_figures.words, data | key_figures.plain())
    text = f"cycle {cycle.index}"
    if "t0_measured" in cycle_figures:
        text += f": evacuated to H2 in {cycle_figures['t0_measured']:.0f} ms"
        if "t0_expected" in cycle_figures:
            text += f" (expected {cycle_figures['t0_expected']:.0f} ms)"
    return Event(cycle.end_ns, Kind.CYCLE, text, data)
