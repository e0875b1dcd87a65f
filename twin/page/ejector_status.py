"""The status of an ejector, and its alarms for a technician.

The functions return plain dictionaries for the browser; times are Unix seconds of host time.
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Any

from twin.alarms.advice import action_of
from twin.alarms.board import Board, Comment, Episode
from twin.alarms.causes import UNLISTED, cause_of
from twin.alarms.requests import Request
from twin.alarms.rules import Priority, Rule
from twin.alarms.state import Alarm, State
from twin.diagnosis.retelling import retold
from twin.diagnosis.text import (
    Times,
    capital,
    certainty,
    cost,
    ends,
    number,
    plain_words,
    spoken,
    when,
)
from twin.figures.key_figures import NO_DASH
from twin.instants import instant, lasting
from twin.languages.texts import ENGLISH, language_code, numeral, tr
from twin.model.effects import EFFECTS, UNKNOWN
from twin.monitor.healthy import NOT_COMMISSIONED

S_NS = 1_000_000_000
_STANDING = (State.UNACKNOWLEDGED, State.ACKNOWLEDGED, State.RETURNED)
_PRIORITIES = (Priority.HIGH, Priority.MEDIUM, Priority.LOW)
WITHOUT = {  # causes that are no effect
    UNLISTED: "Something that no listed cause explains",
    UNKNOWN: "Something has changed; its cause is not known yet",
}
_UPPER_CASE = {"plc": "PLC", "h1": "H1", "h2": "H2"}
_URGENT_PRIORITIES = (Priority.HIGH, Priority.MEDIUM)
STATES = {  # as ISA-18.2 names them
    State.NORMAL: "normal",
    State.UNACKNOWLEDGED: "unacknowledged",
    State.ACKNOWLEDGED: "acknowledged",
    State.RETURNED: "returned to normal, unacknowledged",
    State.SHELVED: "shelved",
    State.SUPPRESSED: "suppressed by design",
    State.OUT_OF_SERVICE: "out of service",
}
PRIORITIES = {
    Priority.HIGH: "high priority",
    Priority.MEDIUM: "medium priority",
    Priority.LOW: "low priority",
}


class Light(StrEnum):
    """The status at a glance, as a traffic light."""

    RED = "red"  # an urgent alarm is unacknowledged
    YELLOW = "yellow"  # an alarm stands, is shelved or is out of service
    GREEN = "green"  # it runs without alarms
    GREY = "grey"  # its state is unknown now


WORDS = {
    Light.RED: "Alarm",
    Light.YELLOW: "Look after it",
    Light.GREEN: "All right",
    Light.GREY: "Not running",
}


WORST_FIRST = (Light.RED, Light.GREY, Light.YELLOW, Light.GREEN)


def rank(state: str, priority: str) -> tuple[int, int]:
    """The sort key of an alarm: active and unacknowledged ones first, then the most urgent."""
    position = _STANDING.index(State(state)) if state in _STANDING else len(_STANDING)
    is_known = priority in _PRIORITIES
    return position, _PRIORITIES.index(Priority(priority)) if is_known else len(_PRIORITIES)


def light_of(board: Board, *, running: bool) -> Light:
    """The status: never green while an alarm is active, even if it is shelved or suppressed."""
    if not running:
        return Light.GREY
    alarms = board.alarms.values()
    if any(
        alarm.state is State.UNACKNOWLEDGED and alarm.rule.priority in _URGENT_PRIORITIES
        for alarm in alarms
    ):
        return Light.RED
    if any(alarm.concerns or alarm.state is State.OUT_OF_SERVICE for alarm in alarms):
        return Light.YELLOW
    return Light.GREEN


def alarm_cards(
    board: Board,
    episodes: Iterable[Episode],
    waiting: Sequence[Request],
    now_ns: int,
    comments: Sequence[Comment] = (),
) -> list[dict[str, Any]]:
    """Alarms for a person to handle, active and most urgent ones first; then the quiet ones."""
    by_name = {entry.alarm: entry for entry in episodes}
    alarms = [*board.standing(), *board.quiet()]
    alarms.sort(key=lambda entry: rank(entry.state, entry.rule.priority))
    return [
        _alarm(entry, waiting, now_ns)
        | _episode(by_name.get(entry.rule.name), entry.rule, now_ns, comments)
        for entry in alarms
    ]


def _episode(
    episode: Episode | None, rule: Rule, now_ns: int, comments: Sequence[Comment]
) -> dict[str, Any]:
    """The facts of an alarm's episode; only its name if it has none."""
    action = {"action": action_of(rule, episode.evidence if episode else {})}
    if episode is None:
        return action | describe_alarm(rule.name, rule.value) | {"comments": [], "facts": []}
    return action | episode_details(episode, rule.value, now_ns, comments)


def _alarm(alarm: Alarm, waiting: Sequence[Request], now_ns: int) -> dict[str, Any]:
    rule = alarm.rule
    until = alarm.shelved_until
    return {
        "alarm": rule.name,
        "state": alarm.state.value,
        "state_words": state_words(alarm.state),
        "active": alarm.active,
        "rank": list(rank(alarm.state, rule.priority)),
        "acknowledged": alarm.acknowledged,
        "priority": rule.priority.value,
        "priority_words": priority_words(rule.priority),
        "longest_shelving_s": rule.longest_shelving_s,
        "shelved_until": until and until / S_NS,
        "quiet_until": instant_text(until, now_ns),
        "consequence": tr(rule.consequence),
        "asked": [_request(request) for request in waiting if request.alarm == rule.name],
    }


def state_words(state: str) -> str:
    """A state for people; one that is unknown here stays as it is."""
    return tr(STATES[State(state)]) if state in STATES else state


