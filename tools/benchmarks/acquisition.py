"""Block mode: samples lost and CPU used by the live twin, with the PLC in another process."""

import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import psutil

from benchmarks.figures import Measured, Run
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.processes import live, plc
from twin.log.reader import open_log

SLICE_S, SHORT_SLICE_S = 10.0, 5.0
BARE_S = 2.0
STOP_S = 0.3  # of a SIGSTOP at the beginning of each slice: the client does not get to run
INTERVAL_S = 0.03  # between blocks, as configs/test_rig.toml has it
HEADER, RING, DEPTH = (100, 12), 1000, 4096  # of the PLC's trace; a record has 4 words
RECORDS_AT_ONCE = 31


def steady(run: Run) -> Sequence[Measured]:
    """Lost samples, CPU share and bytes per sample, without disturbance."""
    return _acquire(run, "acquisition", [SLICE_S if run.long else SHORT_SLICE_S] * 3, stop_s=0.0)


def stopped(run: Run) -> Sequence[Measured]:
    """Lost samples and CPU share with a stop of 300 ms every 10 s; ``--long``: ten minutes."""
    return _acquire(run, "acquisition with stops", [SLICE_S] * (60 if run.long else 3), STOP_S)[:2]


def _acquire(run: Run, name: str, slices: Sequence[float], stop_s: float) -> Sequence[Measured]:
    log = run.folder / f"{name}.mcap"
    with plc() as port:
        run.tell(f"{name}: the floor")
        with on_core(TWIN_CORE):
            floors = [bare_share(port) for _ in range(3)]
        with live(log, port=port) as process:
            shares = []
            for number, slice_s in enumerate(slices):
                run.tell(f"{name}: slice {number + 1} of {len(slices)}")
                shares.append(_share(process, slice_s, stop_s))
    missing, rows = lost(log)
    note = f"of {rows:,} samples"
    return (
        Measured([missing], note=note),
        Measured(shares, floors),
        Measured([log.stat().st_size / rows]),
    )


def _share(process: "subprocess.Popen[bytes]", slice_s: float, stop_s: float) -> float:
    """CPU time (% of a core) over one slice."""
    times = psutil.Process(process.pid).cpu_times()
    begin = time.monotonic()
    if stop_s:
        process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(stop_s)
        finally:
            process.send_signal(signal.SIGCONT)
    time.sleep(slice_s - stop_s)
    wall = time.monotonic() - begin
    after = psutil.Process(process.pid).cpu_times()
    return 100.0 * (after.user + after.system - times.user - times.system) / wall


def lost(log: Path) -> tuple[int, int]:
    """Number of missing sequence numbers and of rows; a repeated sequence number is an error."""
    sequence = np.concatenate([samples["sequence"] for samples, _ in open_log(log).blocks()])
    steps = np.diff(sequence)
    assert (steps > 0).all(), "the log has a sample twice"
    return int((steps - 1).sum()), len(sequence)


def bare_share(port: int) -> float:
    """CPU time (% of a core) of a bare socket that fetches the same registers at the same rate."""
    with connected(port) as connection:
        begin, cpu = time.monotonic(), time.process_time()
        fetch(partial(read, connection), BARE_S)
        return 100.0 * (time.process_time() - cpu) / (time.monotonic() - begin)


@contextmanager
def connected(port: int) -> Iterator[socket.socket]:
    """A bare connection to the PLC."""
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield connection


def fetch(words: Callable[[int, int], bytes], seconds: float) -> int:
    """Fetch the ring as the driver does; ``words`` reads registers. Returns the record count."""
    first = seen = _newest(words)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(INTERVAL_S)
        newest = _newest(words)
        while seen < newest:
            at = (seen + 1) % DEPTH
            count = min(newest - seen, RECORDS_AT_ONCE, DEPTH - at)
            words(RING + 4 * at, 4 * count)
            seen += count
    return seen - first


def _newest(words: Callable[[int, int], bytes]) -> int:
    return int.from_bytes(words(*HEADER)[:4], "big")


def read(connection: socket.socket, address: int, words: int) -> bytes:
    """Bytes of ``words`` holding registers from ``address`` on."""
    connection.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, address, words))
    answer = connection.recv(9 + 2 * words, socket.MSG_WAITALL)
    assert answer[7] == 3, "the PLC refused the request"
    return answer[9:]
