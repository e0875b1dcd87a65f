"""All ejectors that publish to one broker: their last messages, in bounded memory.

A broker may deliver anything. Invalid messages are counted and ignored. An ejector is identified by
its topics, whatever its messages contain.
"""

import json
import math
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any
from urllib.parse import unquote

from twin.assets.unit import Unit
from twin.figures.database import SIDES
from twin.figures.key_figures import FIGURES
from twin.notifications.data import CYCLE, CYCLE_FORMAT, VALUES, VALUES_FORMAT
from twin.notifications.message import ALARM_FORMAT, STATUS_FORMAT
from twin.notifications.sender import ALARM

STATUS = "status"
MOST = 2000  # ejectors
MOST_ALARMS = 200  # of an ejector
MOST_CYCLES = 1000  # of an ejector, the newest
MOST_ROWS = 600  # of values, the newest
MOST_BYTES = 65_536  # of a message
MOST_IDS = 100  # of messages, to recognise repeated ones
COLUMNS = [f"{name}_{side}" for name in FIGURES for side in SIDES]
NOT_UNDERSTOOD = (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError)

Document = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Row:
    """Vacuum of one period in mbar; None without values."""

    time: float  # Unix seconds
    low: float | None
    mean: float | None
    high: float | None
    expected: float | None


@dataclass
class EjectorMessages:
    """The last messages of one ejector. Times are Unix seconds."""

    unit: Unit
    status: str = ""  # online, offline, or empty before the first message
    since: float | None = None  # None if the time of a loss is unknown
    seen: float = 0.0  # time of its last message
    told: float = 0.0  # time of its last message with values
    every_s: float = 0.0  # interval of messages with values
    batch: str = ""
    program: str = ""
    alarms: dict[str, Document] = field(default_factory=dict)
    rows: deque[Row] = field(default_factory=lambda: deque(maxlen=MOST_ROWS))
    cycles: deque[tuple[float, int, "array[float]"]] = field(
        default_factory=lambda: deque(maxlen=MOST_CYCLES)
    )
    _ids: deque[str] = field(default_factory=lambda: deque(maxlen=MOST_IDS))

    def is_new(self, document: Document) -> bool:
        """Whether a message is new: MQTT delivers each at least once."""
        number = str(document["id"])
        if number in self._ids:
            return False
        self._ids.append(number)
        return True


class PlantOverview:
    """The last messages of all ejectors; one thread writes, others read.

    ``clock`` returns Unix seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self.clock = clock
        self._lock = threading.Lock()
        self._ejectors: dict[Unit, EjectorMessages] = {}
        self._failure, self._since = "not connected yet", clock()
        self.not_understood = 0  # number of invalid messages

    # --- writing --------------------------------------------------------------------------------

    def connected(self) -> None:
        """The broker is connected."""
        with self._lock:
            self._failure, self._since = "", self.clock()

    def lost(self, why: str) -> None:
        """The broker is not connected: the present state is unknown."""
        with self._lock:
            self._since = self._since if self._failure else self.clock()
            self._failure = why

    def take(self, levels: list[str], payload: bytes, *, kept: bool) -> None:
        """Take a message by its topic's levels below the prefix; ``kept`` marks a retained one."""
        with self._lock:
            try:
                self._take(levels, payload, kept)
            except NOT_UNDERSTOOD:
                self.not_understood += 1

    def _take(self, levels: list[str], payload: bytes, kept: bool) -> None:
        unit, topic = Unit(_name(levels[0]), _name(levels[1])), levels[2]
        if not payload:
            self._forget(unit, levels[2:])
            return
        if len(payload) > MOST_BYTES:
            raise ValueError
        document = json.loads(payload)
        json.dumps(document, ensure_ascii=False).encode()  # raises for half a character
        handler = {STATUS: _status, ALARM: _alarm, CYCLE: _cycle, VALUES: _values}[topic]
        ejector = self._ejectors.get(unit) or EjectorMessages(unit)
        time = handler(ejector, document)
        now = self.clock()
        ejector.seen = max(ejector.seen, min(time, now)) if kept else now
        if topic == VALUES:
            ejector.told = ejector.seen
        if unit in self._ejectors or len(self._ejectors) < MOST:
            self._ejectors[unit] = ejector

    def _forget(self, unit: Unit, levels: list[str]) -> None:
        """Delete the data of a topic whose retained message was cleared."""
        if levels == [STATUS]:
            self._ejectors.pop(unit, None)
        elif levels[0] == ALARM and unit in self._ejectors:
            self._ejectors[unit].alarms.pop(_name(levels[1]), None)

    # --- reading --------------------------------------------------------------------------------

    def look(self, show: Callable[[list[EjectorMessages], str, float], Any]) -> Any:
        """The result of ``show`` for all ejectors, the broker's failure and since when."""
        with self._lock:
            return show(list(self._ejectors.values()), self._failure, self._since)


# --- message handlers: each returns the time of its message -------------------------------------


def _status(ejector: EjectorMessages, document: Document) -> float:
    _require(document, STATUS_FORMAT)
    status = document["status"]
    if status not in ("online", "offline"):
        raise ValueError
    since = None if document["since"] is None else _time(document["since"])
    ejector.status, ejector.since = status, since
    ejector.program = str(document["program"])
    _batch(ejector, document)
    return since or 0.0


def _alarm(ejector: EjectorMessages, document: Document) -> float:
    _require(document, ALARM_FORMAT)
    name, time = str(document["alarm"]), _time(document["time"])
    fields: dict[str, Any] = {key: bool(document[key]) for key in ("active", "acknowledged")}
    fields |= {key: str(document[key]) for key in ("state", "priority")}
    since = None if document["since"] is None else _time(document["since"])
    texts = {key: str(document[key]) for key in ("consequence", "action")}
    evidence = document["evidence"]
    if not isinstance(evidence, Mapping):
        raise TypeError
    if name in ejector.alarms or len(ejector.alarms) < MOST_ALARMS:
        alarm = {"alarm": name, "since": since, **fields, **texts, "evidence": evidence}
        ejector.alarms[name] = alarm
    return time


def _cycle(ejector: EjectorMessages, document: Document) -> float:
    _require(document, CYCLE_FORMAT)
    time = int(document["time_ns"]) / 1e9
    values = array("f", (_or_nan(document.get(name)) for name in COLUMNS))
    number = int(document["cycle"])
    if ejector.is_new(document):
        ejector.cycles.append((time, number, values))
    _batch(ejector, document)
    return time


def _values(ejector: EjectorMessages, document: Document) -> float:
    _require(document, VALUES_FORMAT)
    rows = [_row(row) for row in document["rows"]]
    ejector.every_s = float(document["period_s"]) * len(rows)
    if ejector.is_new(document):
        ejector.rows.extend(rows)
    _batch(ejector, document)
    return int(document["time_ns"]) / 1e9


def _row(values: Mapping[str, Any]) -> Row:
    measured, expected = values["measured_mbar"], values["expected_mbar"]
    low, mean, high = (_number(measured[name]) for name in ("low", "mean", "high"))
    return Row(int(values["time_ns"]) / 1e9, low, mean, high, _number(expected["mean"]))


def _require(document: Document, expected: str) -> None:
    if document["format"] != expected:
        raise ValueError


def _batch(ejector: EjectorMessages, document: Document) -> None:
    ejector.batch = str(document["asset"].get("batch", ""))


def _name(level: str) -> str:
    """The name that a level of a topic encodes."""
    return "" if level == "-" else unquote(level)


def _time(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _number(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _or_nan(value: Any) -> float:
    return math.nan if value is None else float(value)