def priority_words(priority: str) -> str:
    """A priority for people; one that is unknown here stays as it is."""
    return tr(PRIORITIES[Priority(priority)]) if priority in PRIORITIES else priority


def _request(request: Request) -> dict[str, Any]:
    return {"deed": request.action.value, "who": request.who, "at": request.asked_ns / S_NS}


def instant_text(ns: int | None, now_ns: int) -> str:
    """An instant in words; empty for None."""
    return "" if ns is None else instant(ns, now_ns)


def episode_details(
    episode: Episode, value: str, now_ns: int, comments: Sequence[Comment] = ()
) -> dict[str, Any]:
    """One episode of an alarm: title, times, evidence and certainty.

    ``times`` has its instants in words, relative to ``now_ns``.
    """
    raised, cleared, seen = episode.raised_ns, episode.cleared_ns, episode.acknowledged_ns
    return {
        **describe_alarm(episode.alarm, value, episode.evidence.get("taken_in")),
        "raised": raised / S_NS,
        "cleared": cleared and cleared / S_NS,
        "seen": seen and seen / S_NS,
        "times": {
            "raised": instant_text(raised, now_ns),
            "cleared": instant_text(cleared, now_ns),
            "seen": instant_text(seen, now_ns),
            "lasted": "" if cleared is None else lasting((cleared - raised) / S_NS),
        },
        "seen_by": episode.acknowledged_by,
        "facts": [[name, text] for name, text in facts(episode.evidence)],
        "report": episode.evidence.get("report", ""),
        "episode": [episode.raised_as, str(raised)],  # JavaScript's numbers are too short for ns
        "comments": [
            {
                "who": comment.who,
                "when": instant_text(comment.written_ns, now_ns),
                "text": comment.text,
            }
            for comment in comments
            if comment.is_of(episode)
        ],
    }


def describe_alarm(
    alarm: str, value: str, entry: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Title, sentence and place of an alarm; ``entry`` describes a catalogue's effect."""
    if entry:
        heading, location = capital(spoken(entry["name"])), entry["look_at"].partition(":")[0]
        return {"what": heading, "sentence": f"{entry['sentence']}.", "where": location}
    cause = cause_of(value)
    if cause in EFFECTS:
        return {
            "what": capital(spoken(cause)),
            "sentence": f"{tr(EFFECTS[cause].sentence)}.",
            "where": tr(EFFECTS[cause].look_at).partition(":")[0],
        }
    title = tr(WITHOUT[cause] if cause in WITHOUT else spelt(alarm))
    return {"what": capital(title), "sentence": "", "where": ""}


def spelt(alarm: str) -> str:
    """The name in words of an alarm without a cause."""
    return " ".join(_UPPER_CASE.get(word, word) for word in plain_words(alarm).split())


def facts(evidence: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """The evidence as pairs of name and text."""
    sizes = evidence.get("parameters", {}).values()
    if sizes:
        yield tr("size"), "; ".join(_size(parameter) for parameter in sizes)
    yield from ((tr("how sure"), text) for text in _sureness(evidence))
    if "cost" in evidence:
        yield tr("cost"), cost(evidence)
    if measured := _measured(evidence):
        yield tr("measured"), measured
    if "log_begin_ns" in evidence and "course" in evidence:
        times = Times(evidence.get("begin_s", 0.0), evidence["log_begin_ns"], None)
        yield tr("when"), when(evidence, times, interval=True)
    yield from _words(evidence)
    first, last = evidence.get("first_cycle"), evidence.get("last_cycle")
    if first is not None:
        cycles = f"{first}" if first == last else tr("{a} to {b}", a=first, b=last)
        yield tr("cycles"), cycles


def _words(evidence: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """The sentence of the evidence; in other languages only if nothing else says the same."""
    sentence = str(evidence.get("words", ""))
    text = retold(sentence)
    if text != sentence or (sentence and language_code() == ENGLISH.code):
        yield tr("evidence"), text
    elif sentence and not evidence.keys() & {"excess_mbar", "log_begin_ns"}:
        yield tr("evidence (English)"), sentence


def _measured(evidence: Mapping[str, Any]) -> str:
    """Measured and expected value in words; empty if the evidence has no numbers."""
    if "excess_mbar" in evidence:
        phase = spoken(str(evidence.get("phase", "")))
        excess = numeral(evidence["excess_mbar"], "+.1f")
        return tr("{phase}: {excess} mbar from healthy", phase=phase, excess=excess)
    if evidence.get("measured") is None or evidence.get("expected") is None:
        return ""
    sides = {side: number(evidence[side]) for side in ("measured", "expected")}
    unit = NO_DASH.get(evidence.get("unit", ""), f" {evidence.get('unit', '')}")
    return tr("{measured}{unit}, expected {expected}{unit}", unit=unit, **sides)


def _size(parameter: Mapping[str, Any]) -> str:
    low, high = ends(parameter["low95"], parameter["high95"])
    value = f"{number(parameter['value'])} {parameter['unit']}"
    return tr("{value} (95 %: {low} to {high})", value=value, low=low, high=high)


def _sureness(evidence: Mapping[str, Any]) -> Iterable[str]:
    """The certainty of the cause: from the diagnosis, else from the first guess."""
    if evidence.get("commissioned") is False:
        yield tr(NOT_COMMISSIONED)
    elif "probability" in evidence:
        yield tr("diagnosed: {certainty}", certainty=certainty(evidence))
    elif "guess" in evidence:
        effects = str(evidence.get("also", "")).split(",")
        names = [spoken(effect) for effect in effects if effect]
        if names:
            rest = ", ".join(names)
            yield tr("a first guess, or {alike}; the diagnosis needs some more cycles", alike=rest)
        else:
            yield tr("a first guess; the diagnosis needs some more cycles")
    elif "measured" in evidence:
        yield tr("measured")
