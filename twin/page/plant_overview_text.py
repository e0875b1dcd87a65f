"""All ejectors as people read them: the traffic light of each, the worst first, and one by itself.

Plain dictionaries, as they go to the browser: times are Unix seconds by the clock here.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from twin.alarms.causes import CAUSES, DEVIATION, value_of
from twin.alarms.rules import Priority, by_cause, default_rules
from twin.alarms.state import State
from twin.alarms.text import action_of
from twin.assets.unit import Unit
from twin.figures.database import SIDES
from twin.figures.table import FIGURES
from twin.figures.text import title_of
from twin.instants import SECOND_NS, instant, lasting, zone
from twin.language import speaking, tr
from twin.page.ejector import figure_words
from twin.page.ejector_status import (
    WORST_FIRST,
    Light,
    facts,
    named,
    priority_words,
    rank,
    state_words,
)
from twin.page.plant_overview import COLUMNS, NOT_UNDERSTOOD, Document, Heard, Row

KEY_FIGURES = ("t0", "leakage", "air")  # that stand in the table
SPARK_POINTS = 60
SPARK_ROWS = 300
SILENT_S = 15.0  # longer than three messages with values take
BEHIND_S = 60.0  # values that come late are said to
WORDS = {
    Light.RED: "Alarm",
    Light.YELLOW: "Look after it",
    Light.GREEN: "All right",
    Light.GREY: "Offline",
}
_RULES = {rule.name: rule for rule in by_cause(default_rules())}
SILENT, NOT_KNOWN = "Silent", "Not known"


def overview(heard: Sequence[Heard], trouble: str, since: float, now: float) -> dict[str, Any]:
    """Every ejector in a line, the worst first; without a broker nothing is known of any."""
    lines = [_line(one, now, trouble) for one in heard]
    order = [light.value for light in WORST_FIRST]
    lines.sort(key=lambda one: (order.index(one["light"]), one["since"] or 0.0, one["name"]))
    told = {"now": now, "zone": zone(_ns(now)), "trouble": trouble, "ejectors": lines}
    return told | {"trouble_since": _said(since, now) if trouble else ""}


def details(heard: Heard, trouble: str, now: float) -> dict[str, Any]:
    """All that is known of one."""
    return {
        **_line(heard, now, trouble),
        "program": heard.program,
        "status": heard.status,
        "alarms": [_card(one, now) for one in _standing(heard)],
        "rows": _columns(heard.rows),
        "trends": _trends(heard),
    }


def _line(heard: Heard, now: float, trouble: str) -> dict[str, Any]:
    light, words, since = _light(heard, now, trouble)
    standing = _standing(heard)
    worst = standing[0] if standing else None
    newest = heard.rows[-1].time if heard.rows else None
    late = newest is not None and heard.status == "online" and now - newest
    return {
        "type": heard.unit.type,
        "id": heard.unit.id,
        "batch": heard.batch,
        "name": heard.unit.id or heard.unit.type,
        "light": light.value,
        "words": tr(words),
        "since": since,
        "times": {
            "since": _said(since, now),
            "seen": _said(heard.seen or None, now),
            "behind": lasting(late) if late and late > max(BEHIND_S, _patience(heard)) else "",
        },
        "what": _title(str(worst["alarm"]))["what"] if worst else _without_alarm(heard, words),
        "alarms_count": len(standing),
        "seen": heard.seen or None,
        "behind": late if late and late > max(BEHIND_S, _patience(heard)) else None,
        "figures": _newest(heard),
        "spark": _spark(list(heard.rows)[-SPARK_ROWS:]),
    }


# --- the light ----------------------------------------------------------------------------------


def _light(heard: Heard, now: float, trouble: str) -> tuple[Light, str, float | None]:
    """Light, words and since when; as on the technician's page, never green while anything is
    unknown.
    """
    standing = _standing(heard)
    if trouble:
        return Light.GREY, NOT_KNOWN, None
    if heard.status != "online":
        return Light.GREY, WORDS[Light.GREY], heard.since or heard.seen
    urgent = [one for one in standing if _is_urgent(one)]
    if urgent:
        return Light.RED, WORDS[Light.RED], urgent[0]["since"]
    if heard.told and now - heard.told > _patience(heard):
        return Light.GREY, SILENT, heard.told
    if standing:
        return Light.YELLOW, WORDS[Light.YELLOW], standing[0]["since"]
    return Light.GREEN, WORDS[Light.GREEN], heard.since


def _without_alarm(heard: Heard, words: str) -> str:
    """What there is to say where no alarm stands."""
    if words == WORDS[Light.GREY]:
        died = heard.status == "offline" and heard.since is None
        gone = tr("stopped") if heard.status else tr("never came")
        return tr("gone without a word") if died else gone
    return tr("no values come") if words == SILENT else "" if words == NOT_KNOWN else tr("no alarm")


def _patience(heard: Heard) -> float:
    """How long values may keep one waiting."""
    return SILENT_S + 3.0 * heard.every_s


def _is_urgent(alarm: Document) -> bool:
    urgent = alarm["priority"] in (Priority.HIGH, Priority.MEDIUM)
    return urgent and alarm["state"] == State.UNACKNOWLEDGED


def _standing(heard: Heard) -> list[Document]:
    """Alarms that are more than normal: not acknowledged and urgent ones first, then the oldest."""
    there = [one for one in heard.alarms.values() if one["active"] or one["state"] != State.NORMAL]
    return sorted(there, key=_rank)


def _rank(alarm: Document) -> tuple[int, int, float]:
    return *rank(alarm["state"], alarm["priority"]), alarm["since"] or 0.0


# --- alarms -------------------------------------------------------------------------------------


def _card(alarm: Document, now: float) -> dict[str, Any]:
    """An alarm as a technician reads it."""
    try:
        known = [[name, text] for name, text in facts(alarm["evidence"])]
    except NOT_UNDERSTOOD:  # another program's
        known = []
    kept = {key: alarm[key] for key in alarm if key != "evidence"}
    kept |= {"state_words": state_words(str(alarm["state"]))}
    kept |= {"priority_words": priority_words(str(alarm["priority"]))}
    kept |= _advice(alarm)
    times = {"times": {"since": _said(alarm["since"], now)}}
    return kept | _title(str(alarm["alarm"])) | {"facts": known} | times


def _advice(alarm: Document) -> dict[str, Any]:
    """What follows and what to do, in the language of who reads it where the rule is ours."""
    rule = _RULES.get(str(alarm["alarm"]))
    said = {key: alarm.get(key, "") for key in ("consequence", "action")}
    with speaking({}):
        published = {"consequence": rule.consequence, "action": action_of(rule, {})} if rule else {}
    if rule is None or said != published:
        return said
    return {"consequence": tr(rule.consequence), "action": action_of(rule, {})}


def _said(seconds: float | None, now: float) -> str:
    """An instant in words; empty where nobody knows it."""
    return "" if seconds is None else instant(_ns(seconds), _ns(now))


def _ns(seconds: float) -> int:
    return round(seconds * SECOND_NS)


def _title(alarm: str) -> dict[str, Any]:
    cause = alarm.removeprefix(f"{DEVIATION}_")
    return named(alarm, value_of(cause) if cause in CAUSES else "")


# --- numbers ------------------------------------------------------------------------------------


def _newest(heard: Heard) -> list[dict[str, Any]]:
    """The key figures of the table, as the newest cycle that knows each has them."""
    found = []
    for name in KEY_FIGURES:
        for _, _, values in reversed(heard.cycles):
            measured, expected = (values[COLUMNS.index(f"{name}_{side}")] for side in SIDES)
            if math.isfinite(measured):
                sides = {"measured": _plain(measured), "expected": _plain(expected)}
                known = {"name": name, "title": title_of(name), "unit": FIGURES[name].unit}
                found.append(known | sides)
                break
    return found


def _trends(heard: Heard) -> list[dict[str, Any]]:
    """Every figure that any cycle knows."""
    made = []
    times = [at for at, _, _ in heard.cycles]
    for name, figure in FIGURES.items():
        sides = {
            side: [_plain(values[COLUMNS.index(f"{name}_{side}")]) for _, _, values in heard.cycles]
            for side in SIDES
        }
        if any(one is not None for one in sides["measured"]):
            made.append({**figure_words(figure), "time": times, **sides})
    return made


def _columns(rows: Iterable[Row]) -> dict[str, list[float | None]]:
    there = list(rows)
    return {name: [getattr(one, name) for one in there] for name in Row.__slots__}


def _spark(rows: Sequence[Row]) -> dict[str, list[float | None]]:
    """Lowest and highest vacuum of a few points in whole mbar."""
    each = max(1, math.ceil(len(rows) / SPARK_POINTS))
    groups = [rows[at : at + each] for at in range(0, len(rows), each)]
    return {
        "low": [_end(min, (one.low for one in group)) for group in groups],
        "high": [_end(max, (one.high for one in group)) for group in groups],
    }


def _end(which: Any, values: Iterable[float | None]) -> float | None:
    there = [one for one in values if one is not None]
    return round(which(there)) if there else None


def _plain(value: float) -> float | None:
    return float(f"{value:.5g}") if math.isfinite(value) else None


def of_one(heard: Sequence[Heard], unit: Unit) -> Heard | None:
    """One of those that were heard."""
    return next((one for one in heard if one.unit == unit), None)


def counted(lines: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """How many have each light."""
    return {light.value: sum(one["light"] == light for one in lines) for light in WORST_FIRST}
