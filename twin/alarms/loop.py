"""Alarms beside the loop (``twin.live.EventEnricher``): events in, changes of alarms out as events.

Alarms use the time at which rows were received, because it goes on through a restart of the PLC. A
replay reads it from the log.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from twin.alarms.board import Board, Diary, Episode, merge_evidence
from twin.alarms.causes import CAUSES, UNLISTED, catalogue_evidence, cause_or_unlisted, value_of
from twin.alarms.requests import LimitChange, Request, grant
from twin.alarms.rules import Rule
from twin.alarms.state import Alarm, AlarmAction, Change, Kept
from twin.alarms.text import SUPPRESSIONS, event_of, is_reportable, plain
from twin.alarms.watch import STREAM, deviating, evidence, values
from twin.errors import TwinError
from twin.events import Event, Kind
from twin.model.effects import UNKNOWN
from twin.quality import Quality
from twin.signals import Samples

# After so many complete cycles without a deviation, one that stood before a restart is over. The
# first cycles may not have been judged.
AGREEING = 5
SET_NS = 5_000_000_000  # smaller clock steps are ignored: they change a delay by no more than this


@dataclass(frozen=True)
class Before:
    """The alarms at the end of an earlier run."""

    states: Mapping[str, Kept] = field(default_factory=dict)
    going_on: Sequence[Episode] = ()


@dataclass
class News:
    """Changes to store in the database."""

    states: dict[str, Kept] = field(default_factory=dict)
    episodes: dict[tuple[int, str], Episode] = field(default_factory=dict)
    answers: dict[int, str] = field(default_factory=dict)  # to requests; empty: done
    limits: dict[int, LimitChange] = field(default_factory=dict)  # applied or refused, by ID

    def __bool__(self) -> bool:
        return bool(self.states or self.episodes or self.answers or self.limits)

    def add(self, later: "News") -> None:
        """Merge later changes."""
        self.states |= later.states
        self.episodes |= later.episodes
        self.answers |= later.answers
        self.limits |= later.limits


class AlarmStorage(Protocol):
    """Stores changes and delivers people's requests. The loop never waits for it."""

    def take(self, news: News) -> None:
        """Store changes."""

    def asked(self) -> list[Request]:
        """People's requests since the last call."""

    def limit_changes(self) -> list[LimitChange]:
        """Changes of limits since the last call, first those of all earlier runs."""

    def close(self) -> None:
        """Finish; it is the last call."""


