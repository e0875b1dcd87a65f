"""Changes of alarms as events with a text."""

from collections.abc import Mapping
from typing import Any

from twin.alarms.advice import action_of
from twin.alarms.board import Episode
from twin.alarms.rules import Rule, default_rules
from twin.alarms.state import SECOND_NS, Alarm, AlarmAction, Change, State
from twin.alarms.watch import Evidence, quantity
from twin.events import Event, Kind

STATES = {
    State.NORMAL: "nothing to do",
    State.UNACKNOWLEDGED: "active, and nobody has acknowledged it",
    State.ACKNOWLEDGED: "active; somebody has acknowledged it and takes care",
    State.RETURNED: "not active any more, and nobody has acknowledged it",
    State.SHELVED: "a person keeps it from being announced, for a time",
    State.SUPPRESSED: "not announced by design, while an alarm of `suppressed_by` is active",
    State.OUT_OF_SERVICE: "a person keeps it from being announced, until it is in service again",
}
SUPPRESSIONS = (AlarmAction.SUPPRESSED, AlarmAction.UNSUPPRESSED)
_DEED_WORDS = {
    AlarmAction.RAISED: "raised",
    AlarmAction.CLEARED: "cleared",
    AlarmAction.ACKNOWLEDGED: "acknowledged",
    AlarmAction.SHELVED: "shelved",
    AlarmAction.UNSHELVED: "no longer shelved",
    AlarmAction.SUPPRESSED: "suppressed by design",
    AlarmAction.UNSUPPRESSED: "no longer suppressed",
    AlarmAction.OUT_OF_SERVICE: "taken out of service",
    AlarmAction.IN_SERVICE: "in service again",
}


def table() -> str:
    """The states as a table for people."""
    rows = [f"| `{state}` | {meaning} |" for state, meaning in STATES.items()]
    return "\n".join(["| state | what it means |", "| --- | --- |", *rows])


def is_reportable(change: Change, alarm: Alarm) -> bool:
    """Whether to report a change; suppression of an alarm that concerns nobody is not reported."""
    return change.announced or alarm.concerns or change.action not in SUPPRESSIONS


def plain(alarm: Alarm, evidence: Evidence, episode: Episode | None) -> dict[str, Any]:
    """The state of an alarm with its newest episode, as a JSON document."""
    rule = alarm.rule
    return {
        "alarm": rule.name,
        "state": alarm.state.value,
        "active": alarm.active,
        "acknowledged": alarm.acknowledged,
        "raised_ns": episode.raised_ns if episode else None,
        "raised_as": episode.raised_as if episode else None,
        "shelved_until_ns": alarm.shelved_until,
        "quantity": quantity(rule.value),
        "priority": rule.priority.value,
        "consequence": rule.consequence,
        "action": action_of(rule, evidence),
        "evidence": dict(evidence),
    }


def event_of(change: Change, now: Mapping[str, Any], alarm: Alarm, time_ns: int) -> Event:
    """A change as an event at a PLC time; ``now`` is ``plain`` of the alarm with its new name."""
    data = {**now, "deed": change.action.value, "host_ns": change.time_ns, "who": change.who}
    if change.action is AlarmAction.RENAMED:
        data["was"] = change.alarm
    kind = Kind.ALARM if change.announced else Kind.ALARM_CHANGED
    return Event(time_ns, kind, _text(change, alarm, now["evidence"]), data)


def _text(change: Change, alarm: Alarm, evidence: Evidence) -> str:
    sentence = _deed(change, alarm)
    if not change.announced:
        return sentence
    rule = alarm.rule
    reason = f": {evidence['words']}" if "words" in evidence else ""
    # The same as before.
    consequence = "" if change.action is AlarmAction.RENAMED else rule.consequence
    advice = " ".join(filter(None, (consequence, action_of(rule, evidence))))
    return f"{sentence} ({rule.priority} priority){reason}. {advice}".rstrip()


def _deed(change: Change, alarm: Alarm) -> str:
    """A short sentence about the change."""
    if change.action is AlarmAction.RENAMED:
        return f"{change.alarm} is now {change.to}"
    by = f" by {change.who}" if change.who else ""
    sentence = f"{change.alarm} {_DEED_WORDS[change.action]}{by}"
    if change.action is AlarmAction.SHELVED and alarm.shelved_until is not None:
        return f"{sentence} for {(alarm.shelved_until - change.time_ns) / SECOND_NS / 60:.3g} min"
    if change.action is AlarmAction.RAISED and not change.announced:
        return f"{sentence}, not announced: {str(alarm.state).replace('_', ' ')}"
    return sentence


def rules_table() -> str:
    """The rules that come with the program as a table for people."""
    rows = [f"| `{rule.name}` | {_in_columns(rule)} |" for rule in default_rules()]
    header = "| alarm | priority | delays | if nobody acts | what to do |"
    return "\n".join([header, "| --- | --- | --- | --- | --- |", *rows])


def _in_columns(rule: Rule) -> str:
    delays = f"{rule.on_delay_s:g} s on, {rule.off_delay_s:g} s off"
    return " | ".join((rule.priority, delays, rule.consequence, rule.action))
