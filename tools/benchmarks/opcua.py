"""Block mode over OPC UA: lost samples, CPU share and delay of the live twin, with stops.

The PLC is the simulated one, or node-opcua's server that replays cycles of the simulated rig.
"""

import asyncio
import json
import re
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
import psutil
import tomli_w
from asyncua import Client, ua

from benchmarks.figures import Measured, Run
from benchmarks.machine import PLC_CORE, TWIN_CORE, on_core
from benchmarks.processes import ROOT, live
from drivers.opcua import certificates
from drivers.opcua.settings import Node, OpcuaSettings
from drivers.opcua.trace import NodeTrace
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from drivers.reconnect import REAL
from twin.log.reader import open_log
from twin.settings import Document
from twin.signals import MBAR, Command, Samples

CONFIG = ROOT / "configs" / "test_rig_opcua.toml"
PEERS = ROOT / "tests" / "peers"
SLICE_S = 10.0
STOP_S = 0.3  # of a SIGSTOP at the beginning of each slice: the client does not get to run
BARE_S = 3.0
LONG_S, SHORT_S = 600.0, 30.0
SIGNAL_S = 65.0  # of the rig's cycles, which node-opcua repeats
LATE = 99  # percentile
LINE = re.compile(rb"\d\d:\d\d:\d\d\.\d{3}  ")


def ours(run: Run) -> Sequence[Measured]:
    """Lost samples, CPU share and delays with the simulated PLC."""
    return _acquire(run, "OPC UA, our PLC", plc(run.folder))


def other(run: Run) -> Sequence[Measured]:
    """Lost samples, CPU share and delays with node-opcua."""
    return _acquire(run, "OPC UA, node-opcua", _node_opcua(run.folder))


# --- the servers ----------------------------------------------------------------------------------


@contextmanager
def plc(folder: Path) -> Iterator[int]:
    """Run the simulated PLC; yields the port of its OPC UA server."""
    tables = tomllib.loads(CONFIG.read_text(encoding="utf-8"))
    tables["plc"]["opcua"]["port"] = 0
    config = folder / "plc.toml"
    config.write_text(tomli_w.dumps(tables), encoding="utf-8")
    command = [sys.executable, "-m", "drivers.plc", config, "--port", "0"]
    with _serving(command, "OPC UA on ") as port:
        yield port


@contextmanager
def _node_opcua(folder: Path) -> Iterator[int]:
    """Run node-opcua's server with the rig's cycles; yields its port."""
    certificates.make(folder / "theirs", "plc")
    own = certificates.own(folder / "theirs", datetime.now(UTC))
    settings = {"port": 0, "folder": str(folder), "uri": own.uri, "signal": str(_signal(folder))}
    settings |= {"certificate": str(own.path), "key": str(own.key)}
    with _serving(
        ["node", PEERS / "opcua_server.js", json.dumps(settings)], "listening on "
    ) as port:
        yield port


def _signal(folder: Path) -> Path:
    """A file with whole cycles of the simulated rig, from one suction edge to another."""
    plc = Document.read(CONFIG).section(PlcSettings, "plc")
    samples = np.concatenate(list(blocks(plc, SIGNAL_S)))
    edges = np.flatnonzero(np.diff(samples["commands"] & Command.SUCTION) == 1) + 1
    cycles = samples[edges[1] : edges[-1]]
    columns = {
        "pressures": (cycles["pressure"] / MBAR).round(3).tolist(),
        "statuses": cycles["commands"].tolist(),
    }
    path = folder / "signal.json"
    path.write_text(json.dumps(columns), encoding="utf-8")
    return path


@contextmanager
def _serving(command: Sequence[str | Path], says: str) -> Iterator[int]:
    """Run a server; yields its port, which ends the first line that begins with ``says``."""
    with on_core(PLC_CORE):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    with process:
        try:
            assert process.stdout is not None
            line = next((line for line in process.stdout if line.startswith(says)), "")
            if not line:
                sys.exit(f"{command[0]} did not start; node-opcua: npm ci --prefix {PEERS}")
            yield int(line.rpartition(":")[2])
        finally:
            process.terminate()


# --- the twin -------------------------------------------------------------------------------------


@dataclass
class _Heard:
    """Lines that ``twin run`` printed, and when."""

    process: "subprocess.Popen[bytes]"
    at_ns: list[int] = field(default_factory=list)
    lines: list[bytes] = field(default_factory=list)

    def listen(self) -> threading.Thread:
        """Start a thread that reads lines until the output ends."""
        thread = threading.Thread(target=self._listen)
        thread.start()
        return thread

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if LINE.match(line):
                self.at_ns.append(time.time_ns())
                self.lines.append(line)


Span = tuple[int, int]  # ns
Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


