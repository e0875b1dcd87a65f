"""The values that alarms watch, and their evidence, made from the loop's events."""

from collections.abc import Mapping
from typing import Any

from twin.alarms.causes import CAUSES, DEVIATION, catalogue_evidence, cause_or_unlisted, value_of
from twin.events import Event, Kind
from twin.figures.key_figures import FIGURES, NO_DASH
from twin.figures.warnings import CAUTIONS
from twin.model.effects import UNKNOWN

Evidence = Mapping[str, Any]  # a JSON document; "words" is for people

_SWITCHED = {  # events that begin and end something
    Kind.PLC_STALE: ("plc_stale", 1.0),
    Kind.PLC_BACK: ("plc_stale", 0.0),
    Kind.SIGNAL_BAD: ("signal_bad", 1.0),
    Kind.SIGNAL_GOOD: ("signal_bad", 0.0),
    Kind.SIGNAL_CONTRADICTS: ("signal_contradicts", 1.0),
    Kind.SIGNAL_AGREES: ("signal_contradicts", 0.0),
    Kind.OUTPUT_DOWN: ("output_down", 1.0),
    Kind.OUTPUT_BACK: ("output_down", 0.0),
}
STREAM = frozenset(name for name, _ in _SWITCHED.values())  # 0 until an event says otherwise
NAMES = STREAM | {DEVIATION} | set(CAUTIONS)
_MEASURE = ("figure", "phase", "excess_mbar", "sigma", "size", "unit", "also", "commissioned")


def values(event: Event) -> dict[str, float]:
    """The values that an event sets to 1 or 0, by the names of NAMES; deviation by cause.

    A warning that a cycle could not judge keeps its value.
    """
    if event.kind in _SWITCHED:
        name, value = _SWITCHED[event.kind]
        return {name: 1.0 if event.data.get("standing") else value}  # another fault may still stand
    if event.kind is Kind.DEVIATION:
        return deviating(cause_or_unlisted(str(event.data.get("effect"))))
    if event.kind is Kind.DEVIATION_CLEARED:
        return deviating()
    if event.kind is not Kind.CYCLE or "warnings" not in event.data:
        return {}
    standing = event.data["warnings"]
    return {
        name: float(name in standing)
        for name, caution in CAUTIONS.items()
        if f"{caution.figure}_measured" in event.data
    }


def deviating(*causes: str) -> dict[str, float]:
    """The values while the deviation has these causes, and no other."""
    return {value_of(cause): float(cause in causes) for cause in CAUSES}


def quantity(value: str) -> str | None:
    """The quantity that a value compares with its expectation: pressure, a key figure or None."""
    if value == DEVIATION or value.startswith(f"{DEVIATION}."):
        return "pressure"
    return CAUTIONS[value].figure if value in CAUTIONS else None


def evidence(event: Event) -> dict[str, Evidence]:
    """The evidence in an event, by the value that it supports."""
    if event.kind in _SWITCHED and _SWITCHED[event.kind][1]:
        return {_SWITCHED[event.kind][0]: {"words": event.text}}
    if event.kind is Kind.DEVIATION:
        effect = str(event.data.get("effect"))
        cause = cause_or_unlisted(effect)
        measured = {key: event.data[key] for key in _MEASURE if key in event.data}
        first_guess = {} if cause == UNKNOWN else {"guess": cause}
        entry = {
            "words": event.text,
            **first_guess,
            **measured,
            **catalogue_evidence(effect),
            **_in(event),
        }
        return {value_of(cause): entry}
    if event.kind is Kind.CYCLE:
        standing = event.data.get("warnings", ())
        return {name: _figure(name, event) for name in standing}
    return {}


def _figure(warning: str, event: Event) -> Evidence:
    """Measured and expected value of a cycle's figure, with the text of its warning."""
    name = CAUTIONS[warning].figure
    measured, expected = (event.data.get(f"{name}_{side}") for side in ("measured", "expected"))
    unit, words = FIGURES[name].unit, str(event.data.get("warned", {}).get(warning, warning))
    if expected is not None and unit not in NO_DASH:
        words += f"; expected {expected:.4g} {unit}"
    sizes = {"figure": name, "measured": measured, "expected": expected, "unit": unit}
    return {"words": words, **sizes, **_in(event)}


def _in(event: Event) -> Evidence:
    """The event's cycle as the first and last one; empty if it has none."""
    number = event.data.get("cycle")
    return {} if number is None else {"first_cycle": int(number), "last_cycle": int(number)}
