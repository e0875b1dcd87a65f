"""One Modbus TCP connection, its settings, and its errors for people."""

import socket
import struct
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.modbus.pdu import HEAD, Request, Store, belongs, exception
from drivers.modbus.tls import Tls, secured
from drivers.optional_signals import BITS, refuse_unclear
from drivers.reconnect import AbsentError, LostError, unreachable
from drivers.tags import Address, Flow, Place, Pressure, Tag, Temperature, WordOrder, Words
from drivers.trace import COMMAND_BITS, no_effect, refuse_unused
from twin.errors import SourceError
from twin.settings import KeyedError, Settings

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
STATUS = Address("input", 4)  # in the register map: the bits of a record's status
COILS = Address("coil", 0)  # and the first of the commands as coils, in the same order
OURS = (1, 3)  # the request is wrong and stays wrong; the others may pass
ABSENT = 2  # it may come later: a PLC that starts or takes a new program does not serve it yet


class Tags(Settings):
    """The PLC's values that the twin reads."""

    pressure: Pressure
    suction: Tag | None = None
    blow_off: Tag | None = None
    supply: Pressure | None = None
    heartbeat: Tag | None = None  # changes at every scan: at rest, the PLC's program stands still
    nozzle: Tag | None = None  # on; as the ejector itself reports it
    air_saving: Tag | None = None  # or that it saves air: the nozzle is off under suction
    part_present: Tag | None = None  # the same: H2 is reached
    ambient: Pressure | None = None  # a barometer
    temperature: Temperature | None = None  # of the gas or the surroundings
    pressure_2: Pressure | None = None  # at the other end of the line
    flow: Flow | None = None  # suction flow

    @model_validator(mode="after")
    def _are_what_they_must(self) -> Self:
        for name in ("suction", "blow_off", *BITS):
            tag = getattr(self, name)
            if tag is not None and tag.type != "bit":
                raise ValueError(f"{name} is a bit")
        refuse_unclear(self.nozzle, self.air_saving, self.ambient)
        return self


class Ring(Settings):
    """Where the PLC's trace of its scans lies: header and ring of records."""

    header: Place = Address("holding", 100)  # its first register
    records: Place = Address("holding", 1000)  # the first register of the ring

    @model_validator(mode="after")
    def _lies_in_words(self) -> Self:
        for address in (self.header, self.records):
            if not address.of_words:
                raise ValueError(f"{address}: the trace lies in holding or input registers")
        return self


class ModbusSettings(Settings):
    """The ``[driver]`` table for a Modbus PLC."""

    kind: Literal["modbus"] = "modbus"  # of driver
    host: str  # name or address of the PLC
    port: int = Field(default=502, ge=1, le=65535)  # of Modbus TCP
    unit: int = Field(default=1, ge=0, le=255)  # identifier of the PLC, where a gateway has several
    # A ring that the PLC fills, or registers read one by one.
    mode: Literal["block", "poll"] = "block"
    interval_ms: float = Field(default=30.0, ge=5, le=100)  # between blocks
    timeout_ms: float = Field(default=200.0, ge=10, le=250)  # longer, and staleness is seen late
    gap_ms: int = Field(default=20, ge=1)  # polled: fewer missing slots are no gap
    word_order: WordOrder = "big"  # of 32-bit values: high word first, or low word first
    # Absolute, where no barometer is read: gauge pressures count from it.
    ambient_mbar: float = Field(default=1013.25, ge=500, le=1200)
    tags: Tags
    ring: Ring = Ring()
    tls: Tls | None = None  # Modbus/TCP Security

    @model_validator(mode="after")
    def _tags_fit_the_mode(self) -> Self:
        tags = self.tags
        if self.mode == "poll" and (tags.suction is None or tags.blow_off is None):
            raise ValueError("polling needs the tags suction and blow_off")
        if self.mode == "block" and tags.pressure.size != 2:
            raise ValueError("the ring holds 32-bit pressures: tags.pressure.type must be so too")
        if self.mode == "block" and tags.supply is not None and tags.supply.size != 1:
            raise ValueError("the ring holds a 16-bit supply: tags.supply.type must be so too")
        if self.mode == "block":
            self._refuse_without_effect()
        return self

    def _refuse_without_effect(self) -> None:
        """KeyedError for a tag or setting that block mode does not use."""
        for name, bit in (COMMAND_BITS | BITS).items():
            tag = getattr(self.tags, name)
            same = [(STATUS, bit), *([(COILS + bit, None)] if name in COMMAND_BITS else [])]
            if tag is not None and (tag.address, tag.bit) not in same:
                address = tag.address if tag.bit is None else f"{tag.address} bit {tag.bit}"
                raise no_effect(name, bit, address, "poll")
        if self.tags.heartbeat is not None:
            raise KeyedError(
                "has no effect in block mode: the ring's sequence shows whether the PLC's program "
                'runs. Leave out [driver.tags.heartbeat], or set mode = "poll" in [driver]',
                "tags",
                "heartbeat",
            )
        refuse_unused(self.model_fields_set, ("gap_ms",), "poll")

    def at(self, host: str, port: int) -> "ModbusSettings":
        """Give the same for a PLC at another address."""
        return self.model_copy(update={"host": host, "port": port})

    def below(self, folder: Path) -> "ModbusSettings":
        """Give the same with files looked for in ``folder``, unless their paths are absolute."""
        tls = None if self.tls is None else self.tls.below(folder)
        return self.model_copy(update={"tls": tls})

    @property
    def where(self) -> str:
        """The PLC as messages name it."""
        return f"{self.host}:{self.port}, unit {self.unit}"


