"""CPU share of the driver alone, beside other clients that fetch the same data.

Clients take turns of TURN_S at the simulated PLC with 1 000 samples a second. Each fetches a block
every 30 ms.
"""

import ctypes
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from functools import partial
from pathlib import Path

from pymodbus.client import ModbusTcpClient

from benchmarks import opcua
from benchmarks.acquisition import INTERVAL_S, connected, fetch, read
from benchmarks.figures import Measured, Run
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.native import PLAIN, library
from benchmarks.processes import CONFIG, plc
from drivers.sources import open_source
from twin.settings import Document
from twin.signals import Samples

TURNS, LONG_TURNS = 3, 12
TURN_S = 1.5
ENOUGH = 0.9  # least share of a turn's samples: a client with fewer does not do the same work
RATE = 1000.0  # samples a second

Fetch = Callable[[float], int]  # fetches for a number of seconds, returns the sample count
Client = Callable[[], AbstractContextManager[Fetch]]  # connects


def modbus(run: Run) -> Sequence[Measured]:
    """The driver over a bare socket in C; then Python, pymodbus and libmodbus over the driver."""
    with plc() as port, connected(port) as native_line, connected(port) as python_line:
        clients = {
            "driver": partial(_driver, Document.read(CONFIG), port),
            "C": _native(run.folder, port, native_line),
            "Python": lambda: nullcontext(partial(fetch, partial(read, python_line))),
            "pymodbus": partial(_pymodbus, port),
            "libmodbus": _libmodbus(run.folder, port),
        }
        shares = _by_turns(
            run, {name: client for name, client in clients.items() if client is not None}
        )
    driver, bare = shares["driver"], shares.get("C", [])
    other_shares = [shares.get(name) for name in ("Python", "pymodbus", "libmodbus")]
    return (
        Measured(driver, bare, note="" if bare else "no C compiler"),
        *(_beside(driver, shares_of_client) for shares_of_client in other_shares),
    )


def over_opcua(run: Run) -> Sequence[Measured]:
    """The OPC UA driver, with asyncua reading the same arrays as the floor."""
    document = Document.read(opcua.CONFIG)
    with opcua.plc(run.folder) as port:
        clients = {"OPC UA": partial(_driver, document, port)}
        ours, bare = [], []
        for _ in range(LONG_TURNS if run.long else TURNS):
            ours += _by_turns(run, clients, 1)["OPC UA"]
            with on_core(TWIN_CORE):
                bare.append(opcua.bare_share(port, TURN_S))
    return (Measured(ours, bare),)


def _beside(ours: Sequence[float], theirs: Sequence[float] | None) -> Measured:
    return Measured(theirs, ours) if theirs else Measured([float("nan")], note="not installed")


def _by_turns(run: Run, clients: dict[str, Client], turns: int = 0) -> dict[str, list[float]]:
    """CPU times (% of a core) of each client, a value for each of its turns."""
    turns = turns or (LONG_TURNS if run.long else TURNS)
    shares: dict[str, list[float]] = {name: [] for name in clients}
    with on_core(TWIN_CORE):
        for turn in range(turns):
            for name, client in clients.items():
                run.tell(f"clients: {name}, turn {turn + 1} of {turns}")
                shares[name].append(_share(name, client))
    return shares


def _share(name: str, client: Client) -> float:
    with client() as fetch_for:
        begin, cpu = time.monotonic(), time.process_time()
        samples = fetch_for(TURN_S)
        wall, cpu = time.monotonic() - begin, time.process_time() - cpu
    assert samples > ENOUGH * RATE * TURN_S, f"{name} fetched {samples} samples in {wall:.1f} s"
    return 100.0 * cpu / wall


@contextmanager
def _driver(document: Document, port: int) -> Iterator[Fetch]:
    """Our driver, which also decodes, checks and stamps."""
    with closing(open_source(document, f"127.0.0.1:{port}")) as source:
        while not len(next(source)):
            pass
        yield partial(_taken, source)


def _taken(source: Iterator[Samples], seconds: float) -> int:
    end, samples = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        samples += len(next(source))
    return samples


@contextmanager
def _pymodbus(port: int) -> Iterator[Fetch]:
    """The client of pymodbus, which returns registers as numbers."""
    with ModbusTcpClient("127.0.0.1", port=port) as client:

        def words(address: int, count: int) -> bytes:
            first, second = client.read_holding_registers(address, count=count).registers[:2]
            return (first << 16 | second).to_bytes(4, "big")

        yield partial(fetch, words)


def _native(folder: Path, port: int, connection: socket.socket) -> Client | None:
    compiled = library("fetch", folder)
    if compiled is None:
        return None
    return lambda: nullcontext(partial(_in_c, compiled, port, connection.fileno()))


def _libmodbus(folder: Path, port: int) -> Client | None:
    """A C client with libmodbus; None without its headers (libmodbus-dev)."""
    if shutil.which("pkg-config") is None:
        return None
    command = ["pkg-config", "--cflags", "--libs", "libmodbus"]
    flags = subprocess.run(command, capture_output=True, text=True, check=False)
    if flags.returncode != 0:
        return None
    compiled = library("fetch", folder, [*PLAIN, "-DLIBMODBUS"], flags.stdout.split())
    if compiled is None:
        return None
    return lambda: nullcontext(partial(_in_c, compiled, port, -1))


def _in_c(compiled: ctypes.CDLL, port: int, connection: int, seconds: float) -> int:
    compiled.fetch.restype = ctypes.c_int64
    compiled.fetch.argtypes = [ctypes.c_int, ctypes.c_int64, ctypes.c_int64, ctypes.c_int]
    turns, interval_ns = round(seconds / INTERVAL_S), round(INTERVAL_S * 1e9)
    samples: int = compiled.fetch(port, turns, interval_ns, connection)
    assert samples >= 0, "the PLC did not answer"
    return samples