class Alarms:
    """The alarms of one ejector.

    ``clock`` (ns) is read only while no rows arrive; without it, as for a log, time then stands
    still. ``steady`` (ns) is monotonic: with it, setting the clock changes no delay.
    """

    def __init__(
        self,
        rules: Sequence[Rule],
        clock: Callable[[], int] | None,
        before: Before | None = None,
        storage: AlarmStorage | None = None,
        steady: Callable[[], int] | None = None,
    ) -> None:
        before = before or Before()
        self.board = Board(rules)
        self.board.resume(before.states)
        self._stored_names = [name for name in before.states if name in self.board.alarms]
        self._diary = Diary(before.going_on)
        self._clock, self.storage, self._steady = clock, storage, steady
        self._clock_offset: int | None = None  # host clock less the monotonic one, in ns
        self._evidence: dict[str, dict[str, Any]] = {  # by value
            self.board[episode.alarm].rule.value: dict(episode.evidence)
            for episode in before.going_on
            if episode.alarm in self.board.alarms
        }
        self._deviation_cause = ""  # the cause of the deviation that was raised last
        self._deviation_ns = -1  # when that was, in PLC time
        self._cycles_to_agree = AGREEING if self._deviating() else 0
        self._resumed = bool(self._cycles_to_agree)  # standing alarms have no new cause yet
        self._has_rows = False  # fresh rows of the PLC have arrived
        self._now = self._plc_ns = 0  # of the last row
        self._news = News()
        self._pending_events: list[Event] = []  # after a failure they are returned by the next call

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and events; returns the changes of alarms as events."""
        now = self._time(samples)
        self._follow_clock()
        if any(event.kind is Kind.DEVIATION for event in events):
            self._cycles_to_agree = 0  # its cycle came before, and does not count as agreeing
        self._pending_events += self._first_rows(samples, events, now)
        for event in events:
            self._pending_events += self._take(event, _received(samples, event.time_ns, now))
        self._pending_events += self._events_of(self.board.see(now, {}), self._plc_ns)
        for request in self.storage.asked() if self.storage else ():
            self._pending_events += self._grant(request, now)
        self._hand_over()
        events_out, self._pending_events = self._pending_events, []
        return events_out

    def standing(self) -> list[dict[str, Any]]:
        """All alarms that have ever left the normal state, as they are when a run begins."""
        alarms = []
        for name in self._stored_names:
            alarm = self.board[name]
            evidence = self._evidence.get(alarm.rule.value, {}) if alarm.concerns else {}
            alarms.append(plain(alarm, evidence, self._diary.newest(name)))
        return alarms

    def finish(self) -> list[Event]:
        """Return no events: none are held back."""
        return []

    def close(self) -> None:
        """Close the database."""
        if self.storage is not None:
            self.storage.close()

    def _follow_clock(self) -> None:
        """Shift pending delays when the host's clock was set, so that they keep their length."""
        if self._steady is None or self._clock is None:
            return
        previous, self._clock_offset = self._clock_offset, self._clock() - self._steady()
        if previous is not None and abs(self._clock_offset - previous) > SET_NS:
            for alarm in self.board.alarms.values():
                alarm.shift(self._clock_offset - previous)

    def _time(self, samples: Samples) -> int:
        """The present time in ns, by the host's clock."""
        if not len(samples):
            return self._clock() if self._clock else self._now
        self._now, self._plc_ns = (int(samples[name][-1]) for name in ("host_ns", "time_ns"))
        return self._now

    # --- events ---------------------------------------------------------------------------------

    def _first_rows(self, samples: Samples, events: Sequence[Event], now: int) -> list[Event]:
        """With the first fresh rows, faults of the stream from before a restart are over."""
        if self._has_rows or not len(samples) or (samples["quality"] & Quality.STALE).all():
            return []
        self._has_rows = True
        changed = {name for event in events for name in values(event)}
        return self._events_of(
            self.board.see(now, dict.fromkeys(STREAM - changed, 0.0)), self._plc_ns
        )

    def _take(self, event: Event, now: int) -> list[Event]:
        if event.kind is Kind.DIAGNOSIS:
            return self._diagnosed(event, now)
        if event.kind is Kind.DEVIATION:
            return self._deviates(event, now)
        changed = values(event)
        if event.kind is Kind.CYCLE and self._agrees(event):
            changed |= deviating()
        for value, entry in evidence(event).items():
            self._note(value, entry)
        if event.kind is Kind.CYCLE and "cycle" in event.data:
            for cause in self._deviating():
                self._note(value_of(cause), {"last_cycle": int(event.data["cycle"])})
        return self._events_of(self.board.see(now, changed), event.time_ns)

    def _deviates(self, event: Event, now: int) -> list[Event]:
        """Raise the alarm of the cause; an alarm of an unknown cause is renamed to it.

        A deviation that begins beside a standing cause is unknown at first, and leaves that alarm
        unchanged.
        """
        self._deviation_cause, self._deviation_ns = self._cause_of(event), event.time_ns
        standing = self._deviating()
        (entry,) = evidence(event).values()
        changes: list[Change] = []
        causes = {self._deviation_cause}
        if self._deviation_cause == UNKNOWN:
            causes |= set(standing)
        elif UNKNOWN in standing or self._is_coming(value_of(UNKNOWN)):
            entry = merge_evidence(self._evidence.get(value_of(UNKNOWN), {}), entry)
            changes = self.board.rename(now, value_of(UNKNOWN), value_of(self._deviation_cause))
        self._note(value_of(self._deviation_cause), entry)
        events = self._events_of(changes, event.time_ns)
        return events + self._events_of(self.board.see(now, deviating(*causes)), event.time_ns)

    def _agrees(self, event: Event) -> bool:
        """Whether this cycle completes the ``AGREEING`` cycles since the restart."""
        if not self._cycles_to_agree or not event.data.get("complete", True):
            return False
        self._cycles_to_agree -= 1
        return self._cycles_to_agree == 0

    def _deviating(self) -> list[str]:
        """The causes whose alarms are active."""
        active = {alarm.rule.value for alarm in self.board.alarms.values() if alarm.active}
        return [cause for cause in CAUSES if value_of(cause) in active] if active else []

    def _cause_of(self, event: Event) -> str:
        """The cause of a deviation: a standing cause that it resembles, else its own."""
        own_cause = cause_or_unlisted(str(event.data.get("effect")))
        similar = {own_cause, *str(event.data.get("also", "")).split(",")}
        standing = self._deviating()
        self._resumed &= bool(standing) and own_cause == UNKNOWN
        if self._resumed:  # assume that the standing cause continues
            return standing[0]
        if own_cause in standing:
            return own_cause
        for cause in standing:
            if (
                cause in similar
                or self._evidence.get(value_of(cause), {}).get("guess") == own_cause
            ):
                return cause
        return own_cause

    def _diagnosed(self, event: Event, now: int) -> list[Event]:
        """Rename the deviation to the diagnosed cause, and raise the alarms of further causes."""
        answer = event.data.get("answer") or {}
        if event.data.get("alarm_ns") != self._deviation_ns:
            return []
        if answer.get("verdict") not in ("explained", "unlisted"):
            return []
        causes = {
            cause_or_unlisted(details["effect"]): details for details in answer["causes"]
        } or {UNLISTED: {}}
        former = self._deviation_cause
        main_cause = former if former in causes else next(iter(causes))
        for cause, details in causes.items():
            entry = _cause_evidence(details, answer) | {"words": event.text}
            entry |= {"report": event.data["report"]} if "report" in event.data else {}
            if cause == main_cause:
                entry = merge_evidence(self._evidence.get(value_of(former), {}), entry)
            self._note(value_of(cause), entry)
        events = []
        if main_cause != former:
            changes = self.board.rename(now, value_of(former), value_of(main_cause))
            events = self._events_of(changes, event.time_ns)
        is_active = any(alarm.active for alarm in self.board.watching(value_of(main_cause)))
        self._deviation_cause = main_cause
        changes = self.board.see(now, deviating(*causes) if is_active else {})
        return events + self._events_of(changes, event.time_ns)

    # --- changes --------------------------------------------------------------------------------

    def _grant(self, request: Request, now: int) -> list[Event]:
        try:
            changes = grant(self.board, request, now)
        except TwinError as error:
            self._news.answers[request.id] = str(error)
            return []
        self._news.answers[request.id] = ""
        return self._events_of(changes, self._plc_ns)

    def _note(self, value: str, entry: Mapping[str, Any]) -> None:
        """Store evidence for a value's alarms, and write it into their episodes."""
        if not any(alarm.active for alarm in self.board.watching(value)):
            pending = self._evidence.get(value, {}) if self._is_coming(value) else {}
            self._evidence[value] = merge_evidence(pending, entry)
            return
        self._evidence[value] = merge_evidence(self._evidence.get(value, {}), entry)
        for alarm in self.board.watching(value):
            self._record(self._diary.note(alarm.rule.name, entry))

    def _is_coming(self, value: str) -> bool:
        """Whether an alarm of the value waits for its delay."""
        return any(alarm.is_coming for alarm in self.board.watching(value))

    def _events_of(self, changes: Iterable[Change], time_ns: int) -> list[Event]:
        events = []
        for change in changes:
            episodes = self._diary.take(change)
            self._record(episodes)
            alarm = self.board[change.to or change.alarm]
            entry = self._evidence.get(alarm.rule.value, {})
            if change.action is AlarmAction.RAISED:
                self._record(self._diary.note(change.alarm, entry))
            elif change.action is AlarmAction.RENAMED:
                self._record(self._diary.note(change.to, entry))
                self._store_state(self.board[change.alarm])
            if change.action not in SUPPRESSIONS:  # suppression follows from the other states
                self._store_state(alarm)
            if is_reportable(change, alarm):
                events.append(event_of(change, self._plain(change, episodes), alarm, time_ns))
        return events

    def _plain(self, change: Change, episodes: Sequence[Episode]) -> dict[str, Any]:
        """The state of the changed alarm; after a rename also that of the old one."""
        alarm = self.board[change.to or change.alarm]
        newest = episodes[-1] if episodes else self._diary.newest(alarm.rule.name)
        state = plain(alarm, self._evidence.get(alarm.rule.value, {}), newest)
        if change.action is AlarmAction.RENAMED:
            state["left"] = plain(self.board[change.alarm], {}, None)
        return state

    def _record(self, episodes: Iterable[Episode]) -> None:
        self._news.episodes |= {
            (episode.raised_ns, episode.raised_as): episode for episode in episodes
        }

    def _store_state(self, alarm: Alarm) -> None:
        self._news.states[alarm.rule.name] = alarm.keep()

    def _hand_over(self) -> None:
        if self.storage is not None and self._news:
            self.storage.take(self._news)
        self._news = News()


def _received(samples: Samples, time_ns: int, else_ns: int) -> int:
    """Receipt time (ns) of the row at a PLC time; ``else_ns`` for a time after all rows."""
    row = bisect_left(samples["time_ns"], time_ns)  # NumPy would copy the column
    return int(samples["host_ns"][row]) if row < len(samples) else else_ns


def _cause_evidence(cause: Mapping[str, Any], answer: Mapping[str, Any]) -> dict[str, Any]:
    """The evidence that a diagnosis gives for one cause, with its cost and when it acts."""
    keys = ["effect", "course", "parameters", "probability", "not_separable_from", "cost"]
    keys += ["onset_s", "onset_low95_s", "onset_high95_s", "cycles", "share_pct"]
    entry = {key: cause[key] for key in keys if key in cause}
    log = answer.get("cycles", {})
    entry |= {key: log[key] for key in ("begin_s", "log_begin_ns") if cause and key in log}
    return entry | catalogue_evidence(cause.get("effect", ""))
