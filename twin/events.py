"""The twin's events: one record type, and one table of kinds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class Severity(StrEnum):
    """How much an event matters to a person."""

    INFO = "info"
    WARNING = "warning"
    ALARM = "alarm"


class Kind(StrEnum):
    """The kinds of events. The value is the name in logs; SEVERITY says how much each matters."""

    GAP = "gap"
    PLC_RESTARTED = "plc_restarted"
    CLOCK_JUMPED = "clock_jumped"
    CLOCK = "clock"
    PLC_LOST = "plc_lost"
    PLC_STALE = "plc_stale"
    PLC_BACK = "plc_back"
    TWIN_LATE = "twin_late"
    NO_MODEL = "no_model"
    RESULTS_DOWN = "results_down"
    OUTPUT_DOWN = "output_down"
    OUTPUT_BACK = "output_back"
    LOG_DELETED = "log_deleted"
    SIGNAL_BAD = "signal_bad"
    SIGNAL_GOOD = "signal_good"
    SIGNAL_CONTRADICTS = "signal_contradicts"
    SIGNAL_AGREES = "signal_agrees"
    CYCLE = "cycle"
    DEVIATION = "deviation"
    DEVIATION_CLEARED = "deviation_cleared"
    DIAGNOSIS = "diagnosis"
    ALARM = "alarm"
    ALARM_CHANGED = "alarm_changed"
    LIMIT_CHANGED = "limit_changed"


SEVERITY: dict[Kind, Severity] = {
    Kind.GAP: Severity.WARNING,
    Kind.PLC_RESTARTED: Severity.WARNING,
    Kind.CLOCK_JUMPED: Severity.WARNING,
    Kind.CLOCK: Severity.INFO,
    Kind.PLC_LOST: Severity.WARNING,  # why there are no rows; PLC_STALE follows if that lasts
    Kind.PLC_STALE: Severity.ALARM,
    Kind.PLC_BACK: Severity.INFO,
    Kind.TWIN_LATE: Severity.WARNING,
    Kind.NO_MODEL: Severity.WARNING,  # rows were logged before it was compiled
    Kind.RESULTS_DOWN: Severity.WARNING,
    Kind.OUTPUT_DOWN: Severity.WARNING,  # a log, a console, a view
    Kind.OUTPUT_BACK: Severity.INFO,
    Kind.LOG_DELETED: Severity.INFO,  # to make room, as [log] says
    Kind.SIGNAL_BAD: Severity.WARNING,
    Kind.SIGNAL_GOOD: Severity.INFO,
    Kind.SIGNAL_CONTRADICTS: Severity.WARNING,  # a reported signal contradicts the pressure
    Kind.SIGNAL_AGREES: Severity.INFO,
    Kind.CYCLE: Severity.INFO,
    Kind.DEVIATION: Severity.ALARM,
    Kind.DEVIATION_CLEARED: Severity.INFO,
    Kind.DIAGNOSIS: Severity.WARNING,  # the alarm has been raised already; this says why
    Kind.ALARM: Severity.WARNING,  # notifies people; its trigger has its own severity
    Kind.ALARM_CHANGED: Severity.INFO,  # cleared, acknowledged, shelved and so on
    Kind.LIMIT_CHANGED: Severity.INFO,  # by a person, who and why are said
}


@dataclass(frozen=True, slots=True)
class Event:
    """One event, in PLC time, with its numbers in the field's units.

    ``data`` is valid JSON: numbers and texts, and for a diagnosis the whole answer.
    """

    time_ns: int
    kind: Kind
    text: str
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def severity(self) -> Severity:
        """The severity of its kind."""
        return SEVERITY[self.kind]
