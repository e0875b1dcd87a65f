"""The clients against whatever may be answered, and the bare socket against pymodbus' coding."""

import itertools
import os
import socket
import struct
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
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

from drivers.modbus.client import READING, ModbusClient
from drivers.modbus.plan import MOST_WORDS, Request
from drivers.modbus.poll_socket import HEAD, PollSocket, exception_head, head, question
from drivers.modbus.settings import ModbusSettings
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


def stamped(request: Request, stamp: tuple[int, int]) -> tuple[int, int, int]:
    return *stamp, READING[request.address.area].function_code


@given(requests, stamps)
def test_pymodbus_understands_the_question(request: Request, stamp: tuple[int, int]) -> None:
    transaction, unit, function = stamped(request, stamp)
    _, asked = PYMODBUS.handleFrame(question(request, transaction, unit, function), 0, 0)
    assert asked is not None
    assert (asked.transaction_id, asked.dev_id) == stamp
    assert type(asked) is READING[request.address.area]
    assert (asked.address, asked.count) == (request.address.offset, request.count)


@given(requests, stamps, st.data())
def test_answers_of_pymodbus_are_read(
    request: Request, stamp: tuple[int, int], data: st.DataObject
) -> None:
    most = 0xFFFF if request.address.of_words else 1
    value = st.integers(0, most)
    values = data.draw(st.lists(value, min_size=request.count, max_size=request.count))
    frame = answer(request, values, *stamp)
    assert frame[: HEAD.size] == head(request.size, *stamped(request, stamp))
    rows = np.frombuffer(2 * frame[HEAD.size :], np.uint8).reshape(2, request.size)
    np.testing.assert_array_equal(request.words(rows), [values, values])


@given(requests, stamps, st.integers(1, 255))
def test_exceptions_of_pymodbus_are_read(
    request: Request, stamp: tuple[int, int], code: int
) -> None:
    transaction, unit, function = stamped(request, stamp)
    frame = refusal(code, transaction, unit, function)
    assert len(frame) == HEAD.size
    assert frame == exception_head(transaction, unit, function) + bytes([code])


