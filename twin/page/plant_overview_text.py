"""All ejectors for people: the status of each, the worst first, and the details of one.

The functions return plain dictionaries for the browser; times are Unix seconds of host time.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from twin.alarms.advice import action_of
from twin.alarms.causes import CAUSES, DEVIATION, value_of
from twin.alarms.rules import Priority, by_cause, default_rules
from twin.alarms.state import State
from twin.assets.unit import Unit
from twin.figures.database import SIDES
from twin.figures.key_figures import FIGURES
from twin.figures.text import title_of
from twin.instants import SECOND_NS, instant, lasting, zone
from twin.languages.texts import ENGLISH, speaking, tr
from twin.page.ejector import figure_labels
from twin.page.ejector_status import (
    WORST_FIRST,
    Light,
    describe_alarm,
    facts,
    priority_words,
    rank,
    state_words,
)
from twin.page.plant_overview import COLUMNS, NOT_UNDERSTOOD, Document, EjectorMessages, Row

KEY_FIGURES = ("t0", "leakage", "air")  # key figures in the table
SPARK_POINTS = 60
SPARK_ROWS = 300
SILENT_S = 15.0  # longer than the interval of three messages with values
BEHIND_S = 60.0  # a delay of values that is reported
WORDS = {
    Light.RED: "Alarm",
    Light.YELLOW: "Look after it",
    Light.GREEN: "All right",
    Light.GREY: "Offline",
}
_RULES = {rule.name: rule for rule in by_cause(default_rules())}
SILENT, NOT_KNOWN = "Silent", "Not known"


def overview(
    ejectors: Sequence[EjectorMessages], failure: str, since: float, now: float
) -> dict[str, Any]:
    """A line for every ejector, the worst first; without a broker all are unknown."""
    lines = [_line(line, now, failure) for line in ejectors]
    order = [light.value for light in WORST_FIRST]
    lines.sort(key=lambda line: (order.index(line["light"]), line["since"] or 0.0, line["name"]))
    document = {"now": now, "zone": zone(_ns(now)), "trouble": failure, "ejectors": lines}
    return document | {"trouble_since": _said(since, now) if failure else ""}


def details(ejector: EjectorMessages, failure: str, now: float) -> dict[str, Any]:
    """All that is known of one ejector."""
    return {
        **_line(ejector, now, failure),
        "program": ejector.program,
        "status": ejector.status,
        "alarms": [_card(alarm, now) for alarm in _standing(ejector)],
        "rows": _columns(ejector.rows),
        "trends": _trends(ejector),
    }


def _line(ejector: EjectorMessages, now: float, failure: str) -> dict[str, Any]:
    light, words, since = _light(ejector, now, failure)
    standing = _standing(ejector)
    worst = standing[0] if standing else None
    newest = ejector.rows[-1].time if ejector.rows else None
    delay_s = newest is not None and ejector.status == "online" and now - newest
    return {
        "type": ejector.unit.type,
        "id": ejector.unit.id,
        "batch": ejector.batch,
        "name": ejector.unit.id or ejector.unit.type,
        "light": light.value,
        "words": tr(words),
        "since": since,
        "times": {
            "since": _said(since, now),
            "seen": _said(ejector.seen or None, now),
            "behind": lasting(delay_s)
            if delay_s and delay_s > max(BEHIND_S, _patience(ejector))
            else "",
        },
        "what": _title(str(worst["alarm"]))["what"] if worst else _without_alarm(ejector, words),
        "alarms_count": len(standing),
        "seen": ejector.seen or None,
        "behind": delay_s if delay_s and delay_s > max(BEHIND_S, _patience(ejector)) else None,
        "figures": _newest(ejector),
        "spark": _spark(list(ejector.rows)[-SPARK_ROWS:]),
    }


# --- the light ----------------------------------------------------------------------------------


def _light(ejector: EjectorMessages, now: float, failure: str) -> tuple[Light, str, float | None]:
    """Status, its text and since when; as on the technician's page, unknown is never green."""
    standing = _standing(ejector)
    if failure:
        return Light.GREY, NOT_KNOWN, None
    if ejector.status != "online":
        return Light.GREY, WORDS[Light.GREY], ejector.since or ejector.seen
    urgent = [alarm for alarm in standing if _is_urgent(alarm)]
    if urgent:
        return Light.RED, WORDS[Light.RED], urgent[0]["since"]
    if ejector.told and now - ejector.told > _patience(ejector):
        return Light.GREY, SILENT, ejector.told
    if standing:
        return Light.YELLOW, WORDS[Light.YELLOW], standing[0]["since"]
    return Light.GREEN, WORDS[Light.GREEN], ejector.since


def _without_alarm(ejector: EjectorMessages, words: str) -> str:
    """The text for an ejector without a standing alarm."""
    if words == WORDS[Light.GREY]:
        died = ejector.status == "offline" and ejector.since is None
        reason = tr("stopped") if ejector.status else tr("never came")
        return tr("connection lost") if died else reason
    return tr("no values come") if words == SILENT else "" if words == NOT_KNOWN else tr("no alarm")


