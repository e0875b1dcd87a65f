"""Garbage on the wire in a session: no crash, no hang, no wrong value taken as good."""

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from typing import Any

import numpy as np
import pytest
from independent import simulated
from opcua_plc import OpcuaPlc, start_opcua
from test_peers import blocks, by_modbus

from twin.quality import BREAK
from twin.signals import SAMPLE, Samples

Frame = Callable[[socket.socket], bytes]  # the next whole message; b"" at the end


def _exactly(connection: socket.socket, size: int) -> bytes:
    data = connection.recv(size, socket.MSG_WAITALL)
    if len(data) < size:
        raise ConnectionError
    return data


def modbus_frame(connection: socket.socket) -> bytes:
    head = _exactly(connection, 6)
    return head + _exactly(connection, struct.unpack(">4xH", head)[0])


def opcua_frame(connection: socket.socket) -> bytes:
    head = _exactly(connection, 8)
    return head + _exactly(connection, struct.unpack("<4xI", head)[0] - 8)


class Garbler:
    """Stands between a client and the PLC at ``port``, and spoils some of what the PLC says.

    What is spoilt is whole messages and their beginnings: neither protocol has a check sum, so
    that nobody could tell values that were changed inside a message.
    """

    def __init__(self, port: int, frame: Frame, seed: int, share: float) -> None:
        self.share = share  # of the messages that are spoilt
        self.spoilt = 0
        self._to, self._frame = port, frame
        self._random = np.random.default_rng(seed)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._open: set[socket.socket] = set()
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in list(self._open):
            _hang_up(connection)
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            plc = socket.create_connection(("127.0.0.1", self._to))
            for end in (client, plc):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._open.add(end)
            done = threading.Barrier(2, action=lambda a=client, b=plc: (a.close(), b.close()))
            for work in (self._ask, self._answer):
                thread = threading.Thread(target=self._carry, args=(work, client, plc, done))
                self._threads.append(thread)
                thread.start()

    def _carry(self, work: Any, client: socket.socket, plc: socket.socket, done: Any) -> None:
        with suppress(OSError):
            work(client, plc)
        for end in (client, plc):
            _hang_up(end)
            self._open.discard(end)
        done.wait(10)

    def _ask(self, client: socket.socket, plc: socket.socket) -> None:
        while data := client.recv(65536):
            plc.sendall(data)

    def _answer(self, client: socket.socket, plc: socket.socket) -> None:
        while True:
            message = self._frame(plc)
            if self._random.random() < self.share:
                self.spoilt += 1
                message = self._garbled(message)
            client.sendall(message)
            if not message:
                time.sleep(0.02)

    def _garbled(self, message: bytes) -> bytes:
        random = self._random
        noise = random.bytes(int(random.integers(1, 400)))
        how = int(random.integers(7))
        if how == 0:
            return noise
        if how == 1:
            return random.bytes(len(message))
        if how == 2:
            return noise + message
        if how == 3:  # and the rest never comes
            return message[: int(random.integers(len(message)))]
        if how == 4:
            return b""
        if how == 5:
            raise ConnectionError  # in the middle of everything
        head = bytearray(message)
        head[int(random.integers(8))] ^= 1 << int(random.integers(8))
        return bytes(head)


def _hang_up(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def through(garbler: Garbler, settings: Any, seconds: float, least: int) -> Samples:
    """What a driver makes of it, while it is spoilt for so long and so often, and after."""
    parts = [np.empty(0, SAMPLE)]
    share, garbler.share = garbler.share, 0.0
    with closing(blocks(settings.at("127.0.0.1", garbler.port))) as source:
        parts += _taken(source, 0.3)
        garbler.share = share
        parts += _taken(source, seconds)
        for _ in range(30):  # on a busy machine few messages are exchanged
            if garbler.spoilt >= least:
                break
            parts += _taken(source, 1.0)
        garbler.share = 0.0
        parts += _taken(source, 4.0, enough=300)
    return np.concatenate(parts)


def _taken(source: Iterator[Samples], seconds: float, enough: int = 1 << 30) -> list[Samples]:
    end = time.monotonic() + seconds
    parts: list[Samples] = []
    while time.monotonic() < end and sum(map(len, parts)) < enough:
        parts.append(next(source))
    return parts


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpcuaPlc]:
    """A PLC that has not run for longer than is known what it serves."""
    with start_opcua(tmp_path_factory.mktemp("fresh")) as plc:
        yield plc


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("protocol", ["modbus", "opcua"])
def test_garbage_in_a_session(fresh: OpcuaPlc, protocol: str, seed: int) -> None:
    settings: Any = fresh.settings(timeout_ms=300)
    port, frame, share = fresh.port, opcua_frame, 0.08
    if protocol == "modbus":
        settings = by_modbus(fresh.process.port, timeout_ms=250)
        port, frame, share = fresh.process.port, modbus_frame, 0.02
    garbler = Garbler(port, frame, seed, share)
    with closing(garbler):
        samples = through(garbler, settings, 4.0, least=3)
    assert garbler.spoilt >= 3
    truth = simulated(3)  # the seed that the PLC was started with
    scans = samples["sequence"]
    assert (samples["pressure"] == truth.pressure[scans]).all()
    assert (samples["commands"] == truth.commands[scans]).all()
    assert (np.diff(scans) > 0).all()
    missing = np.flatnonzero(np.diff(scans) != 1) + 1
    marked = np.flatnonzero(samples["quality"] & BREAK)
    assert set(missing) <= set(marked)
    off = np.diff(samples["time_ns"]) - np.diff(scans) * 1_000_000
    assert np.abs(np.delete(off, marked - 1)).max() <= 1_000_000
    assert (np.diff(scans)[-200:] == 1).all(), "it did not come back"
