"""Alarms beside the loop (``twin.live.EventEnricher``): events in, changes of alarms out as events.

Alarms live in the time in which rows were received, which goes on through a restart of the PLC; a
replay has it in its log.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from twin.alarms.board import Board, Diary, Episode, joined
from twin.alarms.causes import CAUSES, UNLISTED, catalogue_words, known, value_of
from twin.alarms.requests import Request, grant
from twin.alarms.rules import Rule
from twin.alarms.state import Alarm, Change, Deed, Kept
from twin.alarms.text import SUPPRESSIONS, event_of, plain, worth_saying
from twin.alarms.watch import STREAM, deviating, evidence, values
from twin.errors import TwinError
from twin.events import Event, Kind
from twin.model.effects import UNKNOWN
from twin.signals import Quality, Samples

# Whole cycles without a deviation: then one that stood before a restart is over. The first ones
# may not have been judged.
AGREEING = 5
SET_NS = 5_000_000_000  # a clock that is set by less shortens or lengthens a delay by no more


@dataclass(frozen=True)
class Before:
    """What was when another run ended."""

    states: Mapping[str, Kept] = field(default_factory=dict)
    going_on: Sequence[Episode] = ()


@dataclass
class News:
    """What has changed, for the database."""

    states: dict[str, Kept] = field(default_factory=dict)
    episodes: dict[tuple[int, str], Episode] = field(default_factory=dict)
    answers: dict[int, str] = field(default_factory=dict)  # to requests; empty: done

    def __bool__(self) -> bool:
        return bool(self.states or self.episodes or self.answers)

    def add(self, later: "News") -> None:
        """Take what is newer."""
        self.states |= later.states
        self.episodes |= later.episodes
        self.answers |= later.answers


class Office(Protocol):
    """Who keeps what changes, and brings what people ask for; never waited for."""

    def take(self, news: News) -> None:
        """Keep it."""

    def asked(self) -> list[Request]:
        """What people have asked for since the last time."""

    def close(self) -> None:
        """Finish; nothing comes after it."""


class Alarms:
    """The alarms of one ejector.

    ``clock`` (ns) is asked only while nothing arrives; without one, as for a log, time stands then.
    ``steady`` (ns) runs on evenly: by it a clock that is set shortens no delay.
    """

    def __init__(
        self,
        rules: Sequence[Rule],
        clock: Callable[[], int] | None,
        before: Before | None = None,
        office: Office | None = None,
        steady: Callable[[], int] | None = None,
    ) -> None:
        before = before or Before()
        self.board = Board(rules)
        self.board.resume(before.states)
        self._before = [name for name in before.states if name in self.board.alarms]
        self._diary = Diary(before.going_on)
        self._clock, self._office, self._steady = clock, office, steady
        self._apart: int | None = None  # the clock here less the steady one
        self._evidence: dict[str, dict[str, Any]] = {  # by value
            self.board[one.alarm].rule.value: dict(one.evidence)
            for one in before.going_on
            if one.alarm in self.board.alarms
        }
        self._named = ""  # the cause of the deviation that was raised last
        self._deviation_ns = -1  # when that was, in PLC time
        self._to_agree = AGREEING if self._deviating() else 0
        self._resumed = bool(self._to_agree)  # nothing is named yet that stood when it began
        self._heard = False  # anything of the PLC
        self._now = self._plc_ns = 0  # of the last row
        self._news = News()
        self._said: list[Event] = []  # by now; where something fails, it is said the next time

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and what happened; give what that changes."""
        now = self._time(samples)
        self._follow_clock()
        if any(event.kind is Kind.DEVIATION for event in events):
            self._to_agree = 0  # it comes after its cycle, which does not agree
        self._said += self._hear(samples, events, now)
        for event in events:
            self._said += self._take(event, _received(samples, event.time_ns, now))
        self._said += self._say(self.board.see(now, {}), self._plc_ns)
        for request in self._office.asked() if self._office else ():
            self._said += self._grant(request, now)
        self._hand_over()
        said, self._said = self._said, []
        return said

    def standing(self) -> list[dict[str, Any]]:
        """All alarms that were ever anything else than normal, as they are when a run begins."""
        found = []
        for name in self._before:
            alarm = self.board[name]
            evidence = self._evidence.get(alarm.rule.value, {}) if alarm.concerns else {}
            found.append(plain(alarm, evidence, self._diary.newest(name)))
        return found

    def finish(self) -> list[Event]:
        """Nothing is left to be said."""
        return []

    def close(self) -> None:
        """Let go of the database."""
        if self._office is not None:
            self._office.close()

    def _follow_clock(self) -> None:
        """Leave delays as long as they are where the clock here was set."""
        if self._steady is None or self._clock is None:
            return
        before, self._apart = self._apart, self._clock() - self._steady()
        if before is not None and abs(self._apart - before) > SET_NS:
            for alarm in self.board.alarms.values():
                alarm.shift(self._apart - before)

    def _time(self, samples: Samples) -> int:
        """When that is, by the clock here."""
        if not len(samples):
            return self._clock() if self._clock else self._now
        self._now, self._plc_ns = (int(samples[name][-1]) for name in ("host_ns", "time_ns"))
        return self._now

    # --- what happened --------------------------------------------------------------------------

    def _hear(self, samples: Samples, events: Sequence[Event], now: int) -> list[Event]:
        """The first fresh rows: what was wrong with the stream before a restart is over."""
        if self._heard or not len(samples) or (samples["quality"] & Quality.STALE).all():
            return []
        self._heard = True
        told = {name for event in events for name in values(event)}
        return self._say(self.board.see(now, dict.fromkeys(STREAM - told, 0.0)), self._plc_ns)

    def _take(self, event: Event, now: int) -> list[Event]:
        if event.kind is Kind.DIAGNOSIS:
            return self._diagnosed(event, now)
        if event.kind is Kind.DEVIATION:
            return self._deviates(event, now)
        changed = values(event)
        if event.kind is Kind.CYCLE and self._agrees(event):
            changed |= deviating()
        for value, found in evidence(event).items():
            self._note(value, found)
        if event.kind is Kind.CYCLE and "cycle" in event.data:
            for cause in self._deviating():
                self._note(value_of(cause), {"last_cycle": int(event.data["cycle"])})
        return self._say(self.board.see(now, changed), event.time_ns)

    def _deviates(self, event: Event, now: int) -> list[Event]:
        """Raise the alarm of the cause; one that had no name yet gets it.

        What begins beside a cause that stands has no name at first, and leaves that one alone.
        """
        self._named, self._deviation_ns = self._standing(event), event.time_ns
        standing = self._deviating()
        (found,) = evidence(event).values()
        changes: list[Change] = []
        causes = {self._named}
        if self._named == UNKNOWN:
            causes |= set(standing)
        elif UNKNOWN in standing or self._is_coming(value_of(UNKNOWN)):
            found = joined(self._evidence.get(value_of(UNKNOWN), {}), found)
            changes = self.board.rename(now, value_of(UNKNOWN), value_of(self._named))
        self._note(value_of(self._named), found)
        said = self._say(changes, event.time_ns)
        return said + self._say(self.board.see(now, deviating(*causes)), event.time_ns)

    def _agrees(self, event: Event) -> bool:
        """Whether with this cycle there are enough since the restart that did not deviate."""
        if not self._to_agree or not event.data.get("complete", True):
            return False
        self._to_agree -= 1
        return self._to_agree == 0

    def _deviating(self) -> list[str]:
        """The causes whose alarms are active."""
        active = {alarm.rule.value for alarm in self.board.alarms.values() if alarm.active}
        return [cause for cause in CAUSES if value_of(cause) in active] if active else []

    def _standing(self, event: Event) -> str:
        """The cause of a deviation: one that stands already, if this looks like it, or its own."""
        cause = known(str(event.data.get("effect")))
        alike = {cause, *str(event.data.get("also", "")).split(",")}
        standing = self._deviating()
        self._resumed &= bool(standing) and cause == UNKNOWN
        if self._resumed:  # it is what stood already, as far as anybody knows
            return standing[0]
        if cause in standing:
            return cause
        for one in standing:
            if one in alike or self._evidence.get(value_of(one), {}).get("guess") == cause:
                return one
        return cause

    def _diagnosed(self, event: Event, now: int) -> list[Event]:
        """Give the deviation the name of the cause that was found, and others their own alarm."""
        answer = event.data.get("answer") or {}
        if event.data.get("alarm_ns") != self._deviation_ns:
            return []
        if answer.get("verdict") not in ("explained", "unlisted"):
            return []
        causes = {known(one["effect"]): one for one in answer["causes"]} or {UNLISTED: {}}
        before = self._named
        found = before if before in causes else next(iter(causes))
        for cause, one in causes.items():
            told = _sizes(one) | {"words": event.text}
            told |= {"report": event.data["report"]} if "report" in event.data else {}
            if cause == found:
                told = self._evidence.get(value_of(before), {}) | told
            self._note(value_of(cause), told)
        said = []
        if found != before:
            changes = self.board.rename(now, value_of(before), value_of(found))
            said = self._say(changes, event.time_ns)
        still = any(alarm.active for alarm in self.board.watching(value_of(found)))
        self._named = found
        changes = self.board.see(now, deviating(*causes) if still else {})
        return said + self._say(changes, event.time_ns)

    # --- what follows ---------------------------------------------------------------------------

    def _grant(self, request: Request, now: int) -> list[Event]:
        try:
            changes = grant(self.board, request, now)
        except TwinError as error:
            self._news.answers[request.id] = str(error)
            return []
        self._news.answers[request.id] = ""
        return self._say(changes, self._plc_ns)

    def _note(self, value: str, told: Mapping[str, Any]) -> None:
        """Keep what speaks for alarms, and write it into their episodes."""
        if not any(alarm.active for alarm in self.board.watching(value)):
            fresh = self._evidence.get(value, {}) if self._is_coming(value) else {}
            self._evidence[value] = joined(fresh, told)
            return
        self._evidence[value] = joined(self._evidence.get(value, {}), told)
        for alarm in self.board.watching(value):
            self._record(self._diary.note(alarm.rule.name, told))

    def _is_coming(self, value: str) -> bool:
        """Whether an alarm waits for its delay."""
        return any(alarm.is_coming for alarm in self.board.watching(value))

    def _say(self, changes: Iterable[Change], time_ns: int) -> list[Event]:
        said = []
        for change in changes:
            episodes = self._diary.take(change)
            self._record(episodes)
            alarm = self.board[change.to or change.alarm]
            told = self._evidence.get(alarm.rule.value, {})
            if change.deed is Deed.RAISED:
                self._record(self._diary.note(change.alarm, told))
            elif change.deed is Deed.RENAMED:
                self._record(self._diary.note(change.to, told))
                self._keep(self.board[change.alarm])
            if change.deed not in SUPPRESSIONS:  # that follows from the others
                self._keep(alarm)
            if worth_saying(change, alarm):
                said.append(event_of(change, self._plain(change, episodes), alarm, time_ns))
        return said

    def _plain(self, change: Change, episodes: Sequence[Episode]) -> dict[str, Any]:
        """The alarm that changed as it is, and the one that has become it."""
        alarm = self.board[change.to or change.alarm]
        newest = episodes[-1] if episodes else self._diary.newest(alarm.rule.name)
        now = plain(alarm, self._evidence.get(alarm.rule.value, {}), newest)
        if change.deed is Deed.RENAMED:
            now["left"] = plain(self.board[change.alarm], {}, None)
        return now

    def _record(self, episodes: Iterable[Episode]) -> None:
        self._news.episodes |= {(one.raised_ns, one.raised_as): one for one in episodes}

    def _keep(self, alarm: Alarm) -> None:
        self._news.states[alarm.rule.name] = alarm.keep()

    def _hand_over(self) -> None:
        if self._office is not None and self._news:
            self._office.take(self._news)
        self._news = News()


def _received(samples: Samples, time_ns: int, else_ns: int) -> int:
    """When the row of a PLC time was received; what lies outside of the rows, now."""
    row = bisect_left(samples["time_ns"], time_ns)  # NumPy would copy the column
    return int(samples["host_ns"][row]) if row < len(samples) else else_ns


def _sizes(cause: Mapping[str, Any]) -> dict[str, Any]:
    """What a diagnosis says of one cause."""
    wanted = ("effect", "course", "parameters", "probability", "not_separable_from")
    return {key: cause[key] for key in wanted if key in cause} | catalogue_words(
        cause.get("effect", "")
    )
