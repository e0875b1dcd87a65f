"""One alarm: whether it is active, acknowledged, and kept from being announced.

The states are those of ISA-18.2. Active and acknowledged are independent. Three states keep an
alarm from being announced: shelved (by a person, for a time), suppressed (by design, while another
alarm stands) and out of service (by a person, until put back). Meanwhile it follows its value.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

from twin.alarms.rules import Rule
from twin.errors import ConfigError

SECOND_NS = 1_000_000_000


class AlarmAction(StrEnum):
    """What happened to an alarm."""

    RAISED = "raised"
    CLEARED = "cleared"
    ACKNOWLEDGED = "acknowledged"
    SHELVED = "shelved"
    UNSHELVED = "unshelved"
    SUPPRESSED = "suppressed"
    UNSUPPRESSED = "unsuppressed"
    OUT_OF_SERVICE = "out_of_service"
    IN_SERVICE = "in_service"
    RENAMED = "renamed"  # it has another cause than assumed


class State(StrEnum):
    """The state of an alarm, with the names of ISA-18.2."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "unacknowledged"  # active
    ACKNOWLEDGED = "acknowledged"  # active
    RETURNED = "returned"  # no longer active, not acknowledged
    SHELVED = "shelved"
    SUPPRESSED = "suppressed"
    OUT_OF_SERVICE = "out_of_service"


@dataclass(frozen=True, slots=True)
class Change:
    """One change of one alarm; ``who`` is empty if the program made it.

    ``announced`` says that people must be notified now. A renamed alarm goes on as ``to``. An alarm
    was raised ``untold`` if suppression kept it from people; cleared so, it needs no
    acknowledgement.
    """

    time_ns: int
    alarm: str
    action: AlarmAction
    who: str = ""
    announced: bool = False
    to: str = ""
    untold: bool = False


@dataclass(frozen=True, slots=True)
class Kept:
    """The part of an alarm's state that outlives the program; suppression follows from others."""

    active: bool = False
    acknowledged: bool = True
    shelved_until: int | None = None
    out_of_service: bool = False


_ANNOUNCING = (
    AlarmAction.RAISED,
    AlarmAction.UNSHELVED,
    AlarmAction.UNSUPPRESSED,
    AlarmAction.IN_SERVICE,
)


