"""A fault run: ``twin run`` beside the simulated PLC while everything that can go wrong does.

Disturbances are drawn by seed. A proxy between the twin and the PLC cuts, garbles, truncates,
delays and lies. Strangers flood the port of the results, that server is killed, and the host's
clock is set. The disk is full, and the folder of the log is deleted. The log is compared with the
samples that the PLC keeps: every sample must be in it exactly once, bit for bit, or inside a
recorded gap with the right bounds. Deleted files count with what the twin had written into them.
The twin must be right again within a cycle, and its process must not grow.

    python tools/fault_run.py --protocol opcua --seconds 1200 --disturbances 40
"""

import argparse
import asyncio
import json
import resource
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
import numpy.typing as npt
import psutil
import tomli_w
from asyncua import Client, ua

from drivers.modbus.ring import RECORD_WORDS
from drivers.plc.live import WITNESSED
from twin.events import Event, Kind
from twin.log.part import SUFFIX, first_parts
from twin.log.reader import Log, open_log
from twin.log.records import is_complete
from twin.quality import BREAK, Quality
from twin.signals import MBAR, SAMPLE, TICK, Phase, Samples, Ticks

ROOT = Path(__file__).parents[1]
CONFIGS = {"modbus": "test_rig", "opcua": "test_rig_opcua"}
RIGHT_MBAR = 3.0  # rms of a cycle; healthy ones have 0.6
SETTLED_S = 8.0  # from the end of a disturbance to the next
GROWTH_MB = 12.0
HEADER_BYTES = 9 + 2 * 12  # of an answer with the trace's header; three records have as many
SCAN_US = 1000  # of the PLC of both configurations
LIES = 0.2  # share of false answers of a PLC that lies
MB = b"\0" * 1_000_000
# The twin with a clock that signals set, as an operator or a time server would.
CLOCK = """
import signal, time
wall_ns, wall, ahead_ns = time.time_ns, time.time, 0
time.time_ns = lambda: wall_ns() + ahead_ns
time.time = lambda: wall() + ahead_ns * 1e-9
def set_by(seconds):
    global ahead_ns
    ahead_ns += seconds * 10**9
signal.signal(signal.SIGUSR1, lambda *_: set_by(3600))
signal.signal(signal.SIGUSR2, lambda *_: set_by(-3600))
from twin.cli.main import main
main()
"""
START_S = 300.0  # the kernels may have to be compiled, on a busy machine


# --- between the twin and the PLC -----------------------------------------------------------------


