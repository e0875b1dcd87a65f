"""The process that serves results: what strangers do to it, and its death, hold up nobody."""

import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress

import psutil
import pytest
from test_results import FIGURES, HERE, asked, rows

from drivers.outputs import results
from drivers.outputs.results import ResultsServer
from drivers.outputs.state import Results

PATIENCE_S = 60.0
SESSION_WITHIN_S = 10.0  # as the server has it
HUGE = b"HELF" + (0xFFFF_FFF0).to_bytes(4, "little")  # a chunk that never ends
MB = b"\0" * 1_000_000


@pytest.fixture(scope="module")
def told() -> list[str]:
    return []


@pytest.fixture(scope="module")
def server() -> Iterator[ResultsServer]:
    with ResultsServer(HERE, FIGURES) as running:
        yield running


@pytest.fixture(scope="module")
def rig(server: ResultsServer, told: list[str]) -> Results:
    sink = server.sink("rig", "", tell=told.append)
    sink.write(*rows(), [])
    return sink


def address(server: ResultsServer) -> tuple[str, int]:
    return "127.0.0.1", int(server.url.rpartition(":")[2])


def pressure(server: ResultsServer) -> float:
    return float(asked(server, "rig.Meas.Pressure")[0].Value.Value)


def until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def taken(connection: socket.socket, most: int) -> int:
    """Megabytes that go to the server before it hangs up, at most so many."""
    for sent in range(most):
        try:
            connection.sendall(MB)
        except OSError:
            return sent
    return most


def test_a_chunk_without_an_end_is_hung_up_on(server: ResultsServer, rig: Results) -> None:
    with socket.create_connection(address(server)) as connection:
        connection.sendall(HUGE)
        assert taken(connection, 110) < 10  # what lies in sockets is some megabytes
    assert psutil.Process(server.pid).memory_info().rss < 400e6
    assert pressure(server) == pytest.approx(400.0)


def test_chunks_that_nobody_asked_for_are_not_kept(server: ResultsServer, rig: Results) -> None:
    chunk = b"MSGC" + (60_000).to_bytes(4, "little") + b"\0" * 59_992
    with socket.create_connection(address(server)) as connection, suppress(OSError):
        for _ in range(500):
            connection.sendall(chunk)
    assert psutil.Process(server.pid).memory_info().rss < 400e6
    assert pressure(server) == pytest.approx(400.0)


def test_connections_that_say_nothing_are_few(server: ResultsServer, rig: Results) -> None:
    begun_s = time.monotonic()
    with ExitStack() as stack:
        silent = [
            stack.enter_context(socket.create_connection(address(server))) for _ in range(100)
        ]
        for connection in silent:
            connection.setblocking(False)
        until(lambda: sum(map(is_closed, silent)) >= 68)
        assert time.monotonic() - begun_s < SESSION_WITHIN_S  # then all are
    until(lambda: pressure_or_none(server) == pytest.approx(400.0))


def is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


def pressure_or_none(server: ResultsServer) -> float | None:
    try:
        return pressure(server)
    except (OSError, TimeoutError, ConnectionError):
        return None
    except TypeError:  # it answers, and has no value yet
        return None


def killed(server: ResultsServer) -> str:
    os.kill(server.pid, signal.SIGKILL)
    return "it was ended by signal 9"


def stopped(server: ResultsServer) -> str:
    os.kill(server.pid, signal.SIGSTOP)
    return "it did not answer, and was ended"


@pytest.mark.slow
@pytest.mark.parametrize("end", [killed, stopped])
def test_a_server_that_dies_is_told_of_and_comes_back_with_what_it_showed(
    end: Callable[[ResultsServer], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results, "SILENCE_S", 2.0)
    monkeypatch.setattr(results, "FIRST_PAUSE_S", 0.1)
    told: list[str] = []
    with ResultsServer(HERE, FIGURES) as server:
        sink = server.sink("rig", "", tell=told.append)
        sink.write(*rows(), [])
        assert pressure(server) == pytest.approx(400.0)
        url, pid = server.url, server.pid
        why = end(server)
        until(lambda: server.pid != pid)
        until(lambda: pressure_or_none(server) == pytest.approx(400.0))
        assert server.url == url
        sink.write(*rows(begin=100, pressure=30_000.0), [])
        until(lambda: pressure(server) == pytest.approx(300.0))
        last = server.pid
    assert not psutil.pid_exists(pid)
    assert not psutil.pid_exists(last)
    (text,) = told
    assert text.startswith(f"the results server (OPC UA) is down: {why}; it is started again")