def _patience(ejector: EjectorMessages) -> float:
    """How long (s) values may be missing before the ejector counts as silent."""
    return SILENT_S + 3.0 * ejector.every_s


def _is_urgent(alarm: Document) -> bool:
    urgent = alarm["priority"] in (Priority.HIGH, Priority.MEDIUM)
    return urgent and alarm["state"] == State.UNACKNOWLEDGED


def _standing(ejector: EjectorMessages) -> list[Document]:
    """Alarms beyond normal: unacknowledged and urgent ones first, then the oldest."""
    alarms = [
        alarm
        for alarm in ejector.alarms.values()
        if alarm["active"] or alarm["state"] != State.NORMAL
    ]
    return sorted(alarms, key=_rank)


def _rank(alarm: Document) -> tuple[int, int, float]:
    return *rank(alarm["state"], alarm["priority"]), alarm["since"] or 0.0


# --- alarms -------------------------------------------------------------------------------------


def _card(alarm: Document, now: float) -> dict[str, Any]:
    """An alarm for a technician."""
    try:
        evidence = [[name, text] for name, text in facts(alarm["evidence"])]
    except NOT_UNDERSTOOD:  # another program's
        evidence = []
    shown = {key: alarm[key] for key in alarm if key != "evidence"}
    shown |= {"state_words": state_words(str(alarm["state"]))}
    shown |= {"priority_words": priority_words(str(alarm["priority"]))}
    shown |= _advice(alarm)
    times = {"times": {"since": _said(alarm["since"], now)}}
    return shown | _title(str(alarm["alarm"])) | {"facts": evidence} | times


def _advice(alarm: Document) -> dict[str, Any]:
    """Consequence and action; in the reader's language if the rule is the program's own."""
    rule = _RULES.get(str(alarm["alarm"]))
    advice = {key: alarm.get(key, "") for key in ("consequence", "action")}
    with speaking(ENGLISH):
        published = {"consequence": rule.consequence, "action": action_of(rule, {})} if rule else {}
    if rule is None or advice != published:
        return advice
    return {"consequence": tr(rule.consequence), "action": action_of(rule, {})}


def _said(seconds: float | None, now: float) -> str:
    """An instant in words; empty if unknown."""
    return "" if seconds is None else instant(_ns(seconds), _ns(now))


def _ns(seconds: float) -> int:
    return round(seconds * SECOND_NS)


def _title(alarm: str) -> dict[str, Any]:
    cause = alarm.removeprefix(f"{DEVIATION}_")
    return describe_alarm(alarm, value_of(cause) if cause in CAUSES else "")


# --- numbers ------------------------------------------------------------------------------------


def _newest(ejector: EjectorMessages) -> list[dict[str, Any]]:
    """The table's key figures, each from the newest cycle that has it."""
    figures = []
    for name in KEY_FIGURES:
        for _, _, values in reversed(ejector.cycles):
            measured, expected = (values[COLUMNS.index(f"{name}_{side}")] for side in SIDES)
            if math.isfinite(measured):
                sides = {"measured": _plain(measured), "expected": _plain(expected)}
                labels = {"name": name, "title": title_of(name), "unit": FIGURES[name].unit}
                figures.append(labels | sides)
                break
    return figures


def _trends(ejector: EjectorMessages) -> list[dict[str, Any]]:
    """Every figure that any cycle has, over time."""
    trends = []
    times = [time for time, _, _ in ejector.cycles]
    for name, figure in FIGURES.items():
        sides = {
            side: [
                _plain(values[COLUMNS.index(f"{name}_{side}")]) for _, _, values in ejector.cycles
            ]
            for side in SIDES
        }
        if any(value is not None for value in sides["measured"]):
            trends.append({**figure_labels(figure), "time": times, **sides})
    return trends


def _columns(rows: Iterable[Row]) -> dict[str, list[float | None]]:
    listed = list(rows)
    return {name: [getattr(row, name) for row in listed] for name in Row.__slots__}


def _spark(rows: Sequence[Row]) -> dict[str, list[float | None]]:
    """Lowest and highest vacuum of a few points in whole mbar."""
    stride = max(1, math.ceil(len(rows) / SPARK_POINTS))
    groups = [rows[start : start + stride] for start in range(0, len(rows), stride)]
    return {
        "low": [_end(min, (row.low for row in group)) for group in groups],
        "high": [_end(max, (row.high for row in group)) for group in groups],
    }


def _end(extreme: Any, values: Iterable[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return round(extreme(present)) if present else None


def _plain(value: float) -> float | None:
    return float(f"{value:.5g}") if math.isfinite(value) else None


def of_one(ejectors: Sequence[EjectorMessages], unit: Unit) -> EjectorMessages | None:
    """The ejector of a unit; None if it is unknown."""
    return next((ejector for ejector in ejectors if ejector.unit == unit), None)


def counted(lines: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """The number of ejectors with each status."""
    return {light.value: sum(line["light"] == light for line in lines) for light in WORST_FIRST}
