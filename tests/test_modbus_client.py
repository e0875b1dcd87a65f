"""Telegrams against pymodbus's own coding, and the connection against whatever may be answered."""

import fcntl
import socket
import struct
import termios
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plc_process import PlcProcess, start_plc
from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.bit_message import ReadCoilsResponse, ReadDiscreteInputsResponse
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersResponse,
    ReadInputRegistersResponse,
)
from rigs import path_of

from drivers.modbus.client import ModbusClient, ModbusSettings, received
from drivers.modbus.pdu import FUNCTION, HEAD, MOST_WORDS, Request, belongs, exception
from drivers.reconnect import LostError
from drivers.tags import Address
from twin.errors import SourceError

PYMODBUS = FramerSocket(DecodePDU(is_server=True))
RESPONSES: dict[str, type[ModbusPDU]] = {
    "coil": ReadCoilsResponse,
    "discrete": ReadDiscreteInputsResponse,
    "holding": ReadHoldingRegistersResponse,
    "input": ReadInputRegistersResponse,
}
FOUR = Request(Address("input", 1), 4)
WORDS = [1, 2, 0xFFFF, 4]

addresses = st.builds(Address, st.sampled_from(sorted(RESPONSES)), st.integers(0, 65535))
requests = st.builds(Request, addresses, st.integers(1, MOST_WORDS))
stamps = st.tuples(st.integers(1, 65535), st.integers(1, 255))  # transaction, unit


def answer(request: Request, values: list[int], transaction: int, unit: int = 1) -> bytes:
    """As pymodbus's server writes it."""
    stamp = {"dev_id": unit, "transaction_id": transaction}
    response = RESPONSES[request.address.area]
    if request.address.of_words:
        return PYMODBUS.buildFrame(response(registers=values, **stamp))
    return PYMODBUS.buildFrame(response(bits=[bool(value) for value in values], **stamp))


def refusal(code: int, transaction: int = 1, unit: int = 1, function: int = 4) -> bytes:
    return PYMODBUS.buildFrame(ExceptionResponse(function, code, unit, transaction))


@given(requests, stamps)
def test_pymodbus_understands_the_question(request: Request, stamp: tuple[int, int]) -> None:
    _, asked = PYMODBUS.handleFrame(request.question(*stamp), 0, 0)
    assert asked is not None
    assert (asked.transaction_id, asked.dev_id) == stamp
    assert asked.function_code == FUNCTION[request.address.area]
    assert (asked.address, asked.count) == (request.address.offset, request.count)


@given(requests, stamps, st.data())
def test_answers_of_pymodbus_are_read(
    request: Request, stamp: tuple[int, int], data: st.DataObject
) -> None:
    most = 0xFFFF if request.address.of_words else 1
    value = st.integers(0, most)
    values = data.draw(st.lists(value, min_size=request.count, max_size=request.count))
    frame = answer(request, values, *stamp)
    assert frame[: HEAD.size] == request.head(*stamp)
    rows = np.frombuffer(2 * frame[HEAD.size :], np.uint8).reshape(2, request.size)
    np.testing.assert_array_equal(request.words(rows), [values, values])


@given(requests, stamps, st.integers(1, 255))
def test_exceptions_of_pymodbus_are_read(
    request: Request, stamp: tuple[int, int], code: int
) -> None:
    frame = refusal(code, *stamp, FUNCTION[request.address.area])
    assert len(frame) == HEAD.size
    assert belongs(frame, request.head(*stamp))
    assert exception(frame) == code
    assert exception(request.head(*stamp)) is None


@given(requests, stamps, requests, stamps)
def test_answers_to_other_requests_are_told_apart(
    request: Request, stamp: tuple[int, int], other: Request, other_stamp: tuple[int, int]
) -> None:
    same = (request.address.area, stamp) == (other.address.area, other_stamp)
    assert belongs(other.head(*other_stamp), request.head(*stamp)) == same


def send_in_pieces(sender: socket.socket, receiver: socket.socket, pieces: list[bytes]) -> None:
    """Each once the one before has been taken."""
    for piece in pieces:
        sender.sendall(piece)
        while any(fcntl.ioctl(receiver, termios.FIONREAD, bytes(4))):
            time.sleep(0)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=6))
def test_answers_come_in_pieces(pieces: list[bytes]) -> None:
    sender, receiver = socket.socketpair()
    with sender, receiver:
        thread = threading.Thread(target=send_in_pieces, args=(sender, receiver, pieces))
        thread.start()
        whole = b"".join(pieces)
        assert received(receiver, len(whole)) == whole
        thread.join()