def _acquire(run: Run, name: str, server: AbstractContextManager[int]) -> Sequence[Measured]:
    log = run.folder / f"{name}.mcap"
    seconds = run.seconds or (LONG_S if run.long else SHORT_S)
    slices = max(round(seconds / SLICE_S), 1)
    with server as port:
        run.tell(f"{name}: the floor")
        with on_core(TWIN_CORE):
            floors = [bare_share(port) for _ in range(3)]
        with live(log, [CONFIG], port=port, stdout=subprocess.PIPE) as process:
            heard = _Heard(process)
            listening = heard.listen()
            shares, stops = [], []
            begin_ns = time.time_ns()
            for number in range(slices):
                run.tell(f"{name}: slice {number + 1} of {slices}")
                share, stop = _slice(process)
                shares.append(share)
                stops.append(stop)
            end_ns = time.time_ns()
        listening.join()
    # Times before and after the slices belong to start and end of the run.
    spoilt = [(0, begin_ns), *stops, (end_ns, time.time_ns())]
    samples, lost = _rows(log)
    waits, lags = _waits(samples, spoilt), _lags(log, heard, spoilt)
    return (
        Measured([lost], note=f"of {len(samples):,} samples"),
        Measured(shares, floors),
        _late(waits, "samples"),
        _late(lags, "events"),
    )


def _late(ms: Floats, items: str) -> Measured:
    """The 99th percentile of delays (ms), with the median in its note."""
    note = f"of {len(ms):,} {items}, median {np.median(ms):.0f} ms"
    return Measured([np.percentile(ms, LATE)], note=note)


def _slice(process: "subprocess.Popen[bytes]") -> tuple[float, Span]:
    """CPU time (% of a core) over one slice, and when the process was stopped in it."""
    times = psutil.Process(process.pid).cpu_times()
    begin, begin_ns = time.monotonic(), time.time_ns()
    process.send_signal(signal.SIGSTOP)
    try:
        time.sleep(STOP_S)
    finally:
        process.send_signal(signal.SIGCONT)
    stopped = begin_ns, time.time_ns()
    time.sleep(SLICE_S - STOP_S)
    wall = time.monotonic() - begin
    after = psutil.Process(process.pid).cpu_times()
    return 100.0 * (after.user + after.system - times.user - times.system) / wall, stopped


def _rows(log: Path) -> tuple[Samples, int]:
    """All rows, and the number of missing ones; a repeated sequence number is an error."""
    samples = np.concatenate([samples for samples, _ in open_log(log).blocks()])
    steps = np.diff(samples["sequence"])
    assert (steps > 0).all(), "the log has a sample twice"
    return samples, int((steps - 1).sum())


def _waits(samples: Samples, spoilt: Sequence[Span]) -> Floats:
    """Time (ms) from each sample to its receipt, without those that overlap a spoilt span."""
    begin, end = samples["time_ns"], samples["host_ns"]
    return _apart(begin, end, spoilt)


def _lags(log: Path, heard: _Heard, spoilt: Sequence[Span]) -> Floats:
    """Time (ms) from an event's sample to its line on the console, without spoilt spans."""
    events = list(open_log(log).events())
    for event, line in zip(events, heard.lines, strict=True):
        assert event.text.encode() in line, "the console says other things than the log"
    return _apart(np.array([event.time_ns for event in events]), np.array(heard.at_ns), spoilt)


def _apart(begin: Integers, end: Integers, spoilt: Sequence[Span]) -> Floats:
    """Times (ms) from ``begin`` to ``end`` (ns), of those that overlap no spoilt span."""
    fair = np.ones(len(begin), bool)
    for first, last in spoilt:
        fair &= (begin >= last) | (end <= first)
    return (end - begin)[fair] * 1e-6


# --- the floor ------------------------------------------------------------------------------------


def bare_share(port: int, seconds: float = BARE_S) -> float:
    """CPU time (% of a core) of asyncua alone, reading the same nodes with the same requests."""
    return asyncio.run(_bare(port, seconds))


async def _bare(port: int, seconds: float) -> float:
    settings = Document.read(CONFIG).section(OpcuaSettings, "driver")
    async with Client(f"opc.tcp://127.0.0.1:{port}") as client:
        index = await client.get_namespace_index(settings.namespace)
        requests = [_request(nodes, index) for nodes in NodeTrace(settings, REAL).requests]
        begin, cpu = time.monotonic(), time.process_time()
        while time.monotonic() - begin < seconds:
            await asyncio.sleep(settings.interval_ms * 1e-3)
            for request in requests:
                await client.uaclient.read(request)
        return 100.0 * (time.process_time() - cpu) / (time.monotonic() - begin)


def _request(nodes: Sequence[Node], index: int) -> ua.ReadParameters:
    """The request to read ``nodes``, which are in the namespace with this index."""
    ids = [ua.NodeId.from_string(f"ns={index};{node.identifier}") for node in nodes]
    wanted = [ua.ReadValueId(node_id, ua.AttributeIds.Value) for node_id in ids]
    return ua.ReadParameters(NodesToRead=wanted)
