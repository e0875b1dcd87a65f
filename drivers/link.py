"""One Modbus TCP connection, its settings, and its errors for people."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from drivers.tags import Address, Place, Pressure, Tag, WordOrder, Words
from twin.errors import SourceError
from twin.settings import Settings

MOST_WORDS = 125  # in one request, by the protocol

# pymodbus reports lost connections on its own log as well; they are said here, once.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

EXCEPTIONS = {
    1: "illegal function: it does not serve this kind of address",
    2: "illegal data address: it does not serve this address",
    3: "illegal data value: it does not serve this many at once",
    4: "device failure",
    5: "acknowledged, not ready",
    6: "busy",
    8: "memory parity error",
    10: "gateway: no path to the unit",
    11: "gateway: the unit does not answer",
}
OURS = (1, 2, 3)  # the request is wrong and stays wrong; the others may pass


@dataclass(frozen=True)
class Clock:
    """What time it is, and waiting; tests pass their own."""

    wall_ns: Callable[[], int] = time.time_ns
    now_ns: Callable[[], int] = time.perf_counter_ns  # runs on evenly
    sleep: Callable[[float], None] = time.sleep


class Tags(Settings):
    """The PLC's values that the twin reads."""

    pressure: Pressure
    suction: Tag | None = None
    blow_off: Tag | None = None
    supply: Pressure | None = None
    heartbeat: Tag | None = None  # changes at every scan: at rest, the PLC's program stands still

    @model_validator(mode="after")
    def _commands_are_bits(self) -> Self:
        for tag in (self.suction, self.blow_off):
            if tag is not None and tag.type != "bit":
                raise ValueError("suction and blow_off are bits")
        return self


class Ring(Settings):
    """Where the PLC's trace of its scans lies: header and ring of records."""

    header: Place = Address("holding", 100)
    records: Place = Address("holding", 1000)

    @model_validator(mode="after")
    def _lies_in_words(self) -> Self:
        for address in (self.header, self.records):
            if not address.of_words:
                raise ValueError(f"{address}: the trace lies in holding or input registers")
        return self


class ModbusSettings(Settings):
    """The ``[driver]`` table for a Modbus PLC."""

    kind: Literal["modbus"] = "modbus"
    host: str
    port: int = Field(default=502, ge=1, le=65535)
    unit: int = Field(default=1, ge=0, le=255)
    mode: Literal["block", "poll"] = "block"
    interval_ms: float = Field(default=30.0, ge=5, le=100)  # between blocks
    timeout_ms: float = Field(default=200.0, ge=10, le=250)  # longer, and staleness is seen late
    gap_ms: int = Field(default=20, ge=1)  # polled: fewer missing slots are no gap
    word_order: WordOrder = "big"  # of 32-bit values: high word first, or low word first
    ambient_mbar: float = Field(default=1013.25, ge=500, le=1200)
    tags: Tags
    ring: Ring = Ring()

    @model_validator(mode="after")
    def _tags_fit_the_mode(self) -> Self:
        tags = self.tags
        if self.mode == "poll" and (tags.suction is None or tags.blow_off is None):
            raise ValueError("polling needs the tags suction and blow_off")
        if self.mode == "block" and tags.pressure.size != 2:
            raise ValueError("the ring holds 32-bit pressures: tags.pressure.type must be so too")
        if self.mode == "block" and tags.supply is not None and tags.supply.size != 1:
            raise ValueError("the ring holds a 16-bit supply: tags.supply.type must be so too")
        return self

    @property
    def where(self) -> str:
        """Whom messages are about."""
        return f"{self.host}:{self.port}, unit {self.unit}"


class LostError(SourceError):
    """No connection, no answer, or a broken one: it may come back."""


class Link:
    """A connection that reads words and bits, and closes on the first broken answer."""

    def __init__(self, settings: ModbusSettings) -> None:
        self._settings = settings
        self._client = ModbusTcpClient(
            settings.host, port=settings.port, timeout=settings.timeout_ms * 1e-3, retries=0
        )
        self._read = {
            "coil": self._client.read_coils,
            "discrete": self._client.read_discrete_inputs,
            "input": self._client.read_input_registers,
            "holding": self._client.read_holding_registers,
        }

    def open(self) -> None:
        """Connect; LostError if that fails."""
        if not self._client.connect():  # type: ignore[no-untyped-call]
            raise LostError(
                f"{self._settings.host}:{self._settings.port}: no connection",
                "is the PLC on and reachable, its Modbus TCP server started, host and port right?",
            )

    def close(self) -> None:
        """Hang up."""
        self._client.close()  # type: ignore[no-untyped-call]

    def read(self, address: Address, count: int) -> Words:
        """Read ``count`` words (bits as 0 or 1) from ``address`` on, in one request.

        LostError if no complete answer comes; SourceError if the PLC refuses the address.
        """
        answer = self._ask(address, count)
        if answer.isError():
            raise self._refused(answer.exception_code, address, count)
        values = answer.registers if address.of_words else answer.bits[:count]
        if len(values) != count:
            raise self._lost(address, count, "the answer has the wrong length")
        return np.array(values, dtype=np.uint16)

    def _ask(self, address: Address, count: int) -> ModbusPDU:
        if not self._client.connected:  # pymodbus would connect again by itself
            raise self._lost(address, count, "the connection is closed")
        try:
            return self._read[address.area](
                address.offset, count=count, device_id=self._settings.unit
            )
        except (ModbusException, OSError) as error:
            raise self._lost(address, count, "no answer") from error

    def _lost(self, address: Address, count: int, what: str) -> LostError:
        """Close too: a late answer must not be taken for that to the next request."""
        self.close()
        return LostError(
            f"{self._settings.where}: {span(address, count)}: {what}",
            "is the unit id right, is it a Modbus TCP server, does it answer within timeout_ms?",
        )

    def _refused(self, code: int, address: Address, count: int) -> SourceError:
        what = EXCEPTIONS.get(code, "an exception unknown to the protocol")
        text = f"{self._settings.where}: {span(address, count)}: {what} (Modbus exception {code})"
        if code not in OURS:
            self.close()
            return LostError(text, "is the unit id right, and does the PLC run?")
        return SourceError(
            text,
            "check the addresses in [driver]: holding:0 counts from 0, the manual's 40001 from 1; "
            "everything read at once must exist",
        )


def span(address: Address, count: int) -> str:
    """Several addresses in both notations."""
    if count == 1:
        return str(address)
    last = address + (count - 1)
    return f"{address.area}:{address.offset}–{last.offset} [{address.manual}–{last.manual}]"
