"""Several ejectors in one process: on one PLC and on several, and what one does to the others."""

import itertools
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import psutil
import pytest
import rigs
import tomli_w
from command_line import twin
from modbus_server import CUT, SILENT, ModbusServer
from plc_process import PlcProcess, start_plc

from drivers.connection_pool import ConnectionPool
from drivers.modbus.client import ModbusClient
from drivers.modbus.line import Line, line_to
from drivers.modbus.settings import ModbusSettings
from drivers.opcua.settings import TraceNodes
from drivers.reconnect import LostError
from drivers.tags import Address
from twin.errors import SourceError
from twin.events import Kind
from twin.log.reader import Log, open_log
from twin.quality import BREAK
from twin.run_many import run_together

PATIENCE_S = 40.0
# What a log of a healthy run tells; on a busy machine a twin may be late, and says so.
HEALTHY = {Kind.CYCLE, Kind.CLOCK, Kind.TWIN_LATE}
TAGS = {
    "pressure": {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"}
}


# The threads.


def test_one_that_fails_does_not_stop_the_others() -> None:
    gone, told = threading.Event(), dict[str, str]()

    def refused() -> None:
        raise SourceError("the disk is full", "make space")

    def mistaken() -> None:
        raise ZeroDivisionError("of all things")

    def goes_on() -> None:
        assert gone.wait(10.0)  # until the other two are told of

    def tell(name: str, why: str) -> None:
        told[name] = why
        if len(told) == 2:
            gone.set()

    failed = run_together({"a": refused, "b": goes_on, "c": mistaken}, tell)
    assert sorted(failed) == ["a", "c"]
    assert told["a"] == "the disk is full\n  make space"
    assert "of all things" in told["c"]


# One connection for several.


def settings_for(server: ModbusServer, **changes: Any) -> ModbusSettings:
    table = {"host": "127.0.0.1", "port": server.port, "timeout_ms": 100, "tags": TAGS}
    return ModbusSettings.model_validate(table | changes)


@contextmanager
def sharing(server: ModbusServer, count: int = 2) -> Iterator[list[ModbusClient]]:
    lines, settings = ConnectionPool(), settings_for(server)
    links = [ModbusClient(settings, line_to(settings, lines)) for _ in range(count)]
    try:
        for link in links:
            link.open()
        yield links
    finally:
        for link in links:
            link.close()


@pytest.fixture
def server() -> Iterator[ModbusServer]:
    with ModbusServer() as one:
        one.areas[3][:] = np.arange(65536)
        yield one


def test_who_asks_the_same_plc_has_the_same_line(server: ModbusServer) -> None:
    lines = ConnectionPool()
    line = line_to(settings_for(server), lines)
    assert line_to(settings_for(server, unit=7), lines) is line
    assert line_to(settings_for(server, port=server.port % 60_000 + 1), lines) is not line
    assert line_to(settings_for(server, host="localhost"), lines) is not line


def test_who_asks_at_the_same_time_has_what_was_made_once() -> None:
    pool, ready = ConnectionPool(), threading.Barrier(4)
    made: list[object] = []

    def make() -> object:
        time.sleep(0.05)  # the others ask meanwhile
        made.append(object())
        return made[-1]

    def ask() -> object:
        ready.wait()
        return pool.shared(("acme", "there"), make)

    with ThreadPoolExecutor(4) as threads:
        shared = [asked.result() for asked in [threads.submit(ask) for _ in range(4)]]
    assert shared == made * 4
    assert len(made) == 1
    assert pool.shared(("acme", "elsewhere"), make) is not made[0]


def test_all_come_over_one_connection_and_each_gets_its_own_answer(server: ModbusServer) -> None:
    wrong: list[int] = []

    def ask(link: ModbusClient, first: int) -> None:
        for offset in range(first, first + 300):
            if link.read(Address("holding", offset), 3).tolist() != [
                offset,
                offset + 1,
                offset + 2,
            ]:
                wrong.append(offset)

    with sharing(server, 4) as links:
        threads = [
            threading.Thread(target=ask, args=(link, 1000 * number))
            for number, link in enumerate(links)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert wrong == []
    assert server.accepted == 1


def test_who_leaves_does_not_take_the_line_along(server: ModbusServer) -> None:
    with sharing(server) as (one, other):
        one.close()
        assert other.read(Address("holding", 5), 1) == 5
        one.open()
        assert one.read(Address("holding", 6), 1) == 6
    assert server.accepted == 1


@pytest.mark.parametrize("how", [CUT, SILENT])
def test_a_broken_line_is_lost_to_all_and_made_anew_once(server: ModbusServer, how: str) -> None:
    with sharing(server) as (one, other):
        server.hook = lambda *_: how
        with pytest.raises(LostError):
            one.read(Address("holding", 0), 1)
        server.hook = lambda *_: None
        with pytest.raises(LostError):  # an answer that comes late must not be taken for its own
            other.read(Address("holding", 0), 1)
        other.open()
        assert other.read(Address("holding", 7), 1) == 7
        one.close()  # as the loop does before it connects again
        assert other.read(Address("holding", 8), 1) == 8
        one.open()
        assert one.read(Address("holding", 9), 1) == 9
    assert server.accepted == 2


def test_a_unit_that_is_not_there_leaves_the_others_their_connection(server: ModbusServer) -> None:
    with sharing(server) as (one, other):
        server.hook = lambda *_: 11
        with pytest.raises(LostError, match="the unit does not answer"):
            one.read(Address("holding", 0), 1)
        server.hook = lambda *_: None
        assert other.read(Address("holding", 4), 1) == 4
    assert server.accepted == 1


def test_nobody_waits_for_the_tries_of_all() -> None:
    line, tries = Line(), list[int]()

    def connect() -> None:
        tries.append(1)
        raise LostError("no connection", "is it on?")

    for _ in range(5):
        with pytest.raises(LostError, match="no connection"):
            line.join(connect)
    assert len(tries) == 1
    line.failed_s -= 10.0
    with pytest.raises(LostError):
        line.join(connect)
    assert len(tries) == 2


# Whole.


def configured(
    folder: Path, name: str, unit_id: str, change: Callable[[dict[str, Any]], object]
) -> Path:
    """A shipped configuration as that of another ejector."""
    tables = tomllib.loads(rigs.path_of(name).read_text(encoding="utf-8"))
    tables["asset"]["id"] = unit_id
    tables["plc"]["program"]["start_ms"] = 300.0
    change(tables)
    path = folder / f"{unit_id.replace('/', ' ')}.toml"
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return path


def on(port: int, unit: int = 1) -> Callable[[dict[str, Any]], None]:
    def change(tables: dict[str, Any]) -> None:
        tables["driver"] |= {"port": port, "unit": unit}
        tables["plc"]["server"]["unit"] = unit

    return change


@contextmanager
def two_on_one(folder: Path) -> Iterator[tuple[PlcProcess, list[Path]]]:
    """A PLC with two ejectors behind it, and the configurations to reach it."""

    def on_port(port: int) -> list[Path]:
        names = ("test_rig", "gripper")
        return [
            configured(folder, name, name, on(port, unit)) for unit, name in enumerate(names, 1)
        ]

    first, second = on_port(1)
    with start_plc(first, str(second)) as plc:
        yield plc, on_port(plc.port)


@contextmanager
def running(*arguments: str | Path) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "twin.cli", "run", *map(str, arguments)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=rigs.ROOT, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def until(process: "subprocess.Popen[str]", reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


def rows(log: Path) -> int:
    try:
        return sum(len(samples) for samples, _ in open_log(log).blocks())
    except SourceError:  # not yet there, or its head not yet written
        return 0


def kinds(log: Log) -> set[Kind]:
    return {event.kind for event in log.events()}


@pytest.mark.slow
def test_several_ejectors_each_with_its_twin_and_log(tmp_path: Path) -> None:
    """Two on one PLC over one connection, and one on another PLC, which dies and comes back."""
    gripper = rigs.path_of("gripper")
    log = tmp_path / "run.mcap"
    with two_on_one(tmp_path) as (plc, beside), start_plc(gripper) as other:
        third = configured(tmp_path, "gripper", "far/away", on(other.port))
        logs = [tmp_path / f"run.{name}.mcap" for name in ("test_rig", "gripper", "far_away")]
        with running(*beside, third, "--log", log) as process:
            until(process, lambda: all(rows(path) > 500 for path in logs))
            connections = psutil.Process(process.pid).net_connections(kind="tcp")
            reached = [connection.raddr.port for connection in connections if connection.raddr]
            assert sorted(reached) == sorted([plc.port, other.port])
            other.kill()
            until(process, lambda: Kind.PLC_STALE in kinds(open_log(logs[2])))
            with start_plc(gripper, port=other.port):
                until(process, lambda: Kind.PLC_BACK in kinds(open_log(logs[2])))
                until(process, lambda: Kind.CYCLE in kinds(open_log(logs[0])))
                process.send_signal(signal.SIGINT)
                said, complaints = process.communicate(timeout=PATIENCE_S)
            assert process.returncode == 130, complaints
    opened = [open_log(path) for path in logs]
    assert all(log.complete for log in opened)
    assert [log.header.asset_id for log in opened] == ["test_rig", "gripper", "far/away"]
    for healthy in opened[:2]:
        assert kinds(healthy) <= HEALTHY
        assert not any((samples["quality"] & BREAK).any() for samples, _ in healthy.blocks())
    assert "far_away  alarm    plc_stale" in said
    assert "test_rig  info     cycle" in said
    assert len({log.header.metadata["data_set"] for log in opened}) == 2


def over_opcua(url: str, prefix: str, unit: int) -> Callable[[dict[str, Any]], None]:
    """Nodes below a prefix, as a server with several ejectors has them."""

    def change(tables: dict[str, Any]) -> None:
        tables["driver"]["url"] = url
        tables["plc"]["server"]["unit"] = unit
        tables["plc"]["opcua"] |= {"port": 0, "prefix": prefix}
        for tag in tables["driver"]["tags"].values():
            tag["node"] = tag["node"].replace("s=", f"s={prefix}")
        tables["driver"]["trace"] = {
            name: str(node).replace("s=", f"s={prefix}") for name, node in TraceNodes()
        }

    return change


@pytest.mark.slow
def test_several_ejectors_of_one_opc_ua_server(tmp_path: Path) -> None:
    names = ("left", "right")

    def at(url: str) -> list[Path]:
        return [
            configured(tmp_path, "test_rig_opcua", name, over_opcua(url, f"{name}.", unit))
            for unit, name in enumerate(names, 1)
        ]

    first, second = at("opc.tcp://127.0.0.1:1")
    with start_plc(first, str(second)) as plc:
        assert plc.process.stdout is not None
        url = plc.process.stdout.readline().strip().removeprefix("OPC UA on ")
        logs = [tmp_path / f"run.{name}.mcap" for name in names]
        with running(*at(url), "--log", tmp_path / "run.mcap") as process:
            until(process, lambda: all(rows(path) > 1500 for path in logs))
            process.send_signal(signal.SIGINT)
            _, complaints = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 130, complaints
    for name, log in zip(names, map(open_log, logs), strict=True):
        assert log.complete
        assert log.header.asset_id == name
        assert kinds(log) <= HEALTHY
        assert not any((samples["quality"] & BREAK).any() for samples, _ in log.blocks())
    left, right = (np.concatenate([rows for rows, _ in open_log(path).blocks()]) for path in logs)
    _, *same = np.intersect1d(left["sequence"], right["sequence"], return_indices=True)
    assert len(same[0]) > 1000  # scans that both have
    alike = left["pressure"][same[0]] == right["pressure"][same[1]]
    assert alike.mean() < 0.5  # each has the noise of its own rig


@pytest.mark.slow
def test_one_that_cannot_begin_leaves_the_others_and_is_exit_code_3(
    plc: PlcProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with ModbusServer() as gone:
        pass
    here = configured(tmp_path, "gripper", "here", on(plc.port))
    nowhere = configured(tmp_path, "gripper", "nowhere", on(gone.port))
    log = tmp_path / "a.mcap"
    assert twin(monkeypatch, "run", here, nowhere, "--log", log, "--once", "--duration", "1.5") == 3
    said = capsys.readouterr().err
    assert f"twin: nowhere: 127.0.0.1:{gone.port}: no connection" in said
    assert "1 of 2 ejectors failed: nowhere" in said
    assert open_log(tmp_path / "a.here.mcap").complete
    assert rows(tmp_path / "a.here.mcap") > 500
    assert not (tmp_path / "a.nowhere.mcap").exists()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@pytest.mark.slow
def test_plcs_that_are_off_when_the_twin_starts_are_read_once_they_are_on(tmp_path: Path) -> None:
    """By Modbus and by OPC UA, as after a power cut that the edge was the first to survive."""
    modbus, opcua = free_port(), free_port()

    def by_opcua(tables: dict[str, Any]) -> None:
        tables["driver"]["url"] = f"opc.tcp://127.0.0.1:{opcua}"
        tables["plc"]["opcua"]["port"] = opcua

    one = configured(tmp_path, "gripper", "one", on(modbus))
    two = configured(tmp_path, "test_rig_opcua", "two", by_opcua)
    logs = [tmp_path / "run.one.mcap", tmp_path / "run.two.mcap"]
    with running(one, two, "--log", tmp_path / "run.mcap") as process:
        assert process.stderr is not None
        told = {line.split(":")[1].strip() for line in said_of(process.stderr, "no connection", 2)}
        assert told == {"one", "two"}
        with start_plc(one, port=modbus), start_plc(two):
            until(process, lambda: all(rows(log) > 500 for log in logs))
            process.send_signal(signal.SIGINT)
            _, complaints = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, complaints
    assert "no connection" not in complaints  # it was said already
    for log in logs:
        assert open_log(log).complete
        assert kinds(open_log(log)) <= HEALTHY


@pytest.mark.slow
def test_a_twin_alone_waits_for_an_opc_ua_server_and_for_its_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """First nobody is there, then a server that starts and has other nodes so far, then the PLC."""
    port = free_port()

    def with_nodes(prefix: str) -> Callable[[dict[str, Any]], None]:
        def change(tables: dict[str, Any]) -> None:
            tables["driver"]["url"] = f"opc.tcp://127.0.0.1:{port}"
            tables["plc"]["opcua"] |= {"port": port, "prefix": prefix}

        return change

    whole = configured(tmp_path, "test_rig_opcua", "whole", with_nodes(""))
    starting = configured(tmp_path, "test_rig_opcua", "starting", with_nodes("Starting."))
    log = tmp_path / "run.mcap"
    with running(whole, "--log", log) as process:
        assert process.stderr is not None
        told = said_until(process.stderr, "it is tried until it answers")
        with start_plc(starting):
            assert twin(monkeypatch, "run", whole, "--once") == 3
            told += said_until(process.stderr, "there is no node")
        with start_plc(whole):
            until(process, lambda: rows(log) > 500)
            process.send_signal(signal.SIGINT)
            told += list(process.stderr)
            assert process.wait(PATIENCE_S) == 130, told
    assert "there is no node s=Trace.Sequence" in capsys.readouterr().err
    once = ("no connection", "it is tried until", "there is no node", "the PLC answers")
    assert [sum(what in line for line in told) for what in once] == [1, 1, 1, 1], told
    assert open_log(log).complete
    assert kinds(open_log(log)) <= HEALTHY


def said_until(stream: IO[str], what: str) -> list[str]:
    """Lines up to the first one with it."""
    lines = list[str]()
    while not lines or what not in lines[-1]:
        line = stream.readline()
        assert line, lines  # it has ended
        lines.append(line)
    return lines


def said_of(stream: IO[str], what: str, times: int) -> list[str]:
    """The first lines with it."""
    return list(itertools.islice((line for line in stream if what in line), times))


@pytest.mark.slow
def test_several_ejectors_are_viewed_in_one_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    target = tmp_path / "both.rrd"
    with two_on_one(tmp_path) as (_, beside):
        assert twin(monkeypatch, "run", *beside, "--rrd", target, "--duration", "1.5") == 0
    drawn = {piece.entity_path for piece in chunk.RrdReader(target).stream()}
    assert {"/test_rig/vacuum/measured", "/gripper/vacuum/expected", "/gripper/phase"} <= drawn
    assert capsys.readouterr().err == ""


def test_nothing_is_viewed_of_a_plc_that_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ModbusServer() as gone:
        pass
    target = tmp_path / "before.rrd"
    target.write_text("of yesterday")
    nowhere = configured(tmp_path, "gripper", "nowhere", on(gone.port))
    assert twin(monkeypatch, "run", nowhere, "--once", "--rrd", target) == 3
    assert target.read_text() == "of yesterday"


@pytest.mark.parametrize(
    ("options", "complaint"),
    [((), "are both of gripper-01"), (("--id", "x"), "--id is for one")],
)
def test_what_cannot_be_meant_for_several_is_exit_code_2(
    options: tuple[str, ...],
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    one = rigs.path_of("gripper")
    other = tmp_path / "other.toml"
    other.write_text(one.read_text())
    assert twin(monkeypatch, "run", one, other, *options) == 2
    assert complaint in capsys.readouterr().err


def test_two_ejectors_of_one_unit_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    both = (rigs.path_of("gripper"), rigs.path_of("test_rig"))
    assert twin(monkeypatch, "plc", *both, "--port", "0", "--duration", "1") == 2
    assert "two ejectors have the same unit" in capsys.readouterr().err