class Proxy:
    """Forwards data, and disturbs it as ``how`` says."""

    def __init__(self, random: np.random.Generator) -> None:
        self.target = 0
        self.how = "pass"  # cut, garbage, truncate, slow, swallow, lie
        self.lie: Callable[[bytes], bytes] = bytes
        self._random = random
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._closed = False
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while not self._closed:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            try:
                assert self.how != "cut"
                server = socket.create_connection(("127.0.0.1", self.target), 2.0)
                server.settimeout(None)
            except (AssertionError, OSError):
                client.close()
                continue
            for connection in (client, server):
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._pairs.append((client, server))
            for ends, answers in (((client, server), False), ((server, client), True)):
                threading.Thread(target=self._pass, args=(*ends, answers), daemon=True).start()

    def _pass(self, source: socket.socket, target: socket.socket, answers: bool) -> None:
        with suppress(OSError):
            while data := source.recv(65_536):
                target.sendall(self._disturbed(data) if answers else data)
                if answers and self.how == "truncate":
                    break
        for end in (source, target):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _disturbed(self, data: bytes) -> bytes:
        match self.how:
            case "garbage":
                return self._random.bytes(len(data))
            case "truncate":
                return data[: len(data) // 2]
            case "slow":
                time.sleep(0.12)
            case "swallow":
                return b""
            case "lie" if self._random.random() < LIES:
                return self.lie(data)
        return data

    def hang_up(self) -> None:
        """Cut all connections."""
        pairs, self._pairs = self._pairs, []
        for end in (end for pair in pairs for end in pair):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Take nobody any more."""
        self._closed = True
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.hang_up()


def has_header(answer: bytes) -> bool:
    """Whether an answer of Modbus brings the trace's header, and not three records."""
    if len(answer) != HEADER_BYTES:
        return False
    period_us, _depth, record_words = struct.unpack(">3H", answer[9 + 14 : 9 + 20])
    return (period_us, record_words) == (SCAN_US, RECORD_WORDS)


def lie_by_modbus(data: bytes, random: np.random.Generator) -> bytes:
    """An answer that is detectably wrong; in a header often a value."""
    if has_header(data) and random.random() < 0.7:
        lies = [
            (0, random.bytes(4)),  # the sequence
            (4, struct.pack(">q", 2**63 - 1)),  # the time
            *((offset, b"\0\5") for offset in (14, 16, 18)),  # period, depth, words of a record
        ]
        offset, lie = lies[int(random.integers(len(lies)))]
        return data[: 9 + offset] + lie + data[9 + offset + len(lie) :]
    match int(random.integers(3)):
        case 0:  # an exception
            code = bytes([data[7] | 0x80, int(random.integers(1, 12))])
            return data[:4] + b"\0\3" + data[6:7] + code
        case 1:  # another transaction
            return random.bytes(2) + data[2:]
        case _:  # another length
            return data[:8] + bytes([data[8] ^ 0x55]) + data[9:]


def lie_by_opcua(data: bytes, random: np.random.Generator) -> bytes:
    """A message with another head: type, size, channel, token, sequence or request."""
    changed = bytearray(data)
    changed[int(random.integers(min(24, len(data))))] ^= 1 << int(random.integers(8))
    return bytes(changed)


LIAR = {"modbus": lie_by_modbus, "opcua": lie_by_opcua}


# --- the three processes --------------------------------------------------------------------------


@dataclass
class Cell:
    """PLC, proxy and twin, and the disturbances of them."""

    protocol: str
    folder: Path
    random: np.random.Generator
    rotate_mb: float = 64.0  # of a part of the log
    boots: list[Path] = field(default_factory=list)  # what each PLC sampled
    seen: list[dict[str, float]] = field(default_factory=list)  # sizes of the twin's process
    deleted: dict[Path, BinaryIO] = field(default_factory=dict)  # deleted logs, still open

    def __enter__(self) -> Self:
        self.proxy = Proxy(self.random)
        self.proxy.lie = partial(LIAR[self.protocol], random=self.random)
        self.results_port = free_port()
        self._plc_config = self._configured("plc.toml", 0)
        self.start_plc()
        self.log = self.folder / "logs" / "run.mcap"
        self.log.parent.mkdir()
        config = self._configured("twin.toml", self.proxy.port)
        command = [sys.executable, "-c", CLOCK, "run", str(config), "--log", str(self.log)]
        self._said = (self.folder / "twin.txt").open("w")
        self.twin = psutil.Popen(command, cwd=ROOT, stdout=self._said, stderr=self._said)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with suppress(psutil.NoSuchProcess):
            self.twin.kill()
            self.twin.wait()
        self.plc.kill()
        self.plc.wait()
        assert self.plc.stdout is not None
        self.plc.stdout.close()
        self._said.close()
        self.proxy.close()
        for file in self.deleted.values():
            file.close()

    def _configured(self, name: str, port: int) -> Path:
        tables: dict[str, Any] = tomllib.loads(
            (ROOT / "configs" / f"{CONFIGS[self.protocol]}.toml").read_text(encoding="utf-8")
        )
        tables["plc"]["program"]["start_ms"] = 500.0
        tables["plc"]["server"]["port"] = 0
        tables["results"] = {"opcua": True, "port": self.results_port}
        tables["log"] = {"rotate_mb": self.rotate_mb}
        if self.protocol == "opcua":
            tables["plc"]["opcua"]["port"] = 0
            tables["driver"]["url"] = f"opc.tcp://127.0.0.1:{port or 4840}"
        else:
            tables["driver"]["port"] = port or 502
        path = self.folder / name
        path.write_text(tomli_w.dumps(tables), encoding="utf-8")
        return path

    def start_plc(self) -> None:
        """Start the PLC, and direct the proxy to it."""
        self.boots.append(self.folder / f"boot{len(self.boots)}.bin")
        command = [sys.executable, "-m", "drivers.plc", str(self._plc_config), "--port", "0"]
        command += ["--seed", str(len(self.boots)), "--witness", str(self.boots[-1])]
        self.plc = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        assert self.plc.stdout is not None
        port = int(self.plc.stdout.readline().strip().rpartition(":")[2])
        if self.protocol == "opcua":
            port = int(self.plc.stdout.readline().strip().rpartition(":")[2])
        self.proxy.target = port

    def results_server(self) -> psutil.Process:
        """The process that serves the results."""
        (server,) = (
            child for child in self.twin.children() if "drivers.outputs.serve" in child.cmdline()
        )
        return server

    def rows(self) -> int:
        """Bytes of the log so far, which grow while rows arrive."""
        return self.log.stat().st_size if self.log.exists() else 0

    def delete_logs(self) -> None:
        """Delete the folder of the log; its files stay open, so later rows can be read."""
        folder = self.log.parent
        while folder.exists():
            for path in folder.iterdir():
                if path.suffix == SUFFIX:
                    self.deleted[path] = path.open("rb")
                path.unlink()
            with suppress(OSError):  # the twin has begun another part meanwhile
                folder.rmdir()

    def restore_logs(self) -> None:
        """Put back what was deleted."""
        for path, file in self.deleted.items():
            with path.open("xb") as restored:
                shutil.copyfileobj(file, restored)

    def watch(self) -> None:
        """Record the size of the twin's process."""
        if self.twin.status() == psutil.STATUS_STOPPED:
            return
        self.seen.append(
            {
                "threads": self.twin.num_threads(),
                "files": self.twin.num_fds(),
                "sockets": len(self.twin.net_connections()),
                "mb": self.twin.memory_info().rss / 1e6,
            }
        )


def _restart(cell: Cell, seconds: float) -> None:
    cell.plc.kill()
    cell.plc.wait()
    assert cell.plc.stdout is not None
    cell.plc.stdout.close()
    time.sleep(seconds)
    cell.start_plc()


def _stop_client(cell: Cell, seconds: float) -> None:
    cell.twin.suspend()
    time.sleep(seconds)
    cell.twin.resume()


def _through_proxy(disturbance: str) -> Callable[[Cell, float], None]:
    def disturb(cell: Cell, seconds: float) -> None:
        cell.proxy.how = disturbance
        if disturbance == "cut":
            cell.proxy.hang_up()
        time.sleep(seconds)
        cell.proxy.how = "pass"

    return disturb


def _set_clock(cell: Cell, seconds: float) -> None:
    ahead = bool(cell.random.integers(2))
    cell.plc.send_signal(signal.SIGUSR1 if ahead else signal.SIGUSR2)
    time.sleep(min(seconds, 1.0))


def _set_wall_clock(cell: Cell, _seconds: float) -> None:
    ahead = bool(cell.random.integers(2))
    cell.twin.send_signal(signal.SIGUSR1 if ahead else signal.SIGUSR2)


def _flood_results(cell: Cell, seconds: float) -> None:
    """Endless chunks, as fast as they are accepted, and silent connections."""
    end = time.monotonic() + seconds
    address = "127.0.0.1", cell.results_port
    with ExitStack() as stack, suppress(OSError):
        for _ in range(50):
            stack.enter_context(socket.create_connection(address, 1.0))
    while time.monotonic() < end:
        with suppress(OSError), socket.create_connection(address, 1.0) as connection:
            connection.sendall(b"HELF" + (0xFFFF_FFF0).to_bytes(4, "little"))
            while time.monotonic() < end:
                connection.sendall(MB)


def _kill_results(cell: Cell, _seconds: float) -> None:
    cell.results_server().kill()


def _fill_disk(cell: Cell, seconds: float) -> None:
    """Keep files of the twin from growing, as on a full disk; its other processes can write."""
    no_limit = resource.RLIM_INFINITY
    resource.prlimit(cell.twin.pid, resource.RLIMIT_FSIZE, (0, no_limit))
    time.sleep(seconds)
    resource.prlimit(cell.twin.pid, resource.RLIMIT_FSIZE, (no_limit, no_limit))


def _delete_logs(cell: Cell, _seconds: float) -> None:
    cell.delete_logs()


DISTURBANCES: dict[str, Callable[[Cell, float], None]] = {
    "the disk is full": _fill_disk,
    "the folder of the log is deleted": _delete_logs,
    "the PLC lies": _through_proxy("lie"),
    "the wall clock is set": _set_wall_clock,
    "the results port is flooded": _flood_results,
    "the results server is killed": _kill_results,
    "the PLC is killed and restarted": _restart,
    "the connection is cut": _through_proxy("cut"),
    "the client is stopped": _stop_client,
    "the PLC's clock is set": _set_clock,
    "answers are garbage": _through_proxy("garbage"),
    "answers are truncated": _through_proxy("truncate"),
    "answers are slow": _through_proxy("slow"),
    "answers are swallowed": _through_proxy("swallow"),
}


def free_port() -> int:
    """A port without a listener."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


async def served(port: int) -> bool:
    """Whether the results can be read, and are fresh."""
    async with Client(f"opc.tcp://127.0.0.1:{port}") as client:
        index = await client.get_namespace_index("urn:ejector-twin:results")
        pressure = client.get_node(f"ns={index};s=rig-01.Meas.Pressure")
        value = await pressure.read_data_value(raise_on_bad_status=False)
        return bool(value.StatusCode.is_good())


# --- the log against what was sampled -------------------------------------------------------------


@dataclass
class Verdict:
    """Problems and counts."""

    problems: list[str] = field(default_factory=list)
    counts: dict[str, float] = field(default_factory=dict)

    def check(self, good: bool, problem: str) -> None:
        """Note ``problem`` unless it is ``good``."""
        if not good:
            self.problems.append(problem)


def judge(log: Path, boots: list[Path], verdict: Verdict) -> None:
    """Compare the log with what the PLCs sampled."""
    opened = open_log(log)
    pairs = [(np.empty(0, SAMPLE), np.empty(0, TICK)), *opened.blocks()]
    samples, ticks = (np.concatenate(column) for column in zip(*pairs, strict=True))
    events = list(opened.events())
    lost = _judge_outages(opened, events, verdict)
    verdict.check(len(samples) > 0, "there is nothing in the log")
    sampled = [np.fromfile(path, WITNESSED) for path in boots]
    starts = np.flatnonzero(samples["quality"] & Quality.RESTART)
    boot = 0
    for rows in np.split(samples, starts):
        boot = _boot_of(rows, sampled, boot)
        if boot == len(sampled):
            verdict.problems.append(f"rows from {rows['sequence'][0]} on are of no PLC")
            break
        _held_against(rows, sampled[boot], boot, verdict)
        boot += 1
    reported = sum(event.data["missing"] for event in events if event.kind is Kind.GAP)
    reported += lost
    first = samples["quality"] & Quality.RESTART == 0
    steps = np.diff(samples["sequence"])
    missing = int((steps[first[1:]] - 1).sum()) if len(steps) else 0
    verdict.check(reported == missing, f"gaps say that {reported} are missing, and {missing} are")
    verdict.counts |= {"rows": len(samples), "restarts": len(starts), "missing": missing}
    verdict.counts["gaps"] = sum(event.kind is Kind.GAP for event in events)
    for kind in (Kind.PLC_LOST, Kind.RESULTS_DOWN, Kind.TWIN_LATE):
        verdict.counts[str(kind)] = sum(event.kind is kind for event in events)
    verdict.counts["stale"] = sum(event.kind is Kind.PLC_STALE for event in events)
    back = sum(event.kind is Kind.PLC_BACK for event in events)
    verdict.check(verdict.counts["stale"] - back in (0, 1), "stale and back do not take turns")
    alarms = [event.text for event in events if event.kind is Kind.DEVIATION]
    verdict.check(not alarms, f"healthy, and yet: {alarms}")
    _judge_twin(samples, ticks, verdict)


def _judge_outages(log: Log, events: list[Event], verdict: Verdict) -> int:
    """Check that each unfinished part is reported, and that the last one is finished.

    Returns the number of rows that the log reports as lost.
    """
    down = [event for event in events if event.kind is Kind.OUTPUT_DOWN]
    back = [event for event in events if event.kind is Kind.OUTPUT_BACK]
    for name in {event.data["output"] for event in down + back}:
        began, ended = (
            sum(event.data["output"] == name for event in kind) for kind in (down, back)
        )
        verdict.check(began == ended, f"{name}: was down {began} times, and back {ended} times")
    of_log = [event for event in down if event.data["output"] == "log"]
    unfinished = [part.name for part in log.parts if not is_complete(part)]
    verdict.check(len(unfinished) <= len(of_log), f"not finished and not told of: {unfinished}")
    verdict.check(is_complete(log.parts[-1]), "the log is not complete")
    files = len(list(log.path.parent.glob(f"*{SUFFIX}")))
    verdict.check(len(log.parts) == files, f"{files - len(log.parts)} files are not part of it")
    verdict.counts |= {"parts": len(log.parts), "log_down": len(of_log)}
    verdict.counts["output_down"] = len(down)
    return sum(event.data["rows_lost"] for event in back if event.data["output"] == "log")


def _boot_of(rows: Samples, sampled: list[npt.NDArray[np.void]], first: int) -> int:
    """Number of the PLC that sampled these rows: the first one from ``first`` on."""
    beginning = rows[:50]
    for boot in range(first, len(sampled)):
        sampled_rows = sampled[boot]
        if beginning["sequence"][-1] < len(sampled_rows):
            pressure = _pascal(sampled_rows[beginning["sequence"]])
            if np.array_equal(pressure, beginning["pressure"]):
                return boot
    return len(sampled)


def _pascal(sampled: npt.NDArray[np.void]) -> npt.NDArray[np.float32]:
    return (sampled["pressure"].astype(np.float64) * MBAR).astype(np.float32)


def _held_against(
    rows: Samples, sampled: npt.NDArray[np.void], boot: int, verdict: Verdict
) -> None:
    """Check rows bit for bit, in order, and that each hole has a gap flag after it."""
    source = f"PLC {boot}"
    sequence, quality = rows["sequence"], rows["quality"]
    steps = np.diff(sequence)
    verdict.check(bool((steps > 0).all()), f"{source}: rows come twice, or out of order")
    if sequence[-1] >= len(sampled) or (steps <= 0).any():
        verdict.problems.append(f"{source}: rows that were never sampled")
        return
    sampled_rows = sampled[sequence]
    verdict.check(
        bool((sampled_rows["sequence"] == sequence).all()), f"{source}: its own count is broken"
    )
    verdict.check(
        np.array_equal(_pascal(sampled_rows), rows["pressure"]), f"{source}: other pressures"
    )
    commands = sampled_rows["status"] & 3
    verdict.check(np.array_equal(commands, rows["commands"]), f"{source}: other commands")
    marked = (quality[1:] & Quality.GAP) != 0
    verdict.check(
        np.array_equal(marked, steps > 1), f"{source}: gaps are not where rows are missing"
    )
    if boot:
        verdict.check(
            bool(quality[0] & Quality.GAP),
            f"{source}: what is missing before its first row is not marked",
        )
    offset = np.abs(rows["time_ns"] - sampled_rows["time_ns"]) * 1e-6
    worst = float(offset.max())
    verdict.counts["time_off_ms"] = max(verdict.counts.get("time_off_ms", 0.0), worst)
    # A clock that was set is seen with the next header; rows before it may have the new time.
    set_late = float(np.mean(offset > 200.0))
    verdict.check(set_late < 0.05, f"{source}: {100 * set_late:.1f} % of the times are wrong")


def _judge_twin(samples: Samples, ticks: Ticks, verdict: Verdict) -> None:
    """Check the expected pressure of each cycle that follows a whole one without a break."""
    suction = ticks["phase"] == Phase.SUCTION
    released = np.isin(ticks["phase"], (Phase.IDLE, Phase.BLOW_OFF))
    edges = np.flatnonzero(suction[1:] & released[:-1]) + 1
    breaks = np.flatnonzero(samples["quality"] & BREAK)
    worst, judged = 0.0, 0
    for before, begin, end in zip(edges[:-2], edges[1:-1], edges[2:], strict=True):
        if np.any((breaks >= before) & (breaks < end)):
            continue
        off = samples["pressure"][begin:end] - ticks["expected"][begin:end].astype(np.float64)
        worst, judged = max(worst, float(np.sqrt(np.mean(off**2))) / MBAR), judged + 1
        verdict.check(bool(np.isfinite(off).all()), "nothing is expected where it should be")
    verdict.counts |= {"cycles_judged": judged, "worst_rms_mbar": round(worst, 2)}
    verdict.check(judged > 0, "no cycle was left alone")
    verdict.check(worst < RIGHT_MBAR, f"a cycle after a whole one is {worst:.1f} mbar off")


def judge_growth(measurements: list[dict[str, float]], verdict: Verdict) -> None:
    """Check that the process at the end is as small as at the beginning."""
    early, late = (
        measurements[: max(len(measurements) // 5, 1)],
        measurements[-max(len(measurements) // 5, 1) :],
    )
    for name, allowed in (("threads", 0.0), ("files", 0.0), ("sockets", 0.0), ("mb", GROWTH_MB)):
        before = max(measurement[name] for measurement in early)
        after = min(measurement[name] for measurement in late)
        verdict.counts[f"{name}_before"], verdict.counts[f"{name}_after"] = before, after
        verdict.check(after <= before + allowed, f"{name} grew from {before:g} to {after:g}")


# --- the run --------------------------------------------------------------------------------------


def run(
    protocol: str, seconds: float, disturbances: int, seed: int, folder: Path
) -> tuple[Verdict, list[str]]:
    """Run it; gives the verdict and the disturbances."""
    random, verdict, done = np.random.default_rng(seed), Verdict(), list[str]()
    # Each kind equally often, in random order.
    kinds = [name for _ in range(disturbances) for name in DISTURBANCES]
    order = [str(name) for name in random.permutation(kinds[:disturbances])]
    with Cell(protocol, folder, random) as cell:
        until_logged(cell)
        end = time.monotonic() + seconds
        for number, name in enumerate(order):
            spare = end - time.monotonic() - SETTLED_S * (len(order) - number)
            pause = SETTLED_S + max(spare, 0.0) / (len(order) - number) * random.uniform(0.5, 1.0)
            _quiet(cell, pause)
            lasts = float(random.uniform(0.3, 4.0))
            done.append(f"{name} ({lasts:.1f} s)")
            print(f"{done[-1]}", file=sys.stderr, flush=True)
            DISTURBANCES[name](cell, lasts)
            verdict.check(cell.twin.is_running(), f"the twin ended at: {name}")
        _quiet(cell, max(end - time.monotonic(), SETTLED_S))
        verdict.check(_is_served(cell), "the results are not served any more")
        cell.twin.send_signal(signal.SIGINT)
        verdict.check(cell.twin.wait(60) == 130, "the twin did not end as it should")
        remaining = first_parts(cell.log.parent)
        verdict.check(len(remaining) == 1, f"what was not deleted is not one log: {remaining}")
        cell.restore_logs()
    judge(cell.log, cell.boots, verdict)
    judge_growth(cell.seen, verdict)
    return verdict, done


def until_logged(cell: Cell) -> None:
    """Wait until the twin logs rows; SystemExit with its output if it does not."""
    deadline = time.monotonic() + START_S
    while cell.rows() < 20_000:
        if time.monotonic() > deadline or cell.twin.poll() is not None:
            output = (cell.folder / "twin.txt").read_text()
            raise SystemExit(output or f"the twin logged nothing within {START_S:.0f} s")
        time.sleep(0.1)


def _is_served(cell: Cell) -> bool:
    try:
        return asyncio.run(served(cell.results_port))
    except (OSError, TimeoutError, ua.UaError):
        return False


def _quiet(cell: Cell, seconds: float) -> None:
    """Let everything run undisturbed, and record the size of the twin."""
    time.sleep(seconds)
    cell.watch()


def main() -> int:
    """Run from the command line; 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--protocol", choices=sorted(CONFIGS), default="modbus")
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--disturbances", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="kept; else a temporary one")
    arguments = parser.parse_args()
    with ExitStack() as stack:
        folder = arguments.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        verdict, actions = run(
            arguments.protocol, arguments.seconds, arguments.disturbances, arguments.seed, folder
        )
    answer = {"disturbances": len(actions), **verdict.counts, "problems": verdict.problems}
    print(json.dumps(answer, indent=1))
    return 1 if verdict.problems else 0


if __name__ == "__main__":
    sys.exit(main())
