"""Rows and events as the small messages that other tools draw, and events back."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.events import Event, Kind, Severity
from twin.log.schema import EVENTS, LOG, SCALARS
from twin.signals import BAR, MBAR, Command, Samples, Ticks, deviation

SCALAR_NS = 20_000_000  # 50 Hz

_SECOND = 1_000_000_000  # ns
_LEVEL = {Severity.INFO: 2, Severity.WARNING: 3, Severity.ALARM: 4}  # as foxglove.Log has them


def _stamp(message: Any, time_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, _SECOND)


class Scalars:
    """Picks rows from the stream and makes messages of them, however the stream is cut."""

    def __init__(self, ambient: float) -> None:
        self._ambient = ambient  # Pa
        self._before = np.full((3, 1), -1)  # time slot, commands and phase of the row before

    def pick(self, samples: Samples, ticks: Ticks) -> npt.NDArray[np.bool_]:
        """True for one row in 20 ms, and where a command or the phase changes."""
        slot = samples["time_ns"] // SCALAR_NS
        now = np.stack((slot, samples["commands"], ticks["phase"]))
        before = np.concatenate((self._before, now[:, :-1]), axis=1)
        self._before = now[:, -1:]
        picked: npt.NDArray[np.bool_] = (now != before).any(axis=0)
        return picked

    def messages(self, samples: Samples, ticks: Ticks) -> Iterator[tuple[int, int, bytes]]:
        """Receipt and PLC time in ns, and the message, of each row picked from n > 0 rows."""
        picked = self.pick(samples, ticks)
        columns = self._columns(samples[picked], ticks[picked])
        m = SCALARS.message()  # one for all: making one costs more than filling it
        stamp = m.timestamp
        for host, plc, *values in zip(*(column.tolist() for column in columns), strict=True):
            stamp.seconds, stamp.nanos = divmod(plc, _SECOND)
            m.vacuum_mbar, m.expected_vacuum_mbar, m.deviation_mbar, m.supply_bar = values[:4]
            m.suction, m.blow_off, m.phase = values[4:]
            yield host, plc, m.SerializeToString()

    def _columns(self, samples: Samples, ticks: Ticks) -> list[npt.NDArray[np.generic]]:
        with np.errstate(invalid="ignore"):  # a NaN may be of the kind that signals
            return [
                samples["host_ns"],
                samples["time_ns"],
                (self._ambient - samples["pressure"].astype(float)) / MBAR,
                (self._ambient - ticks["expected"].astype(float)) / MBAR,
                deviation(samples, ticks) / MBAR,
                samples["supply"].astype(float) / BAR,
                np.sign(samples["commands"] & Command.SUCTION),
                np.sign(samples["commands"] & Command.BLOW_OFF),
                ticks["phase"],
            ]


def encode_event(event: Event) -> bytes:
    """Serialise as ``ejector_twin.Event``."""
    message = EVENTS.message(
        kind=event.kind.value,
        severity=event.severity.value,
        text=event.text,
        # NumPy's numbers are no Python numbers to json; .item() makes them so.
        data_json=json.dumps(dict(event.data), default=lambda number: number.item()),
    )
    _stamp(message, event.time_ns)
    packed: bytes = message.SerializeToString()
    return packed


def decode_event(packed: bytes | memoryview) -> Event:
    """Reverse ``encode_event``; ValueError for a kind that is not known here."""
    message = EVENTS.message.FromString(packed)
    time_ns = message.timestamp.seconds * _SECOND + message.timestamp.nanos
    return Event(time_ns, Kind(message.kind), message.text, json.loads(message.data_json))


def encode_log(event: Event) -> bytes:
    """Serialise as ``foxglove.Log``, for log panels."""
    level = _LEVEL[event.severity]
    message = LOG.message(level=level, message=event.text, name=event.kind.value)
    _stamp(message, event.time_ns)
    packed: bytes = message.SerializeToString()
    return packed
