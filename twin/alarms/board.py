"""All alarms of one ejector together: values in, changes out; and episodes made of changes."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from twin.alarms.rules import Priority, Rule
from twin.alarms.state import SECOND_NS, Alarm, Change, Deed, Kept, State
from twin.errors import ConfigError

SUPPRESSION = "suppression"  # stands for who acknowledges what nobody was told of
_ORDER = tuple(reversed(Priority))  # the most urgent first


class Board:
    """The alarms of one ejector by their rules."""

    def __init__(self, rules: Sequence[Rule]) -> None:
        self.alarms = {rule.name: Alarm(rule) for rule in rules}
        self._suppressible = [one for one in self.alarms.values() if one.rule.suppressed_by]
        self._suppressing = {name for one in self._suppressible for name in one.rule.suppressed_by}

    def see(self, now: int, values: Mapping[str, float]) -> list[Change]:
        """Take what is new, by name; of what is not in it only time goes on."""
        changes: list[Change] = []
        for alarm in self.alarms.values():
            if alarm.rule.value in values or not alarm.rests:
                changes += alarm.see(now, values.get(alarm.rule.value, math.nan))
        designed = list(self._designed(now))
        suppressed = {change.alarm for change in designed if change.deed is Deed.SUPPRESSED}
        # What suppresses another alarm does so from the moment on in which both are raised.
        changes = [
            replace(one, announced=False) if one.alarm in suppressed else one for one in changes
        ]
        return [*changes, *designed]

    def resume(self, states: Mapping[str, Kept]) -> None:
        """Go on where another run ended; alarms that the rules do not know any more are left."""
        for name, kept in states.items():
            if name in self.alarms:
                self.alarms[name].resume(kept)

    def watching(self, value: str) -> list[Alarm]:
        """The alarms of a value, in the order of the rules."""
        return [alarm for alarm in self.alarms.values() if alarm.rule.value == value]

    def rename(self, now: int, value: str, other: str) -> list[Change]:
        """What was taken for one cause is another one: its alarms go on as those of the other."""
        changes: list[Change] = []
        for old, new in zip(self.watching(value), self.watching(other), strict=True):
            changes += old.become(now, new)
        return [*changes, *self._designed(now)]

    def __getitem__(self, name: str) -> Alarm:
        if name not in self.alarms:
            raise ConfigError(f"no alarm is called {name}", f"there are: {', '.join(self.alarms)}")
        return self.alarms[name]

    def standing(self) -> list[Alarm]:
        """What a person is to look at: the most urgent first, of these the unacknowledged."""
        shown = [
            alarm
            for alarm in self.alarms.values()
            if alarm.state in (State.UNACKNOWLEDGED, State.ACKNOWLEDGED, State.RETURNED)
        ]
        return sorted(shown, key=lambda one: (_ORDER.index(one.rule.priority), one.acknowledged))

    def quiet(self) -> list[Alarm]:
        """What is shelved or out of service, or has something to say but is suppressed."""
        return [
            alarm
            for alarm in self.alarms.values()
            if alarm.state in (State.SHELVED, State.OUT_OF_SERVICE)
            or (alarm.state is State.SUPPRESSED and alarm.concerns)
        ]

    def _designed(self, now: int) -> Iterator[Change]:
        """Suppress what is quiet by design while another alarm is active."""
        active = {name for name in self._suppressing if self.alarms[name].active}
        for alarm in self._suppressible:
            yield from alarm.suppress(now, bool(active & set(alarm.rule.suppressed_by)))


@dataclass(frozen=True, slots=True)
class Episode:
    """One time that an alarm was active; None for what has not happened yet.

    ``raised_as`` is the name it was raised under; with the time it tells an episode from others.
    """

    alarm: str
    raised_ns: int
    cleared_ns: int | None = None
    acknowledged_ns: int | None = None
    acknowledged_by: str = ""
    evidence: Mapping[str, Any] = field(default_factory=dict)
    raised_as: str = field(default="", compare=False)

    @property
    def is_over(self) -> bool:
        """Whether it is cleared and acknowledged."""
        return self.cleared_ns is not None and self.acknowledged_ns is not None

    @property
    def seconds(self) -> float | None:
        """How long it was active."""
        return None if self.cleared_ns is None else (self.cleared_ns - self.raised_ns) / SECOND_NS


@dataclass(frozen=True, slots=True)
class Comment:
    """What somebody wrote to an episode, which its first name and time tell from others."""

    raised_ns: int
    raised_as: str
    written_ns: int
    who: str
    text: str

    def is_of(self, episode: "Episode") -> bool:
        """Whether it was written to that one."""
        return (self.raised_ns, self.raised_as) == (episode.raised_ns, episode.raised_as)


class Diary:
    """The episodes that changes in their order make; of those that are over it knows nothing."""

    def __init__(self, going_on: Iterable[Episode] = ()) -> None:
        self._going_on: dict[str, list[Episode]] = {}  # by alarm
        for episode in going_on:
            self._going_on.setdefault(episode.alarm, []).append(episode)

    def take(self, change: Change) -> list[Episode]:
        """The episodes that a change begins or alters, as they are then."""
        before = self._going_on.pop(change.alarm, [])
        if change.deed is Deed.RAISED:
            new = Episode(change.alarm, change.time_ns, raised_as=change.alarm)
            self._going_on[change.alarm] = [*before, new]
            return [new]
        after = [_gone_on(one, change) for one in before]
        for one in after:
            if not one.is_over:
                self._going_on.setdefault(one.alarm, []).append(one)
        return [new for old, new in zip(before, after, strict=True) if new is not old]

    def newest(self, alarm: str) -> Episode | None:
        """The newest episode of an alarm, of those that go on."""
        episodes = self._going_on.get(alarm)
        return episodes[-1] if episodes else None

    def note(self, alarm: str, evidence: Mapping[str, Any]) -> list[Episode]:
        """The episode of an alarm that is active, with more to speak for it."""
        episodes = self._going_on.get(alarm, [])
        if not episodes or episodes[-1].cleared_ns is not None:
            return []
        episodes[-1] = replace(episodes[-1], evidence=joined(episodes[-1].evidence, evidence))
        return episodes[-1:]


def joined(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """What is known later over what was; the first cycle and the first guess stay."""
    stays = {key: before[key] for key in ("first_cycle", "guess") if key in before}
    return {**before, **after, **stays}


def _gone_on(episode: Episode, change: Change) -> Episode:
    """The episode after a change to its alarm; who acknowledges has seen all of its episodes."""
    if change.deed is Deed.CLEARED and episode.cleared_ns is None:
        over = replace(episode, cleared_ns=change.time_ns)
        if change.untold:
            over = replace(over, acknowledged_ns=change.time_ns, acknowledged_by=SUPPRESSION)
        return over
    if change.deed is Deed.ACKNOWLEDGED:
        return replace(episode, acknowledged_ns=change.time_ns, acknowledged_by=change.who)
    if change.deed is Deed.RENAMED:
        return replace(episode, alarm=change.to)
    return episode