class Wire:
    """A link and the PLC's end of its connection; the first request is number 1.

    What the PLC answers is sent before it is asked, so that nobody waits for anybody.
    """

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        table = {"host": "127.0.0.1", "port": self._listener.getsockname()[1], "timeout_ms": 10}
        tag = {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"}
        settings = ModbusSettings.model_validate(table | {"tags": {"pressure": tag}})
        self.link = ModbusClient(settings)
        self.plc: socket.socket | None = None
        self.open()

    def open(self) -> None:
        """Connect, again if need be."""
        if self.plc is not None:
            self.plc.close()
        self.link.open()
        self.plc = self._listener.accept()[0]

    def close(self) -> None:
        self.link.close()
        self._listener.close()
        assert self.plc is not None
        self.plc.close()

    def read(self, *answers: bytes) -> list[int]:
        assert self.plc is not None
        self.plc.sendall(b"".join(answers))
        return self.link.read(FOUR.address, FOUR.count).tolist()


@pytest.fixture
def wire() -> Iterator[Wire]:
    wire = Wire()
    yield wire
    wire.close()


def test_every_request_has_its_own_number(wire: Wire) -> None:
    wire.link._transaction = 65534
    for number in (65535, 0, 1):
        assert wire.read(answer(FOUR, WORDS, number)) == WORDS
    assert wire.plc is not None
    sent = received(wire.plc, 36)
    assert sent == b"".join(FOUR.question(number, 1) for number in (65535, 0, 1))


GOOD = answer(FOUR, WORDS, 1)
BROKEN = {
    "nothing": (b"", "no answer"),
    "a part of the head": (GOOD[:5], "no answer"),
    "a part of the data": (GOOD[:-1], "no answer"),
    "of another request": (answer(FOUR, WORDS, 7), "no answer"),
    "of another unit": (answer(FOUR, WORDS, 1, unit=2), "no answer"),
    "of another function": (answer(Request(Address("holding", 1), 4), WORDS, 1), "no answer"),
    "of another protocol": (b"HTTP/1.1 400 Bad Request\r\n\r\n", "no answer"),
    "too short": (answer(FOUR, WORDS[:3], 1), "the answer has the wrong length"),
    "too long": (answer(FOUR, [*WORDS, 5], 1), "the answer has the wrong length"),
    "length against size": (GOOD[:5] + b"\x0a" + GOOD[6:], "the answer has the wrong length"),
    "a refusal that may pass": (refusal(6), r"busy \(Modbus exception 6\)"),
    "a refusal unknown": (
        refusal(99),
        r"an exception unknown to the protocol \(Modbus exception 99\)",
    ),
}


@pytest.mark.parametrize(("sent", "message"), BROKEN.values(), ids=BROKEN)
def test_a_broken_answer_closes_the_connection(wire: Wire, sent: bytes, message: str) -> None:
    with pytest.raises(LostError, match=rf"input:1–4 \[30002–30005\]: {message}"):
        wire.read(sent)
    with pytest.raises(LostError, match="the connection is closed"):
        wire.link.read(FOUR.address, FOUR.count)
    wire.open()
    assert wire.read(answer(FOUR, WORDS, 2)) == WORDS


def test_an_answer_that_comes_late_is_never_taken_for_another(wire: Wire) -> None:
    with pytest.raises(LostError, match="no answer"):
        wire.read()
    wire.open()
    with pytest.raises(LostError, match="no answer"):
        wire.read(GOOD, answer(FOUR, [9, 9, 9, 9], 2))


def test_a_plc_that_hangs_up_is_lost(wire: Wire) -> None:
    assert wire.plc is not None
    wire.plc.close()
    with pytest.raises(LostError, match="no answer"):
        wire.link.read(FOUR.address, FOUR.count)


def test_a_wrong_request_is_refused_and_the_connection_stays(wire: Wire) -> None:
    with pytest.raises(SourceError, match="illegal data address") as caught:
        wire.read(refusal(2))
    assert not isinstance(caught.value, LostError)
    assert wire.read(answer(FOUR, WORDS, 2)) == WORDS


def test_opening_twice_keeps_the_connection(wire: Wire) -> None:
    wire.link.open()
    assert wire.read(GOOD) == WORDS


@pytest.mark.parametrize("host", ["a..b", "300.1.1.1.1"])
def test_a_host_that_cannot_be_is_no_connection(host: str) -> None:
    tags = {"pressure": {"address": "30002", "type": "float32", "unit": "mbar"}}
    tags["pressure"]["reference"] = "absolute"
    with pytest.raises(LostError, match="no connection"):
        ModbusClient(ModbusSettings.model_validate({"host": host, "tags": tags})).open()


@pytest.fixture
def to_plc(plc: PlcProcess) -> Iterator[ModbusClient]:
    tag = {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"}
    table = {"host": "127.0.0.1", "port": plc.port, "tags": {"pressure": tag}}
    link = ModbusClient(ModbusSettings.model_validate(table))
    link.open()
    yield link
    link.close()


def test_the_server_of_pymodbus_is_read(to_plc: ModbusClient) -> None:
    words = to_plc.read(Address("holding", 0), 4)
    assert words.tolist() == [0x1234, 0x10000 - 12345, 0x1234, 0x5678]
    assert set(to_plc.read(Address("coil", 0), 2)) <= {0, 1}
    with pytest.raises(SourceError, match="illegal data address"):
        to_plc.read(Address("input", 900), 2)
    assert len(to_plc.read(Address("holding", 1000), MOST_WORDS)) == MOST_WORDS


def test_the_simulated_plc_says_nothing_of_its_clients_faults(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with start_plc(path_of("gripper")) as running:
        with socket.create_connection(("127.0.0.1", running.port)) as rude:
            rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            rude.sendall(50 * FOUR.question(1, 1))  # and does not wait for the answers
        with socket.create_connection(("127.0.0.1", running.port)) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
        with socket.create_connection(("127.0.0.1", running.port)) as client:
            client.sendall(FOUR.question(1, 1))
            received(client, HEAD.size)
    assert capfd.readouterr().err == ""