class ModbusClient:
    """A connection that reads words and bits, and closes on the first broken answer.

    A bare socket, since polling has a millisecond for everything: docs/decisions/0007.
    """

    def __init__(self, settings: ModbusSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None
        self._transaction = 0

    def open(self) -> None:
        """Connect, unless it is connected; LostError if that fails, and as ``tls.secured``."""
        if self._socket is not None:
            return
        host, port, tls = self._settings.host, self._settings.port, self._settings.tls
        patience_ms = self._settings.timeout_ms
        try:
            plain = connected(host, port, patience_ms)
        except (OSError, UnicodeError) as error:  # the latter where it cannot be a host's name
            raise unreachable(f"{host}:{port}", error, "Modbus TCP server") from error
        self._socket = plain if tls is None else secured(plain, tls, f"{host}:{port}", patience_ms)

    def close(self) -> None:
        """Hang up."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def read(self, address: Address, count: int) -> Words:
        """Read ``count`` words (bits as 0 or 1) from ``address`` on, in one request.

        LostError if no complete answer comes; AbsentError if the PLC does not serve the address;
        SourceError if it refuses the request otherwise.
        """
        request = Request(address, count)
        data = np.frombuffer(self.ask(request), np.uint8)
        return request.words(data[np.newaxis]).reshape(count)

    def ask(self, request: Request | Store) -> bytes:
        """Data of the answer as they came, ``request.size`` bytes; errors as from ``read``."""
        if self._socket is None:
            raise self._lost(request, "the connection is closed")
        self._transaction = (self._transaction + 1) & 0xFFFF
        stamp = self._transaction, self._settings.unit
        expected = request.head(*stamp)
        try:
            self._socket.sendall(request.question(*stamp))
            head = received(self._socket, HEAD.size)
            if head == expected:
                return received(self._socket, request.size)
        except OSError as error:
            raise self._lost(request, "no answer") from error
        raise self._unexpected(request, head, expected)

    def _unexpected(self, request: Request | Store, head: bytes, expected: bytes) -> SourceError:
        """The error for an answer with an unexpected head."""
        if not belongs(head, expected):
            return self._lost(request, "no answer")
        code = exception(head)
        if code is None:
            return self._lost(request, "the answer has the wrong length")
        return self._refused(request, code)

    def _lost(self, request: Request | Store, cause: str) -> LostError:
        """Close, and give the error: a late answer must not be taken for the next one."""
        self.close()
        return LostError(
            f"{self._about(request)}: {cause}",
            "is the unit id right, is it a Modbus TCP server, does it answer within timeout_ms? "
            "A secure port (often 802) needs [driver.tls]",
        )

    def _refused(self, request: Request | Store, code: int) -> SourceError:
        cause = EXCEPTIONS.get(code, "an exception unknown to the protocol")
        text = f"{self._about(request)}: {cause} (Modbus exception {code})"
        if code not in (*OURS, ABSENT):
            self.close()
            return LostError(text, "is the unit id right, and does the PLC run?")
        kind = AbsentError if code == ABSENT else SourceError
        return kind(
            text,
            "check the addresses in [driver]: holding:0 counts from 0, the manual's 40001 from 1; "
            "everything read at once must exist",
        )

    def _about(self, request: Request | Store) -> str:
        return f"{self._settings.where}: {span(request.address, request.count)}"

    def write(self, address: Address, values: tuple[int, ...]) -> None:
        """Write words (to coils 0 or 1) from ``address`` on; errors as from ``read``.

        Only hardware in the loop does (drivers/outputs/writer.py).
        """
        store = Store(address, values)
        if self.ask(store) != store.echo:
            raise self._lost(store, "the answer is to another request")


def connected(host: str, port: int, timeout_ms: float) -> socket.socket:
    """Connect a socket that waits ``timeout_ms`` for an answer; OSError if it cannot.

    The kernel does the waiting. Python's own timeout would poll before each read, and could not
    wait for whole answers.
    """
    connection = socket.create_connection((host, port), timeout_ms * 1e-3)
    patience = struct.pack("@ll", 0, round(timeout_ms * 1e3))  # struct timeval: s, µs
    try:
        connection.settimeout(None)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, patience)
    except OSError:
        connection.close()
        raise
    return connection


def received(connection: socket.socket, size: int) -> bytes:
    """Exactly ``size`` bytes, in however many pieces they come; OSError if they do not."""
    data = connection.recv(size, socket.MSG_WAITALL)
    if len(data) < size:
        raise ConnectionError(f"{len(data)} of {size} bytes came")
    return data


def span(address: Address, count: int) -> str:
    """Several addresses in both notations."""
    if count == 1:
        return str(address)
    last = address + (count - 1)
    return f"{address.area}:{address.offset}–{last.offset} [{address.manual}–{last.manual}]"
