"""All alarms of one ejector: takes values, returns changes; and builds episodes from changes."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from twin.alarms.rules import Priority, Rule
from twin.alarms.state import SECOND_NS, Alarm, AlarmAction, Change, Kept, State
from twin.errors import ConfigError

# Who "acknowledged" an alarm that nobody was told of; without a time while it may still be told.
SUPPRESSION = "suppression"
_ORDER = tuple(reversed(Priority))  # the most urgent first


class Board:
    """The alarms of one ejector, one for each rule."""

    def __init__(self, rules: Sequence[Rule]) -> None:
        self.alarms = {rule.name: Alarm(rule) for rule in rules}
        self._suppressible = [alarm for alarm in self.alarms.values() if alarm.rule.suppressed_by]
        self._suppressing = {
            name for alarm in self._suppressible for name in alarm.rule.suppressed_by
        }

    def see(self, now: int, values: Mapping[str, float]) -> list[Change]:
        """Take new values by name; for alarms without a new value only time passes."""
        changes: list[Change] = []
        for alarm in self.alarms.values():
            if alarm.rule.value in values or not alarm.rests:
                changes += alarm.see(now, values.get(alarm.rule.value, math.nan))
        suppressions = list(self._apply_suppression(now))
        suppressed = {
            change.alarm for change in suppressions if change.action is AlarmAction.SUPPRESSED
        }
        # An alarm suppresses another one even when both are raised at the same moment.
        changes = [
            replace(change, announced=False) if change.alarm in suppressed else change
            for change in changes
        ]
        return [*changes, *suppressions]

    def resume(self, states: Mapping[str, Kept]) -> None:
        """Restore the states of an earlier run; alarms without a rule are ignored."""
        for name, stored in states.items():
            if name in self.alarms:
                self.alarms[name].resume(stored)

    def watching(self, value: str) -> list[Alarm]:
        """The alarms that watch a value, in the order of the rules."""
        return [alarm for alarm in self.alarms.values() if alarm.rule.value == value]

    def rename(self, now: int, value: str, new_value: str) -> list[Change]:
        """Move the alarms of a value to another one, since the deviation has another cause."""
        changes: list[Change] = []
        for old, new in zip(self.watching(value), self.watching(new_value), strict=True):
            changes += old.become(now, new)
        return [*changes, *self._apply_suppression(now)]

    def __getitem__(self, name: str) -> Alarm:
        if name not in self.alarms:
            raise ConfigError(f"no alarm is called {name}", f"there are: {', '.join(self.alarms)}")
        return self.alarms[name]

    def standing(self) -> list[Alarm]:
        """Alarms for a person to handle: the most urgent first, unacknowledged before others."""
        standing = [
            alarm
            for alarm in self.alarms.values()
            if alarm.state in (State.UNACKNOWLEDGED, State.ACKNOWLEDGED, State.RETURNED)
        ]
        return sorted(
            standing, key=lambda alarm: (_ORDER.index(alarm.rule.priority), alarm.acknowledged)
        )

    def quiet(self) -> list[Alarm]:
        """Alarms that are shelved or out of service, or suppressed although they concern people."""
        return [
            alarm
            for alarm in self.alarms.values()
            if alarm.state in (State.SHELVED, State.OUT_OF_SERVICE)
            or (alarm.state is State.SUPPRESSED and alarm.concerns)
        ]

    def _apply_suppression(self, now: int) -> Iterator[Change]:
        """Suppress alarms by design while another alarm is active, and end that afterwards."""
        active = {name for name in self._suppressing if self.alarms[name].active}
        for alarm in self._suppressible:
            yield from alarm.suppress(now, bool(active & set(alarm.rule.suppressed_by)))


@dataclass(frozen=True, slots=True)
class Episode:
    """One period in which an alarm was active; None for a time that has not come yet.

    ``raised_as`` is the name under which it was raised. With ``raised_ns`` it identifies the
    episode.
    """

    alarm: str
    raised_ns: int
    cleared_ns: int | None = None
    acknowledged_ns: int | None = None
    acknowledged_by: str = ""
    evidence: Mapping[str, Any] = field(default_factory=dict)
    raised_as: str = field(default="", compare=False)

    @property
    def is_untold(self) -> bool:
        """Whether suppression has kept it from people so far, and it may still be announced."""
        return self.acknowledged_by == SUPPRESSION and self.acknowledged_ns is None

    @property
    def is_over(self) -> bool:
        """Whether the episode is cleared and acknowledged."""
        return self.cleared_ns is not None and self.acknowledged_ns is not None

    @property
    def seconds(self) -> float | None:
        """How long the alarm was active; None while it is."""
        return None if self.cleared_ns is None else (self.cleared_ns - self.raised_ns) / SECOND_NS


@dataclass(frozen=True, slots=True)
class Comment:
    """A person's comment on an episode, which ``raised_ns`` and ``raised_as`` identify."""

    raised_ns: int
    raised_as: str
    written_ns: int
    who: str
    text: str

    def is_of(self, episode: "Episode") -> bool:
        """Whether it was written to this episode."""
        return (self.raised_ns, self.raised_as) == (episode.raised_ns, episode.raised_as)


