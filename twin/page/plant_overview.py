"""All ejectors that publish to one broker, as far as it has told: in memory, and bounded.

What comes from a broker may be anything. A message that is not understood is counted and left; one
ejector is what stands on its own topics, whatever its messages say of themselves.
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
from twin.figures.table import FIGURES
from twin.notifications.data import CYCLE, CYCLE_FORMAT, VALUES, VALUES_FORMAT
from twin.notifications.message import ALARM_FORMAT, STATUS_FORMAT
from twin.notifications.sender import ALARM

STATUS = "status"
MOST = 2000  # ejectors
MOST_ALARMS = 200  # of an ejector
MOST_CYCLES = 1000  # of an ejector, the newest
MOST_ROWS = 600  # of values, the newest
MOST_BYTES = 65_536  # of a message
MOST_IDS = 100  # by which one that comes again is known
COLUMNS = [f"{name}_{side}" for name in FIGURES for side in SIDES]
NOT_UNDERSTOOD = (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError)

Document = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Row:
    """Vacuum of one period in mbar; None where there was none."""

    time: float  # Unix seconds
    low: float | None
    mean: float | None
    high: float | None
    expected: float | None


@dataclass
class Heard:
    """What one ejector has told. Times are Unix seconds."""

    unit: Unit
    status: str = ""  # online, offline, or nothing yet
    since: float | None = None  # None: it died, and nobody knows when
    seen: float = 0.0  # when anything was last heard of it
    told: float = 0.0  # when values last came
    every_s: float = 0.0  # between messages with values
    batch: str = ""
    program: str = ""
    alarms: dict[str, Document] = field(default_factory=dict)
    rows: deque[Row] = field(default_factory=lambda: deque(maxlen=MOST_ROWS))
    cycles: deque[tuple[float, int, "array[float]"]] = field(
        default_factory=lambda: deque(maxlen=MOST_CYCLES)
    )
    _ids: deque[str] = field(default_factory=lambda: deque(maxlen=MOST_IDS))

    def is_new(self, document: Document) -> bool:
        """Whether a message has not come before: each comes at least once."""
        number = str(document["id"])
        if number in self._ids:
            return False
        self._ids.append(number)
        return True


class PlantOverview:
    """What the broker has told of all ejectors; one thread tells, others look. ``clock`` is Unix
    seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self.clock = clock
        self._lock = threading.Lock()
        self._heard: dict[Unit, Heard] = {}
        self._trouble, self._since = "not connected yet", clock()
        self.not_understood = 0  # messages

    # --- who tells ------------------------------------------------------------------------------

    def connected(self) -> None:
        """The broker is there."""
        with self._lock:
            self._trouble, self._since = "", self.clock()

    def lost(self, why: str) -> None:
        """The broker is not there: nothing is known of now."""
        with self._lock:
            self._since = self._since if self._trouble else self.clock()
            self._trouble = why

    def take(self, levels: list[str], payload: bytes, *, kept: bool) -> None:
        """Take a message by the levels of its topic below the prefix; ``kept`` by the broker is
        one from before.
        """
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
        json.dumps(document, ensure_ascii=False).encode()  # half a character ends here
        taken = {STATUS: _status, ALARM: _alarm, CYCLE: _cycle, VALUES: _values}[topic]
        heard = self._heard.get(unit) or Heard(unit)
        at = taken(heard, document)
        now = self.clock()
        heard.seen = max(heard.seen, min(at, now)) if kept else now
        if topic == VALUES:
            heard.told = heard.seen
        if unit in self._heard or len(self._heard) < MOST:
            self._heard[unit] = heard

    def _forget(self, unit: Unit, levels: list[str]) -> None:
        """The broker was told to keep nothing on a topic any more."""
        if levels == [STATUS]:
            self._heard.pop(unit, None)
        elif levels[0] == ALARM and unit in self._heard:
            self._heard[unit].alarms.pop(_name(levels[1]), None)

    # --- who looks ------------------------------------------------------------------------------

    def look(self, show: Callable[[list[Heard], str, float], Any]) -> Any:
        """What ``show`` makes of all that was heard, what is wrong with the broker, since when."""
        with self._lock:
            return show(list(self._heard.values()), self._trouble, self._since)


# --- what is understood: each gives when it was told --------------------------------------------


def _status(heard: Heard, document: Document) -> float:
    _require(document, STATUS_FORMAT)
    status = document["status"]
    if status not in ("online", "offline"):
        raise ValueError
    since = None if document["since"] is None else _time(document["since"])
    heard.status, heard.since = status, since
    heard.program = str(document["program"])
    _batch(heard, document)
    return since or 0.0


def _alarm(heard: Heard, document: Document) -> float:
    _require(document, ALARM_FORMAT)
    name, at = str(document["alarm"]), _time(document["time"])
    kept: dict[str, Any] = {key: bool(document[key]) for key in ("active", "acknowledged")}
    kept |= {key: str(document[key]) for key in ("state", "priority")}
    since = None if document["since"] is None else _time(document["since"])
    texts = {key: str(document[key]) for key in ("consequence", "action")}
    evidence = document["evidence"]
    if not isinstance(evidence, Mapping):
        raise TypeError
    if name in heard.alarms or len(heard.alarms) < MOST_ALARMS:
        whole = {"alarm": name, "since": since, **kept, **texts, "evidence": evidence}
        heard.alarms[name] = whole
    return at


def _cycle(heard: Heard, document: Document) -> float:
    _require(document, CYCLE_FORMAT)
    at = int(document["time_ns"]) / 1e9
    values = array("f", (_or_nan(document.get(name)) for name in COLUMNS))
    number = int(document["cycle"])
    if heard.is_new(document):
        heard.cycles.append((at, number, values))
    _batch(heard, document)
    return at


def _values(heard: Heard, document: Document) -> float:
    _require(document, VALUES_FORMAT)
    rows = [_row(one) for one in document["rows"]]
    heard.every_s = float(document["period_s"]) * len(rows)
    if heard.is_new(document):
        heard.rows.extend(rows)
    _batch(heard, document)
    return int(document["time_ns"]) / 1e9


def _row(told: Mapping[str, Any]) -> Row:
    measured, expected = told["measured_mbar"], told["expected_mbar"]
    low, mean, high = (_number(measured[name]) for name in ("low", "mean", "high"))
    return Row(int(told["time_ns"]) / 1e9, low, mean, high, _number(expected["mean"]))


def _require(document: Document, form: str) -> None:
    if document["format"] != form:
        raise ValueError


def _batch(heard: Heard, document: Document) -> None:
    heard.batch = str(document["asset"].get("batch", ""))


def _name(level: str) -> str:
    """As it was before it became a level of a topic."""
    return "" if level == "-" else unquote(level)


def _time(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _number(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _or_nan(value: Any) -> float:
    return math.nan if value is None else float(value)
