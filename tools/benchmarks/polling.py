"""Poll mode: missed slots of the driver, beside bare pollers that take turns with it."""

import ctypes
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from statistics import median

from benchmarks.figures import Measured, Run
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.native import library
from benchmarks.processes import CONFIG, plc
from drivers.sources import open_source
from twin.settings import Document

TURNS, LONG_TURNS = 20, 30
SLOTS = 2000  # in a turn, which is short so that other load affects all pollers alike
BUSY = 3.0  # %; if the bare poller misses more, the machine was too busy to judge the driver
SLOT_NS = 1_000_000
SPIN_NS = 60_000  # the driver's
# The driver's request: input registers 1 to 4, with pressure, supply and commands.
REQUEST = struct.pack(">HHHBBHH", 1, 0, 6, 1, 4, 1, 4)
ANSWER_SIZE = 9 + 2 * 4


def missed(run: Run) -> Sequence[Measured]:
    """Missed slots (%) of the driver beside the poller in Python, then beside that in C."""
    turns = LONG_TURNS if run.long else TURNS
    native = library("poll", run.folder)
    pollers = [_driver, _in_python]
    if native is not None:
        pollers.append(partial(_in_c, native))
    shares: list[list[float]] = [[] for _ in pollers]
    with plc() as port, on_core(TWIN_CORE):
        for turn in range(turns):
            run.tell(f"polling: turn {turn + 1} of {turns}")
            for index in range(turn, turn + len(pollers)):  # each poller is first equally often
                shares[index % len(pollers)].append(pollers[index % len(pollers)](port))
    ours, python, c = shares if native is not None else [*shares, []]
    note = f"{turns} turns of {SLOTS} slots"
    return _judged(ours, python, note), _judged(ours, c, "" if native else "no C compiler")


def _judged(ours: list[float], floors: list[float], note: str) -> Measured:
    valid = not floors or median(floors) <= BUSY
    if not valid:
        note = f"{note} (machine too busy to judge)".strip()
    return Measured(ours, floors, note, valid)


def _share(met: int, slots: int) -> float:
    """Share of missed slots (%)."""
    return 100.0 * (1.0 - met / slots)


def _driver(port: int) -> float:
    text = CONFIG.read_text(encoding="utf-8").replace('mode = "block"', 'mode = "poll"')
    assert 'mode = "poll"' in text
    document = Document.parse(text, "polled.toml")
    met, first, last = 0, None, 0
    with closing(open_source(document, f"127.0.0.1:{port}")) as source:
        for block in source:
            if len(block):
                first = int(block["sequence"][0]) if first is None else first
                last = int(block["sequence"][-1])
                met += len(block)
                if last - first >= SLOTS:
                    break
    return _share(met, last - first + 1)


@contextmanager
def _connected(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield connection


def _in_python(port: int) -> float:
    with _connected(port) as connection:
        start, slot, met = time.perf_counter_ns(), 0, 0
        while slot < SLOTS:
            due = start + slot * SLOT_NS
            rest = due - SPIN_NS - time.perf_counter_ns()
            if rest > 0:
                time.sleep(rest * 1e-9)
            while time.perf_counter_ns() < due:
                pass
            connection.sendall(REQUEST)
            connection.recv(ANSWER_SIZE, socket.MSG_WAITALL)
            met += 1
            slot = max(slot + 1, (time.perf_counter_ns() - start) // SLOT_NS)
    return _share(met, SLOTS)


def _in_c(native: ctypes.CDLL, port: int) -> float:
    poll = native.poll_slots
    poll.restype = ctypes.c_int64
    poll.argtypes = [ctypes.c_int, ctypes.c_char_p, *[ctypes.c_int64] * 5]
    with _connected(port) as connection:
        sizes = len(REQUEST), ANSWER_SIZE
        met = poll(connection.fileno(), REQUEST, *sizes, SLOTS, SLOT_NS, SPIN_NS)
    assert met > 0, "the PLC did not answer"
    return _share(met, SLOTS)