class Diary:
    """Builds episodes from changes in their order; it forgets episodes that are over."""

    def __init__(self, going_on: Iterable[Episode] = ()) -> None:
        self._going_on: dict[str, list[Episode]] = {}  # by alarm
        for episode in going_on:
            self._going_on.setdefault(episode.alarm, []).append(episode)

    def take(self, change: Change) -> list[Episode]:
        """The new state of each episode that a change begins or alters."""
        before = self._going_on.pop(change.alarm, [])
        if change.action is AlarmAction.RAISED:
            by = SUPPRESSION if change.untold else ""
            new = Episode(change.alarm, change.time_ns, acknowledged_by=by, raised_as=change.alarm)
            self._going_on[change.alarm] = [*before, new]
            return [new]
        after = [_after_change(episode, change) for episode in before]
        for episode in after:
            if not episode.is_over:
                self._going_on.setdefault(episode.alarm, []).append(episode)
        return [new for old, new in zip(before, after, strict=True) if new is not old]

    def newest(self, alarm: str) -> Episode | None:
        """The newest episode of an alarm that is not over; None without one."""
        episodes = self._going_on.get(alarm)
        return episodes[-1] if episodes else None

    def note(self, alarm: str, evidence: Mapping[str, Any]) -> list[Episode]:
        """Add evidence to the episode of an active alarm; returns that episode, or nothing."""
        episodes = self._going_on.get(alarm, [])
        if not episodes or episodes[-1].cleared_ns is not None:
            return []
        episodes[-1] = replace(
            episodes[-1], evidence=merge_evidence(episodes[-1].evidence, evidence)
        )
        return episodes[-1:]


def merge_evidence(earlier: Mapping[str, Any], later: Mapping[str, Any]) -> dict[str, Any]:
    """Evidence updated by later evidence; the first cycle and the first guess stay.

    A cost goes with the sizes that it belongs to.
    """
    first_values = {key: earlier[key] for key in ("first_cycle", "guess") if key in earlier}
    merged = {**earlier, **later, **first_values}
    if "parameters" in later and "cost" not in later:
        merged.pop("cost", None)
    return merged


def _after_change(episode: Episode, change: Change) -> Episode:
    """The episode after a change of its alarm; an acknowledgement covers all its episodes."""
    if change.action is AlarmAction.CLEARED and episode.cleared_ns is None:
        cleared = replace(episode, cleared_ns=change.time_ns)
        if change.untold:
            cleared = replace(cleared, acknowledged_ns=change.time_ns, acknowledged_by=SUPPRESSION)
        return cleared
    if change.action is AlarmAction.ACKNOWLEDGED:
        return replace(episode, acknowledged_ns=change.time_ns, acknowledged_by=change.who)
    if change.action is AlarmAction.RENAMED:
        return replace(episode, alarm=change.to)
    if change.action is AlarmAction.SUPPRESSED and change.untold and episode.cleared_ns is None:
        return replace(episode, acknowledged_by=SUPPRESSION)  # raised at the same moment
    if change.action is AlarmAction.UNSUPPRESSED and episode.is_untold:
        return replace(episode, acknowledged_by="")
    return episode
