"""Each network call of driver, webhook and e-mail fails in turn: nothing is lost.

A first run without faults counts the calls, so that new ones are covered by themselves.
"""

import errno
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from modbus_server import ModbusServer, PlcTime, TracePlc
from smtp_server import SmtpServer
from test_alarms_loop import NONE
from test_email import begun, configuration, leak, waiting
from test_modbus_block import clock_of, settings_for
from test_notifications import NO_TICKS, message, wait_until
from test_webhook import At, Server

from drivers.modbus.source import blocks
from twin.notifications import sender
from twin.quality import UNUSABLE
from twin.signals import SAMPLE, Samples

CALLS = ("connect", "sendall", "send", "recv", "recv_into", "setsockopt", "settimeout")
ERRORS = (errno.ECONNRESET, errno.EHOSTUNREACH, errno.ENOBUFS)
ROWS = 900


class Network:
    """Counts what sockets are asked for in some threads; the call numbered ``fails`` is refused."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, ours: Callable[[], bool]) -> None:
        self._lock = threading.Lock()
        self.begin()
        for name in CALLS:
            monkeypatch.setattr(socket.socket, name, self._counted(name, ours), raising=False)

    def begin(self, fails: int | None = None) -> None:
        """Count from 0."""
        self.asked, self._fails = 0, fails

    def _counted(self, name: str, ours: Callable[[], bool]) -> Callable[..., Any]:
        function = getattr(socket.socket, name)

        def call(*arguments: Any) -> Any:
            if ours():
                with self._lock:
                    number, self.asked = self.asked, self.asked + 1
                if number == self._fails:
                    code = ERRORS[number % len(ERRORS)]
                    raise OSError(code, os.strerror(code))
            return function(*arguments)

        return call


@contextmanager
def nothing_left() -> Iterator[None]:
    """Threads and files are as before."""
    process = psutil.Process()
    before = process.num_fds(), threading.active_count()
    yield
    assert (process.num_fds(), threading.active_count()) == before


# --- the driver -----------------------------------------------------------------------------------


def read(begin: Callable[[], None], told: list[str]) -> Samples:
    """Rows of a PLC with a trace, which are true; ``told`` is why it was away."""
    with ModbusServer() as server:
        plc = TracePlc(server)
        begin()
        time = PlcTime(plc.scan)
        stream = blocks(
            settings_for(server), clock_of(time), away=lambda error: told.append(str(error))
        )
        rows = np.empty(0, SAMPLE)
        with closing(stream):
            while len(rows) < ROWS:
                rows = np.concatenate([rows, next(stream)])
    true = np.array([plc.pressure(int(scan)) * 100.0 for scan in rows["sequence"]], np.float32)
    np.testing.assert_array_equal(rows["pressure"], true)
    return rows


@pytest.mark.slow
def test_whatever_network_call_of_the_driver_fails_no_row_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    main = threading.current_thread()
    network = Network(monkeypatch, lambda: threading.current_thread() is main)
    read(network.begin, told := [])
    assert told == []
    asked = network.asked
    assert asked > ROWS // 30
    with nothing_left():
        for number in range(asked):
            rows = read(partial(network.begin, number), told := [])
            assert len(told) == 1, number
            assert told[0].startswith("127.0.0.1:"), number
            # The PLC's ring has what came meanwhile.
            assert (np.diff(rows["sequence"]) == 1).all(), number
            assert not (rows["quality"] & UNUSABLE).any(), number


# --- the webhook ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_whatever_network_call_of_the_webhook_fails_no_alarm_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sender, "FIRST_PAUSE_S", 0.001)
    monkeypatch.setattr(sender, "LONGEST_PAUSE_S", 0.002)
    network = Network(monkeypatch, lambda: threading.current_thread().name == "to mqtt")

    def posted(number: int | None) -> tuple[list[str], list[str]]:
        """What the other side has taken, and what was said."""
        network.begin(number)
        server = Server()
        bench = At(tmp_path / f"{number}.sqlite", server.port)
        bench.put(*(message(n) for n in range(3)))
        bench.drained()
        bench.end()
        server.close()
        return server.taken(), bench.said

    taken, said = posted(None)
    assert (taken, said) == (["0", "1", "2"], [])
    asked = network.asked
    assert asked >= 3
    with nothing_left():
        for number in range(asked):
            taken, said = posted(number)
            assert list(dict.fromkeys(taken)) == ["0", "1", "2"], number  # at least once, in order
            assert len(said) in (0, 2), number  # lost and back, or not worth a word


# --- e-mail -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_whatever_network_call_of_the_mails_fails_no_mail_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sender, "FIRST_PAUSE_S", 0.001)
    monkeypatch.setattr(sender, "LONGEST_PAUSE_S", 0.002)
    network = Network(monkeypatch, lambda: threading.current_thread().name == "to email")
    two = ["ann@plant.example", "bob@plant.example"]

    def mailed(number: int | None) -> tuple[dict[str, set[str]], list[str]]:
        """The IDs of the mails that each recipient has, and what was said."""
        network.begin(number)
        folder, said, server = tmp_path / f"{number}", list[str](), SmtpServer()
        folder.mkdir()
        outlets = begun(configuration(folder, server.port, recipients=two), said)
        outlets.write(NONE, NO_TICKS, leak().said)
        wait_until(lambda: {envelope for _, envelope in server.envelopes} == set(two))
        wait_until(lambda: waiting(folder) == 0)
        outlets.close()
        server.close()
        ids: dict[str, set[str]] = {}
        for (_, recipient), mail in zip(server.envelopes, server.mails, strict=True):
            ids.setdefault(recipient, set()).add(str(mail["Message-ID"]))
        return ids, said

    ids, said = mailed(None)
    assert said == []
    asked = network.asked
    assert asked >= 10
    with nothing_left():
        for number in range(asked):
            ids, said = mailed(number)
            assert [len(ids[name]) for name in two] == [1, 1], number  # at least once, one ID
            assert len(said) in (0, 2), number
