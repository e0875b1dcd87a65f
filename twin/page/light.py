"""The traffic light of an ejector, and its alarms as a technician reads them.

Plain dictionaries, as they go to the browser: times are Unix seconds by the clock here.
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Any

from twin.alarms.board import Board, Episode
from twin.alarms.causes import CAUSES, UNLISTED, value_of
from twin.alarms.requests import Request
from twin.alarms.rules import Priority
from twin.alarms.state import Alarm, State
from twin.alarms.words import STATES, action_of
from twin.diagnosis.words import certainty, ends, number, spoken
from twin.instants import instant, lasting
from twin.model.effects import EFFECTS, UNKNOWN
from twin.monitor.healthy import NOT_COMMISSIONED

S_NS = 1_000_000_000
_CAUSE_OF = {value_of(cause): cause for cause in CAUSES}
_STANDING = (State.UNACKNOWLEDGED, State.ACKNOWLEDGED, State.RETURNED)
_WITHOUT = {  # causes that are no effect
    UNLISTED: "Something that no listed cause explains",
    UNKNOWN: "Something has changed; its cause is not known yet",
}
_SPELT = {"plc": "PLC", "h1": "H1", "h2": "H2"}
_URGENT = (Priority.HIGH, Priority.MEDIUM)


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
    board: Board, episodes: Iterable[Episode], waiting: Sequence[Request], now_ns: int
) -> list[dict[str, Any]]:
    """What a person is to look at, what is active and the most urgent first; then what is quiet."""
    by_name = {one.alarm: one for one in episodes}
    standing = sorted(board.standing(), key=lambda one: _STANDING.index(one.state))
    shown = [*standing, *board.quiet()]
    return [_alarm(one, by_name.get(one.rule.name), waiting, now_ns) for one in shown]


def _alarm(
    alarm: Alarm, episode: Episode | None, waiting: Sequence[Request], now_ns: int
) -> dict[str, Any]:
    rule = alarm.rule
    until = alarm.shelved_until
    return {
        "alarm": rule.name,
        "state": alarm.state.value,
        "state_words": STATES[alarm.state].replace("`suppressed_by`", "those that explain it"),
        "active": alarm.active,
        "acknowledged": alarm.acknowledged,
        "priority": rule.priority.value,
        "longest_shelving_s": rule.longest_shelving_s,
        "shelved_until": until and until / S_NS,
        "quiet_until": said(until, now_ns),
        "consequence": rule.consequence,
        "action": action_of(rule, episode.evidence if episode else {}),
        "asked": [_asked(one) for one in waiting if one.alarm == rule.name],
        **(told(episode, rule.value, now_ns) if episode else named(rule.name, rule.value)),
    }


def _asked(request: Request) -> dict[str, Any]:
    return {"deed": request.deed.value, "who": request.who, "at": request.asked_ns / S_NS}


def said(ns: int | None, now_ns: int) -> str:
    """An instant in words; empty for what has not happened."""
    return "" if ns is None else instant(ns, now_ns)


def told(episode: Episode, value: str, now_ns: int) -> dict[str, Any]:
    """One time that an alarm was active: what, since when, what speaks for it and how sure.

    ``times`` has its instants in words, as they are now.
    """
    raised, cleared, seen = episode.raised_ns, episode.cleared_ns, episode.acknowledged_ns
    return {
        **named(episode.alarm, value),
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
    }


def named(alarm: str, value: str) -> dict[str, Any]:
    """What it is, and where to look, as people say it."""
    cause = _CAUSE_OF.get(value, "")
    if cause in EFFECTS:
        return {
            "what": spoken(cause).capitalize(),
            "sentence": f"{EFFECTS[cause].sentence}.",
            "where": EFFECTS[cause].look_at.partition(":")[0],
        }
    words = " ".join(_SPELT.get(word, word) for word in spoken(alarm).split())
    title = _WITHOUT.get(cause, words)
    return {"what": title[:1].upper() + title[1:], "sentence": "", "where": ""}


def facts(evidence: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """What speaks for it, a name and a text each."""
    sizes = evidence.get("parameters", {}).values()
    if sizes:
        yield "size", "; ".join(_size(one) for one in sizes)
    yield from _sureness(evidence)
    if "words" in evidence:
        yield "evidence", str(evidence["words"])
    first, last = evidence.get("first_cycle"), evidence.get("last_cycle")
    if first is not None:
        yield "cycles", f"{first}" if first == last else f"{first} to {last}"


def _size(parameter: Mapping[str, Any]) -> str:
    low, high = ends(parameter["low95"], parameter["high95"])
    return f"{number(parameter['value'])} {parameter['unit']} (95 %: {low} to {high})"


def _sureness(evidence: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """How sure the cause is: by the diagnosis, or else by the first guess."""
    if evidence.get("commissioned") is False:
        yield "how sure", NOT_COMMISSIONED
    elif "probability" in evidence:
        yield "how sure", f"diagnosed: {certainty(evidence)}"
    elif "guess" in evidence:
        also = ", ".join(spoken(one) for one in str(evidence.get("also", "")).split(",") if one)
        sure = "a first guess" + (f"; it may as well be {also}" if also else "")
        yield "how sure", f"{sure}; the diagnosis needs some more cycles"
    elif "measured" in evidence:
        yield "how sure", "measured"