@dataclass
class Alarm:
    """One alarm over time; every method returns its changes. Times are ns of one clock."""

    rule: Rule
    active: bool = False
    acknowledged: bool = True
    shelved_until: int | None = None
    suppressed: bool = False
    out_of_service: bool = False
    _beyond: bool = False  # the value is beyond the limit, with the dead band
    _since: int | None = None  # when the value crossed the limit, while the delay runs
    _turned: int | None = None  # when it last became active or inactive
    _untold: bool = False  # it became active while suppressed

    @property
    def state(self) -> State:
        """The one state to show to a person."""
        if self.out_of_service:
            return State.OUT_OF_SERVICE
        if self.suppressed:
            return State.SUPPRESSED
        if self.shelved_until is not None:
            return State.SHELVED
        if self.active:
            return State.ACKNOWLEDGED if self.acknowledged else State.UNACKNOWLEDGED
        return State.NORMAL if self.acknowledged else State.RETURNED

    @property
    def concerns(self) -> bool:
        """Whether it is active or unacknowledged, even if it is shelved or suppressed."""
        return self.active or not self.acknowledged

    @property
    def is_coming(self) -> bool:
        """Whether its value is beyond the limit, and its delay still runs."""
        return self._beyond and not self.active

    @property
    def rests(self) -> bool:
        """Whether passing time alone cannot change it."""
        return self._since is None and self._beyond == self.active and self.shelved_until is None

    def see(self, now: int, value: float = math.nan) -> Iterator[Change]:
        """Take the newest value; with NaN only time passes."""
        if self.shelved_until is not None:
            # Setting the clock back must not extend shelving.
            latest = now + self._longest_shelving()
            self.shelved_until = min(self.shelved_until, latest)
            if now >= self.shelved_until:
                yield from self.unshelve(now)
        if not math.isnan(value):
            self._beyond = self.rule.is_beyond(value, self._beyond)
        if self._beyond == self.active:
            self._since = None
            return
        self._since = now if self._since is None else min(self._since, now)
        delay = self.rule.on_delay_s if self._beyond else self.rule.off_delay_s
        if now - self._since >= delay * SECOND_NS:
            yield from self._turn(now)

    def shift(self, by_ns: int) -> None:
        """Shift a running delay after the clock was set, so that it keeps its length."""
        if self._since is not None:
            self._since += by_ns

    def acknowledge(self, now: int, who: str) -> Iterator[Change]:
        """Acknowledge it; a latching alarm may clear from now on."""
        if self.acknowledged:
            return
        self.acknowledged, self._untold = True, False
        yield self._change(now, AlarmAction.ACKNOWLEDGED, who)
        if self.rule.latching:
            yield from self.see(now)

    def shelve(self, now: int, seconds: float, who: str) -> Iterator[Change]:
        """Shelve it for a time; ConfigError for longer than its rule allows."""
        if not 0.0 < seconds <= self.rule.longest_shelving_s:
            raise ConfigError(
                f"{self.rule.name} cannot be shelved for {seconds:g} s",
                f"up to {self.rule.longest_shelving_s:g} s; longer: take it out of service",
            )
        self.shelved_until = now + round(seconds * SECOND_NS)
        yield self._change(now, AlarmAction.SHELVED, who)

    def unshelve(self, now: int, who: str = "") -> Iterator[Change]:
        """End shelving."""
        if self.shelved_until is not None:
            self.shelved_until = None
            yield self._change(now, AlarmAction.UNSHELVED, who)

    def suppress(self, now: int, suppressed: bool) -> Iterator[Change]:
        """Begin or end suppression; at the end it clears if its value is back in limits."""
        if suppressed == self.suppressed:
            return
        if suppressed:
            # It was raised at the same moment as the other alarm.
            self._untold |= self.active and self._turned == now
        elif self.active and not self._beyond:
            yield from self._turn(now)
        self.suppressed = suppressed
        self._untold &= suppressed
        action = AlarmAction.SUPPRESSED if suppressed else AlarmAction.UNSUPPRESSED
        yield replace(self._change(now, action), untold=self._untold)

    def serve(self, now: int, in_service: bool, who: str) -> Iterator[Change]:
        """Put it into service, or take it out."""
        if in_service == self.out_of_service:
            self.out_of_service = not in_service
            yield self._change(
                now, AlarmAction.IN_SERVICE if in_service else AlarmAction.OUT_OF_SERVICE, who
            )

    def become(self, now: int, successor: "Alarm") -> Iterator[Change]:
        """Hand its state to another alarm, the true one; shelving and the like stay with each."""
        if not (self._beyond or self.concerns):
            return
        successor.acknowledged = self.acknowledged and successor.acknowledged
        successor.active, successor._beyond = (
            self.active or successor.active,
            self._beyond or successor._beyond,
        )
        successor._since = self._since
        self.active, self.acknowledged, self._beyond, self._since = False, True, False, None
        announced = successor.state is State.UNACKNOWLEDGED
        yield Change(now, self.rule.name, AlarmAction.RENAMED, "", announced, successor.rule.name)

    def keep(self) -> "Kept":
        """The state that outlives the program."""
        return Kept(self.active, self.acknowledged, self.shelved_until, self.out_of_service)

    def resume(self, kept: "Kept") -> None:
        """Restore the state of an earlier run."""
        self.active = self._beyond = kept.active
        self.acknowledged, self.shelved_until = kept.acknowledged, kept.shelved_until
        self.out_of_service = kept.out_of_service

    def _turn(self, now: int) -> Iterator[Change]:
        """Become active or inactive after the delay."""
        if self.active and self.rule.latching and not self.acknowledged:
            return
        self.active, self._since, self._turned = not self.active, None, now
        if self.active:
            self._untold = self.suppressed and self.acknowledged
            self.acknowledged = False
            yield replace(self._change(now, AlarmAction.RAISED), untold=self._untold)
            return
        untold, self._untold = self._untold, False
        self.acknowledged |= untold
        yield replace(self._change(now, AlarmAction.CLEARED), untold=untold)

    def _change(self, now: int, action: AlarmAction, who: str = "") -> Change:
        """A change of this alarm; it is announced if people must be notified of the alarm now."""
        announced = action in _ANNOUNCING and self.state is State.UNACKNOWLEDGED
        return Change(now, self.rule.name, action, who, announced)

    def _longest_shelving(self) -> int:
        return round(self.rule.longest_shelving_s * SECOND_NS)
