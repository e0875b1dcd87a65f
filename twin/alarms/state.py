"""One alarm: whether it is active, whether somebody has seen it, and what keeps it quiet.

The states of ISA-18.2: active and acknowledged are two things. Shelving (by a person, for a time),
suppression (by design, while another alarm stands) and out of service (by a person, until told
otherwise) keep an alarm from being announced; underneath it goes on.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

from twin.alarms.rules import Rule
from twin.errors import ConfigError

SECOND_NS = 1_000_000_000


class Deed(StrEnum):
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
    RENAMED = "renamed"  # it has another cause than was thought


class State(StrEnum):
    """What it is, as ISA-18.2 names it."""

    NORMAL = "normal"
    UNACKNOWLEDGED = "unacknowledged"  # active
    ACKNOWLEDGED = "acknowledged"  # active
    RETURNED = "returned"  # not active any more, and nobody has acknowledged it
    SHELVED = "shelved"
    SUPPRESSED = "suppressed"
    OUT_OF_SERVICE = "out_of_service"


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that happened to one alarm; ``who`` is empty where the program did it.

    ``announced`` says that people are to be told of the alarm now; one that is renamed goes on as
    ``to``. One that was cleared ``untold`` has nothing to acknowledge.
    """

    time_ns: int
    alarm: str
    deed: Deed
    who: str = ""
    announced: bool = False
    to: str = ""
    untold: bool = False


@dataclass(frozen=True, slots=True)
class Kept:
    """What outlives the program of one alarm; suppression follows from the others."""

    active: bool = False
    acknowledged: bool = True
    shelved_until: int | None = None
    out_of_service: bool = False


_SPEAKS = (Deed.RAISED, Deed.UNSHELVED, Deed.UNSUPPRESSED, Deed.IN_SERVICE)


@dataclass
class Alarm:
    """One alarm over time; every method gives what it changes. Times are ns of one clock."""

    rule: Rule
    active: bool = False
    acknowledged: bool = True
    shelved_until: int | None = None
    suppressed: bool = False
    out_of_service: bool = False
    _beyond: bool = False  # the value is, by the dead band
    _since: int | None = None  # when the value came to where the alarm is not yet
    _turned: int | None = None  # when it became active, or not any more
    _untold: bool = False  # it became active while suppressed

    @property
    def state(self) -> State:
        """What a person sees first."""
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
        """Whether it is active, or was and nobody has seen it; however quiet it is kept."""
        return self.active or not self.acknowledged

    @property
    def is_coming(self) -> bool:
        """Whether its value is beyond the limit, but not yet for long enough."""
        return self._beyond and not self.active

    @property
    def rests(self) -> bool:
        """Whether nothing comes of it while only time goes on."""
        return self._since is None and self._beyond == self.active and self.shelved_until is None

    def see(self, now: int, value: float = math.nan) -> Iterator[Change]:
        """Take the newest value; NaN where there is none, then only time goes on."""
        if self.shelved_until is not None:
            latest = now + self._longest_shelving()  # a clock set back lengthens nothing
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
        """The clock was set: what waits for its delay waits no longer and no less."""
        if self._since is not None:
            self._since += by_ns

    def acknowledge(self, now: int, who: str) -> Iterator[Change]:
        """Somebody has seen it; a latching one may go now."""
        if self.acknowledged:
            return
        self.acknowledged, self._untold = True, False
        yield self._done(now, Deed.ACKNOWLEDGED, who)
        if self.rule.latching:
            yield from self.see(now)

    def shelve(self, now: int, seconds: float, who: str) -> Iterator[Change]:
        """Keep it quiet for a time; ConfigError for longer than its rule lets anybody."""
        if not 0.0 < seconds <= self.rule.longest_shelving_s:
            raise ConfigError(
                f"{self.rule.name} cannot be shelved for {seconds:g} s",
                f"up to {self.rule.longest_shelving_s:g} s; longer: take it out of service",
            )
        self.shelved_until = now + round(seconds * SECOND_NS)
        yield self._done(now, Deed.SHELVED, who)

    def unshelve(self, now: int, who: str = "") -> Iterator[Change]:
        """Let it speak again."""
        if self.shelved_until is not None:
            self.shelved_until = None
            yield self._done(now, Deed.UNSHELVED, who)

    def suppress(self, now: int, wanted: bool) -> Iterator[Change]:
        """Keep it quiet by design, or let it speak again, unless its value is back already."""
        if wanted == self.suppressed:
            return
        if wanted:
            self._untold |= self.active and self._turned == now  # by one that came with it
        elif self.active and not self._beyond:
            yield from self._turn(now)
        self.suppressed = wanted
        self._untold &= wanted
        yield self._done(now, Deed.SUPPRESSED if wanted else Deed.UNSUPPRESSED)

    def serve(self, now: int, wanted: bool, who: str) -> Iterator[Change]:
        """Take it out of service, or back."""
        if wanted == self.out_of_service:
            self.out_of_service = not wanted
            yield self._done(now, Deed.IN_SERVICE if wanted else Deed.OUT_OF_SERVICE, who)

    def become(self, now: int, other: "Alarm") -> Iterator[Change]:
        """Go on as another alarm, which has been the one all along; what keeps each quiet stays."""
        if not (self._beyond or self.concerns):
            return
        other.acknowledged = self.acknowledged and other.acknowledged
        other.active, other._beyond = self.active or other.active, self._beyond or other._beyond
        other._since = self._since
        self.active, self.acknowledged, self._beyond, self._since = False, True, False, None
        speaks = other.state is State.UNACKNOWLEDGED
        yield Change(now, self.rule.name, Deed.RENAMED, "", speaks, other.rule.name)

    def keep(self) -> "Kept":
        """What is to outlive the program."""
        return Kept(self.active, self.acknowledged, self.shelved_until, self.out_of_service)

    def resume(self, kept: "Kept") -> None:
        """Go on where another run ended."""
        self.active = self._beyond = kept.active
        self.acknowledged, self.shelved_until = kept.acknowledged, kept.shelved_until
        self.out_of_service = kept.out_of_service

    def _turn(self, now: int) -> Iterator[Change]:
        """Become what the value has been for long enough."""
        if self.active and self.rule.latching and not self.acknowledged:
            return
        self.active, self._since, self._turned = not self.active, None, now
        if self.active:
            self._untold = self.suppressed and self.acknowledged
            self.acknowledged = False
            yield self._done(now, Deed.RAISED)
            return
        untold, self._untold = self._untold, False
        self.acknowledged |= untold
        yield replace(self._done(now, Deed.CLEARED), untold=untold)

    def _done(self, now: int, deed: Deed, who: str = "") -> Change:
        """What happened; an alarm that may speak again announces what it kept to itself."""
        announced = deed in _SPEAKS and self.state is State.UNACKNOWLEDGED
        return Change(now, self.rule.name, deed, who, announced)

    def _longest_shelving(self) -> int:
        return round(self.rule.longest_shelving_s * SECOND_NS)