class Wire:
    """A client and the PLC's end of its connection; the first request is number 1.

    What the PLC answers is sent before it is asked, so that nobody waits for anybody.
    """

    def __init__(self, client: type[ModbusClient] | type[PollSocket]) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        table = {"host": "127.0.0.1", "port": self._listener.getsockname()[1], "timeout_ms": 10}
        tag = {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"}
        settings = ModbusSettings.model_validate(table | {"tags": {"pressure": tag}})
        self.link = client(settings)
        self.number_after = 1 if client is ModbusClient else 2  # of a request once opened again
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

    def answered(self, *answers: bytes) -> list[int]:
        assert self.plc is not None
        self.plc.sendall(b"".join(answers))
        return self.read()

    def read(self) -> list[int]:
        asked = np.frombuffer(self.link.ask(FOUR), np.uint8)[np.newaxis]
        words: list[int] = FOUR.words(asked)[0].tolist()
        return words


@pytest.fixture(params=[ModbusClient, PollSocket])
def wire(request: pytest.FixtureRequest) -> Iterator[Wire]:
    wire = Wire(request.param)
    yield wire
    wire.close()


def send_in_pieces(sender: socket.socket, pieces: list[bytes]) -> None:
    """Each once the receiver has had time to take the one before."""
    for piece in pieces:
        sender.sendall(piece)
        os.sched_yield()


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(cuts=st.lists(st.integers(1, 16), max_size=5, unique=True))
def test_answers_come_in_pieces(wire: Wire, cuts: list[int]) -> None:
    wire.link.close()
    wire.link = type(wire.link)(wire.link._settings.model_copy(update={"timeout_ms": 250}))
    wire.open()
    assert wire.plc is not None
    ends = [0, *sorted(cuts), len(GOOD)]
    pieces = [GOOD[start:end] for start, end in itertools.pairwise(ends)]
    wire.plc.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    thread = threading.Thread(target=send_in_pieces, args=(wire.plc, pieces))
    thread.start()
    assert wire.read() == WORDS
    thread.join()


def test_every_request_has_its_own_number() -> None:
    wire = Wire(PollSocket)
    assert isinstance(wire.link, PollSocket)
    wire.link._transaction = 65534
    for number in (65535, 0, 1):
        assert wire.answered(answer(FOUR, WORDS, number)) == WORDS
    assert wire.plc is not None
    sent = wire.plc.recv(36, socket.MSG_WAITALL)
    assert sent == b"".join(question(FOUR, number, 1, 4) for number in (65535, 0, 1))
    wire.close()


GOOD = answer(FOUR, WORDS, 1)
WRONG = "(no answer|the answer has the wrong length)"
BROKEN = {
    "nothing": (b"", "no answer"),
    "a part of the head": (GOOD[:5], "no answer"),
    "a part of the data": (GOOD[:-1], "no answer"),
    "of another request": (answer(FOUR, WORDS, 7), "no answer"),
    "of another unit": (answer(FOUR, WORDS, 1, unit=2), "no answer"),
    "of another function": (answer(Request(Address("holding", 1), 4), WORDS, 1), "no answer"),
    "of another protocol": (b"HTTP/1.1 400 Bad Request\r\n\r\n", "no answer"),
    "too short": (answer(FOUR, WORDS[:3], 1), WRONG),
    "too long": (answer(FOUR, [*WORDS, 5], 1), WRONG),
    "length against size": (
        GOOD[:5] + b"\x0a" + GOOD[6:],
        WRONG,
    ),
    "a refusal that may pass": (refusal(6), r"busy \(Modbus exception 6\)"),
    "a refusal unknown": (
        refusal(99),
        r"an exception unknown to the protocol \(Modbus exception 99\)",
    ),
}


@pytest.mark.parametrize(("sent", "message"), BROKEN.values(), ids=BROKEN)
def test_a_broken_answer_closes_the_connection(wire: Wire, sent: bytes, message: str) -> None:
    with pytest.raises(LostError, match=rf"input:1–4 \[30002–30005\]: {message}"):
        wire.answered(sent)
    with pytest.raises(LostError, match="the connection is closed"):
        wire.read()
    wire.open()
    assert wire.answered(answer(FOUR, WORDS, wire.number_after)) == WORDS


def test_an_answer_that_comes_late_is_never_taken_for_another(wire: Wire) -> None:
    with pytest.raises(LostError, match="no answer"):
        wire.read()
    wire.open()
    late, own = answer(FOUR, WORDS, 7), answer(FOUR, [9, 9, 9, 9], wire.number_after)
    if isinstance(wire.link, ModbusClient):  # pymodbus skips it
        assert wire.answered(late, own) == [9, 9, 9, 9]
        return
    with pytest.raises(LostError, match="no answer"):
        wire.answered(late, own)


def test_a_plc_that_hangs_up_is_lost(wire: Wire) -> None:
    assert wire.plc is not None
    wire.plc.close()
    with pytest.raises(LostError, match="no answer"):
        wire.read()


def test_a_wrong_request_is_refused_and_the_connection_stays(wire: Wire) -> None:
    with pytest.raises(SourceError, match="illegal data address") as caught:
        wire.answered(refusal(2))
    assert not isinstance(caught.value, LostError)
    assert wire.answered(answer(FOUR, WORDS, 2)) == WORDS


def test_opening_twice_keeps_the_connection(wire: Wire) -> None:
    wire.link.open()
    assert wire.answered(GOOD) == WORDS


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
    for request in (FOUR, Request(Address("coil", 0), 2), Request(Address("holding", 0), 6)):
        asked = np.frombuffer(to_plc.ask(request), np.uint8)[np.newaxis]
        words = to_plc.read(request.address, request.count)
        if request is not FOUR:  # the pressure there goes on
            np.testing.assert_array_equal(request.words(asked)[0], words)
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
            rude.sendall(50 * question(FOUR, 1, 1, 4))  # and does not wait for the answers
        with socket.create_connection(("127.0.0.1", running.port)) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
        with socket.create_connection(("127.0.0.1", running.port)) as client:
            client.sendall(question(FOUR, 1, 1, 4))
            client.recv(HEAD.size, socket.MSG_WAITALL)
    assert capfd.readouterr().err == ""
