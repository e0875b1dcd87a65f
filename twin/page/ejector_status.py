"""The traffic light of an ejector, and its alarms as a technician reads them.

Plain dictionaries, as they go to the browser: times are Unix seconds by the clock here.
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Any

from twin.alarms.board import Board, Comment, Episode
from twin.alarms.causes import UNLISTED, cause_of
from twin.alarms.requests import Request
from twin.alarms.rules import Priority, Rule
from twin.alarms.state import Alarm, State
from twin.alarms.text import action_of
from twin.diagnosis.text import certainty, ends, number, spoken
from twin.figures.text import NO_DASH
from twin.instants import instant, lasting
from twin.language import is_english, tr
from twin.model.effects import EFFECTS, UNKNOWN
from twin.monitor.healthy import NOT_COMMISSIONED

S_NS = 1_000_000_000
_STANDING = (State.UNACKNOWLEDGED, State.ACKNOWLEDGED, State.RETURNED)
_PRIORITIES = (Priority.HIGH, Priority.MEDIUM, Priority.LOW)
WITHOUT = {  # causes that are no effect
    UNLISTED: "Something that no listed cause explains",
    UNKNOWN: "Something has changed; its cause is not known yet",
}
_SPELT = {"plc": "PLC", "h1": "H1", "h2": "H2"}
_URGENT = (Priority.HIGH, Priority.MEDIUM)
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
    """What a person sees from afar."""

    RED = "red"  # somebody is to act, and nobody has said that he does
    YELLOW = "yellow"  # something stands, or is kept quiet
    GREEN = "green"  # it runs, and nothing stands
    GREY = "grey"  # nothing is known of it now


WORDS = {
    Light.RED: "Alarm",
    Light.YELLOW: "Look after it",
    Light.GREEN: "All right",
    Light.GREY: "Not running",
}


WORST_FIRST = (Light.RED, Light.GREY, Light.YELLOW, Light.GREEN)


def rank(state: str, priority: str) -> tuple[int, int]:
    """Where an alarm stands in a list, the worst first: active and unacknowledged, most urgent."""
    first = _STANDING.index(State(state)) if state in _STANDING else len(_STANDING)
    known = priority in _PRIORITIES
    return first, _PRIORITIES.index(Priority(priority)) if known else len(_PRIORITIES)


def light_of(board: Board, *, running: bool) -> Light:
    """The traffic light: never green while an alarm is active, however quiet it is kept."""
    if not running:
        return Light.GREY
    alarms = board.alarms.values()
    if any(one.state is State.UNACKNOWLEDGED and one.rule.priority in _URGENT for one in alarms):
        return Light.RED
    if any(one.concerns or one.state is State.OUT_OF_SERVICE for one in alarms):
        return Light.YELLOW
    return Light.GREEN


def listed(
    board: Board,
    episodes: Iterable[Episode],
    waiting: Sequence[Request],
    now_ns: int,
    comments: Sequence[Comment] = (),
) -> list[dict[str, Any]]:
    """What a person is to look at, what is active and the most urgent first; then what is quiet."""
    by_name = {one.alarm: one for one in episodes}
    shown = [*board.standing(), *board.quiet()]
    shown.sort(key=lambda one: rank(one.state, one.rule.priority))
    return [
        _alarm(one, waiting, now_ns)
        | _episode(by_name.get(one.rule.name), one.rule, now_ns, comments)
        for one in shown
    ]


def _episode(
    episode: Episode | None, rule: Rule, now_ns: int, comments: Sequence[Comment]
) -> dict[str, Any]:
    """What is known of the time that an alarm is active; its name where it is not."""
    action = {"action": action_of(rule, episode.evidence if episode else {})}
    if episode is None:
        return action | named(rule.name, rule.value) | {"comments": [], "facts": []}
    return action | told(episode, rule.value, now_ns, comments)


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
        "quiet_until": said(until, now_ns),
        "consequence": tr(rule.consequence),
        "asked": [_asked(one) for one in waiting if one.alarm == rule.name],
    }


def state_words(state: str) -> str:
    """A state for people; one that another program has made up stays as it is."""
    return tr(STATES[State(state)]) if state in STATES else state


def priority_words(priority: str) -> str:
    """A priority for people; one that another program has made up stays as it is."""
    return tr(PRIORITIES[Priority(priority)]) if priority in PRIORITIES else priority


def _asked(request: Request) -> dict[str, Any]:
    return {"deed": request.deed.value, "who": request.who, "at": request.asked_ns / S_NS}


def said(ns: int | None, now_ns: int) -> str:
    """An instant in words; empty for what has not happened."""
    return "" if ns is None else instant(ns, now_ns)


def told(
    episode: Episode, value: str, now_ns: int, comments: Sequence[Comment] = ()
) -> dict[str, Any]:
    """One time that an alarm was active: what, since when, what speaks for it and how sure.

    ``times`` has its instants in words, as they are now.
    """
    raised, cleared, seen = episode.raised_ns, episode.cleared_ns, episode.acknowledged_ns
    return {
        **named(episode.alarm, value, episode.evidence.get("taken_in")),
        "raised": raised / S_NS,
        "cleared": cleared and cleared / S_NS,
        "seen": seen and seen / S_NS,
        "times": {
            "raised": said(raised, now_ns),
            "cleared": said(cleared, now_ns),
            "seen": said(seen, now_ns),
            "lasted": "" if cleared is None else lasting((cleared - raised) / S_NS),
        },
        "seen_by": episode.acknowledged_by,
        "facts": [[name, text] for name, text in facts(episode.evidence)],
        "report": episode.evidence.get("report", ""),
        "episode": [episode.raised_as, str(raised)],  # a browser's numbers are too short for ns
        "comments": [
            {"who": one.who, "when": said(one.written_ns, now_ns), "text": one.text}
            for one in comments
            if one.is_of(episode)
        ],
    }


def named(alarm: str, value: str, known: Mapping[str, str] | None = None) -> dict[str, Any]:
    """What it is, and where to look, as people say it; ``known`` says it of an effect taken in."""
    if known:
        what, where = _title(spoken(known["name"])), known["look_at"].partition(":")[0]
        return {"what": what, "sentence": f"{known['sentence']}.", "where": where}
    cause = cause_of(value)
    if cause in EFFECTS:
        return {
            "what": _title(tr(spoken(cause))),
            "sentence": f"{tr(EFFECTS[cause].sentence)}.",
            "where": tr(EFFECTS[cause].look_at).partition(":")[0],
        }
    title = tr(WITHOUT[cause] if cause in WITHOUT else spelt(alarm))
    return {"what": _title(title), "sentence": "", "where": ""}


def spelt(alarm: str) -> str:
    """The name of an alarm that has no cause, in words."""
    return " ".join(_SPELT.get(word, word) for word in spoken(alarm).split())


def _title(words: str) -> str:
    return words[:1].upper() + words[1:]


def facts(evidence: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """What speaks for it, a name and a text each."""
    sizes = evidence.get("parameters", {}).values()
    if sizes:
        yield tr("size"), "; ".join(_size(one) for one in sizes)
    yield from ((tr("how sure"), text) for text in _sureness(evidence))
    if measured := _measured(evidence):
        yield tr("measured"), measured
    if "words" in evidence:
        yield tr("evidence") if is_english() else tr("evidence (English)"), str(evidence["words"])
    first, last = evidence.get("first_cycle"), evidence.get("last_cycle")
    if first is not None:
        cycles = f"{first}" if first == last else tr("{a} to {b}", a=first, b=last)
        yield tr("cycles"), cycles


def _measured(evidence: Mapping[str, Any]) -> str:
    """What was measured and what was expected of it; empty where nobody kept numbers."""
    if "excess_mbar" in evidence:
        phase = str(evidence.get("phase", "")).replace("_", "-")
        excess = f"{evidence['excess_mbar']:+.1f}"
        return tr("{phase}: {excess} mbar from healthy", phase=tr(phase), excess=excess)
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
    """How sure the cause is: by the diagnosis, or else by the first guess."""
    if evidence.get("commissioned") is False:
        yield tr(NOT_COMMISSIONED)
    elif "probability" in evidence:
        yield tr("diagnosed: {certainty}", certainty=certainty(evidence))
    elif "guess" in evidence:
        also = [tr(spoken(one)) for one in str(evidence.get("also", "")).split(",") if one]
        if also:
            alike = ", ".join(also)
            yield tr("a first guess, or {alike}; the diagnosis needs some more cycles", alike=alike)
        else:
            yield tr("a first guess; the diagnosis needs some more cycles")
    elif "measured" in evidence:
        yield tr("measured")
