"""Who is told of an alarm now: by duty, by steps of escalation, and not too often.

A call is about one alarm that people were to be told of. It is open while the alarm is active and
nobody has acknowledged, shelved or suppressed it. Times are ns of the clock that is passed in.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any

from twin.alarms.state import State
from twin.files import json_text
from twin.notifications.message import Message, new_id
from twin.notifications.people import Person
from twin.notifications.settings import NotificationSettings

MAIL_FORMAT = "ejector-twin-mail/1"
MINUTE_NS = 60 * 1_000_000_000
_BY_PEOPLE = (State.ACKNOWLEDGED, State.SHELVED, State.OUT_OF_SERVICE)


class Reason(StrEnum):
    """Why somebody is told."""

    RAISED = "raised"
    ESCALATED = "escalated"  # nobody has acknowledged it
    ON_DUTY = "on_duty"  # it stood already when the person's duty began
    REPEATED = "repeated"  # it was raised again, once or more, since the last mail


@dataclass(frozen=True)
class LastMail:
    """When a person was told last, and how often the alarm had been raised by then."""

    time_ns: int
    count: int


@dataclass(frozen=True)
class Call:
    """What people were told of one alarm."""

    alarm: str
    document: Mapping[str, Any]  # the alarm as its newest message has it
    begun_ns: int
    raised_ns: int  # the last time
    step: int  # reached by escalation
    step_ns: int  # when that was
    count: int = 1  # times that it was raised
    is_open: bool = True
    is_handled: bool = False  # by a person; being raised again begins another call
    told: Mapping[str, LastMail] = field(default_factory=dict)  # by address

    def to_json(self) -> str:
        """The call as text for a database."""
        return json_text(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Call":
        """The call that ``to_json`` has written."""
        values = json.loads(text)
        told = {address: LastMail(**entry) for address, entry in values.pop("told").items()}
        return cls(told=told, **values)


@dataclass
class Outcome:
    """What changes: calls to store by alarm (None: it is over), and mails to send."""

    calls: dict[str, Call | None] = field(default_factory=dict)
    mails: list[Message] = field(default_factory=list)


class Escalation:
    """Decides who is told when; it holds the calls of one ejector.

    The caller stores each outcome, then calls ``accept``. Without that the next outcome is the same
    again, so nobody is forgotten if storing fails.
    """

    def __init__(self, settings: NotificationSettings, calls: Mapping[str, Call]) -> None:
        self._people = settings.everybody
        self._steps = sorted({person.step for person in self._people})
        self._pause_ns = round(settings.email.pause_min * MINUTE_NS)
        self._escalate_ns = round(settings.escalate_after_min * MINUTE_NS)
        self._calls = dict(calls)

    def take(self, documents: Iterable[Mapping[str, Any]], now_ns: int) -> Outcome:
        """Take changes of alarms in their order (as ``twin.notifications.message`` has them)."""
        outcome, calls = Outcome(), dict(self._calls)
        for document in documents:
            if call := self._announced(calls, document, now_ns):
                self._tell(call, now_ns, calls, outcome)
            else:
                _follow(calls, document)
        outcome.calls = self._differences(calls)
        return outcome

    def due(self, now_ns: int) -> Outcome:
        """What is to be told because time has passed."""
        outcome, calls = Outcome(), dict(self._calls)
        for call in self._calls.values():
            self._tell(call, now_ns, calls, outcome)
            self._forget(calls, call.alarm, now_ns)
        outcome.calls = self._differences(calls)
        return outcome

    def accept(self, outcome: Outcome) -> None:
        """Go on from an outcome that is stored."""
        for alarm, call in outcome.calls.items():
            if call is None:
                self._calls.pop(alarm, None)
            else:
                self._calls[alarm] = call

    def _differences(self, calls: Mapping[str, Call]) -> dict[str, Call | None]:
        ended = dict.fromkeys(set(self._calls) - set(calls))
        return ended | {
            alarm: call for alarm, call in calls.items() if self._calls.get(alarm) is not call
        }

    # --- changes of alarms ----------------------------------------------------------------------

    def _announced(
        self, calls: Mapping[str, Call], document: Mapping[str, Any], now_ns: int
    ) -> Call | None:
        """The call of an alarm that people are to be told of now; None if they are not."""
        if not document["announced"] or document["state"] != State.UNACKNOWLEDGED:
            return None
        call = self._raised(calls.get(document["alarm"]), document, now_ns)
        earlier = calls.get(document.get("renamed_from", ""))
        if earlier is None:
            return call
        begun_ns, step = min(earlier.begun_ns, call.begun_ns), max(earlier.step, call.step)
        # Another cause of the same fault: escalation goes on.
        return replace(call, begun_ns=begun_ns, step=step, step_ns=earlier.step_ns)

    def _raised(self, call: Call | None, document: Mapping[str, Any], now_ns: int) -> Call:
        """The call of an alarm that is announced: a new one, unless it has just been told."""
        alarm = document["alarm"]
        is_new = call is None or call.is_handled or now_ns - call.raised_ns >= self._pause_ns
        if call is None or is_new:
            return Call(alarm, document, now_ns, now_ns, self._steps[0], now_ns)
        return replace(
            call, document=document, raised_ns=now_ns, count=call.count + 1, is_open=True
        )

    def _forget(self, calls: dict[str, Call], alarm: str, now_ns: int) -> None:
        """Drop a call that is over; until the pause ends, being raised again continues it."""
        call = calls[alarm]
        if not call.is_open and (call.is_handled or now_ns - call.raised_ns >= self._pause_ns):
            del calls[alarm]

    # --- people ---------------------------------------------------------------------------------

    def _tell(self, call: Call, now_ns: int, calls: dict[str, Call], outcome: Outcome) -> None:
        """Tell whom the call concerns now."""
        if call.is_handled:
            return
        if call.is_open:
            call = self._escalated(call, now_ns)
        for person in self._people:
            if reason := self._reason(call, person, now_ns):
                outcome.mails.append(_mail(call, person, reason))
                call = replace(
                    call, told={**call.told, person.address: LastMail(now_ns, call.count)}
                )
        calls[call.alarm] = call

    def _escalated(self, call: Call, now_ns: int) -> Call:
        """The call at the step that it has reached.

        A step passes when its time is over. One with nobody to tell passes at once.
        """
        if call.step_ns > now_ns:  # the clock was set back
            call = replace(call, step_ns=now_ns)
        later = [step for step in self._steps if step > call.step]
        for step in later:
            if now_ns - call.step_ns < self._escalate_ns and self._reaches(call, now_ns):
                break
            call = replace(call, step=step, step_ns=now_ns)
        return call

    def _reaches(self, call: Call, now_ns: int) -> bool:
        """Whether somebody of the call's step was told, or can be now."""
        return any(
            person.address in call.told or self._is_available(call, person, now_ns)
            for person in self._people
            if person.step == call.step
        )

    def _reason(self, call: Call, person: Person, now_ns: int) -> Reason | None:
        """Why a person is to be told now; None if not."""
        if person.step > call.step or not self._is_available(call, person, now_ns):
            return None
        told = call.told.get(person.address)
        if told is not None:
            is_due = call.count > told.count and now_ns - told.time_ns >= self._pause_ns
            return Reason.REPEATED if is_due else None
        if not call.is_open:
            return None
        if person.step > self._steps[0] and call.step_ns == now_ns and call.begun_ns != now_ns:
            return Reason.ESCALATED
        return Reason.RAISED if call.raised_ns == now_ns else Reason.ON_DUTY

    def _is_available(self, call: Call, person: Person, now_ns: int) -> bool:
        return person.is_told_of(call.document["priority"]) and person.is_on_duty(now_ns)


def _follow(calls: dict[str, Call], document: Mapping[str, Any]) -> None:
    """Note a change that is told to nobody; it may end the call."""
    call = calls.get(document["alarm"])
    if call is None:
        return
    is_handled = document["acknowledged"] or document["state"] in _BY_PEOPLE
    calls[call.alarm] = replace(
        call,
        document=document,
        is_open=call.is_open and document["state"] == State.UNACKNOWLEDGED,
        # The old name of a renamed alarm counts as acknowledged, but by nobody.
        is_handled=call.is_handled or (is_handled and "renamed_to" not in document),
    )


def _mail(call: Call, person: Person, reason: Reason) -> Message:
    """A mail to a person, to be written when it is sent."""
    number = new_id()
    body = {
        "format": MAIL_FORMAT,
        "id": number,
        "name": person.name,
        "address": person.address,
        "time_zone": person.time_zone,
        "reason": reason.value,
        "count": call.count,
        "begun_ns": call.begun_ns,
        "document": call.document,
    }
    return Message(number, call.alarm, json_text(body))
