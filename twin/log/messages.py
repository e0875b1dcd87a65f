"""Rows and events as small messages that other tools can draw; and events decoded again."""

import json
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.events import Event, Kind, Severity
from twin.files import json_text, utf8
from twin.log.schema import EVENTS, LOG, SCALARS
from twin.signals import BAR, MBAR, Command, Samples, Ticks, deviation

SCALAR_NS = 20_000_000  # 50 Hz

_SECOND = 1_000_000_000  # ns
_LEVEL = {Severity.INFO: 2, Severity.WARNING: 3, Severity.ALARM: 4}  # as foxglove.Log has them

# Every field of a message of /scalars is written in a fixed length, zeros too. So messages are rows
# of an array. Maps a name to protobuf's wire type and the field's type in the array.
_VARINT, _FIXED64, _BYTES = 0, 1, 2
_SECONDS, _NANOS, _PHASE = 10, 5, 2  # bytes; times before 1970 need all bytes of the seconds
_FORMS: dict[str, tuple[int, Any]] = {
    "timestamp": (_BYTES, "u1"),  # the length of the two fields that follow, which form it
    "seconds": (_VARINT, ("u1", _SECONDS)),
    "nanos": (_VARINT, ("u1", _NANOS)),
    "vacuum_mbar": (_FIXED64, "<f8"),
    "expected_vacuum_mbar": (_FIXED64, "<f8"),
    "deviation_mbar": (_FIXED64, "<f8"),
    "supply_bar": (_FIXED64, "<f8"),
    "suction": (_VARINT, "u1"),
    "blow_off": (_VARINT, "u1"),
    "phase": (_VARINT, ("u1", _PHASE)),
}


def _stamp(message: Any, time_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, _SECOND)


def _blank() -> npt.NDArray[np.void]:
    """One array element laid out as protobuf's ``ejector_twin.Scalars``, with keys filled in."""
    message = SCALARS.message.DESCRIPTOR.fields_by_name
    fields = {**message, **message["timestamp"].message_type.fields_by_name}
    pairs = [((f"{name} key", "u1"), (name, form)) for name, (_, form) in _FORMS.items()]
    blank = np.zeros((), [field for pair in pairs for field in pair])
    for name, (wire_type, _) in _FORMS.items():
        blank[f"{name} key"] = fields[name].number << 3 | wire_type
    blank["timestamp"] = 1 + _SECONDS + 1 + _NANOS
    return blank


def _varint(numbers: npt.NDArray[np.integer], length: int) -> npt.NDArray[np.uint8]:
    """Varints of ``length`` bytes each, shape (n, length); the longest number must fit.

    Each byte holds seven bits, the lowest first. Protobuf allows longer varints than needed.
    """
    bits = numbers.astype(np.int64).view(np.uint64)[:, np.newaxis]
    digits = (bits >> (7 * np.arange(length, dtype=np.uint64)) & 0x7F).astype(np.uint8)
    digits[:, :-1] |= 0x80  # more to come
    return digits


_BLANK = _blank()


class Scalars:
    """Picks rows of the stream and makes messages of them. How the stream is cut has no effect."""

    def __init__(self, ambient: float) -> None:
        self._ambient = ambient  # Pa
        self._before = [-1, -1, -1]  # time slot, commands and phase of the row before

    def pick(self, samples: Samples, ticks: Ticks) -> npt.NDArray[np.bool_]:
        """A mask of n > 0 rows: one row in 20 ms, and each change of a command or the phase."""
        columns = samples["time_ns"] // SCALAR_NS, samples["commands"], ticks["phase"]
        picked = np.zeros(len(samples), np.bool_)
        for column, previous in zip(columns, self._before, strict=True):
            picked[0] |= int(column[0]) != previous
            picked[1:] |= column[1:] != column[:-1]
        self._before = [int(column[-1]) for column in columns]
        return picked

    def messages(
        self, samples: Samples, ticks: Ticks
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.void]]:
        """Receipt and PLC time in ns, and the message, of each row picked from n > 0 rows."""
        rows = np.flatnonzero(self.pick(samples, ticks))
        # ``take`` and ``repeat`` are fast; indexing and filling go through rows field by field.
        samples, ticks = samples.take(rows), ticks.take(rows)
        messages = np.repeat(_BLANK, len(rows))
        seconds, nanos = np.divmod(samples["time_ns"], _SECOND)
        messages["seconds"] = _varint(seconds, _SECONDS)
        messages["nanos"] = _varint(nanos, _NANOS)
        with np.errstate(invalid="ignore"):  # a NaN may be of the kind that signals
            messages["vacuum_mbar"] = (self._ambient - samples["pressure"].astype(float)) / MBAR
            expected = ticks["expected"].astype(float)
            messages["expected_vacuum_mbar"] = (self._ambient - expected) / MBAR
            messages["deviation_mbar"] = deviation(samples, ticks) / MBAR
            messages["supply_bar"] = samples["supply"].astype(float) / BAR
        messages["suction"] = (samples["commands"] & Command.SUCTION) != 0
        messages["blow_off"] = (samples["commands"] & Command.BLOW_OFF) != 0
        messages["phase"] = _varint(ticks["phase"], _PHASE)
        return samples["host_ns"], samples["time_ns"], messages


def encode_event(event: Event) -> bytes:
    """Serialise as ``ejector_twin.Event``; a note replaces each value that JSON cannot hold."""
    message = EVENTS.message(
        kind=event.kind.value,
        severity=event.severity.value,
        text=utf8(event.text),
        data_json=json_text(event.data),
    )
    _stamp(message, event.time_ns)
    packed: bytes = message.SerializeToString()
    return packed


def decode_event(packed: bytes | memoryview) -> Event:
    """Reverse ``encode_event``; ValueError for an unknown kind."""
    message = EVENTS.message.FromString(packed)
    time_ns = message.timestamp.seconds * _SECOND + message.timestamp.nanos
    return Event(time_ns, Kind(message.kind), message.text, json.loads(message.data_json))


def encode_log(event: Event) -> bytes:
    """Serialise as ``foxglove.Log``, for log panels."""
    level = _LEVEL[event.severity]
    message = LOG.message(level=level, message=utf8(event.text), name=event.kind.value)
    _stamp(message, event.time_ns)
    packed: bytes = message.SerializeToString()
    return packed
