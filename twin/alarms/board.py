"""All alarms of one ejector together: values in, changes out; and episodes made of changes."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from twin.alarms.rules import Priority, Rule
from twin.alarms.state import SECOND_NS, Alarm, Change, Deed, State
from twin.errors import ConfigError

_ORDER = tuple(reversed(Priority))  # the most urgent first


class Board:
    """The alarms of one ejector by their rules."""

    def __init__(self, rules: Sequence[Rule]) -> None:
        self.alarms = {rule.name: Alarm(rule) for rule in rules}

    def see(self, now: int, values: Mapping[str, float]) -> list[Change]:
        """Take what is new, by name; of what is not in it only time goes on."""
        changes: list[Change] = []
        for alarm in self.alarms.values():
            changes += alarm.see(now, values.get(alarm.rule.value, float("nan")))
        designed = list(self._designed(now))
        suppressed = {change.alarm for change in designed if change.deed is Deed.SUPPRESSED}
        # What suppresses another alarm does so from the moment on in which both are raised.
        changes = [
            replace(one, announced=False) if one.alarm in suppressed else one for one in changes
        ]
        return [*changes, *designed]

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

    def _designed(self, now: int) -> Iterator[Change]:
        """Suppress what is quiet by design while another alarm is active."""
        active = {name for name, alarm in self.alarms.items() if alarm.active}
        for alarm in self.alarms.values():
            yield from alarm.suppress(now, bool(active & set(alarm.rule.suppressed_by)))


@dataclass(frozen=True, slots=True)
class Episode:
    """One time that an alarm was active; None for what has not happened yet."""

    alarm: str
    raised_ns: int
    cleared_ns: int | None = None
    acknowledged_ns: int | None = None
    acknowledged_by: str = ""

    @property
    def is_over(self) -> bool:
        """Whether it is cleared and acknowledged."""
        return self.cleared_ns is not None and self.acknowledged_ns is not None

    @property
    def seconds(self) -> float | None:
        """How long it was active."""
        return None if self.cleared_ns is None else (self.cleared_ns - self.raised_ns) / SECOND_NS


def episodes(changes: Iterable[Change]) -> list[Episode]:
    """The episodes that changes in their order make, in the order they were raised."""
    found: list[Episode] = []
    going_on: dict[str, list[int]] = {}  # of each alarm: the places in found of what is not over
    for change in changes:
        places = going_on.setdefault(change.alarm, [])
        if change.deed is Deed.RAISED:
            places.append(len(found))
            found.append(Episode(change.alarm, change.time_ns))
            continue
        for place in places:
            found[place] = _gone_on(found[place], change)
        going_on[change.alarm] = [place for place in places if not found[place].is_over]
    return found


def _gone_on(episode: Episode, change: Change) -> Episode:
    """The episode after a change to its alarm; who acknowledges has seen all of its episodes."""
    if change.deed is Deed.CLEARED and episode.cleared_ns is None:
        return replace(episode, cleared_ns=change.time_ns)
    if change.deed is Deed.ACKNOWLEDGED:
        return replace(episode, acknowledged_ns=change.time_ns, acknowledged_by=change.who)
    return episode
