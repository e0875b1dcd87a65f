"""Hardware in the loop: what the model answers, what of it is written, and that nothing else is."""

import logging
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
import tomli_w
from command_line import twin
from plc_process import PlcProcess, start_plc

from drivers.modbus import source as modbus
from drivers.modbus.client import ModbusClient
from drivers.modbus.hil import HilSettings, RegisterOutlet
from drivers.modbus.settings import ModbusSettings
from drivers.opcua.hil_settings import HilSettings as OpcuaHilSettings
from drivers.outputs.writer import Outputs, Writer
from drivers.plc.partner import LONGEST_PICK, NO_PART, PATIENCE, TRIPPED, PartnerTask
from drivers.plc.settings import PlcSettings
from drivers.reconnect import LostError
from drivers.tags import Address
from twin.errors import ConfigError, SourceError
from twin.hil import LONGEST_GAP_S, Plant, in_place
from twin.log.reader import open_log
from twin.model import kernel
from twin.model import theta as c
from twin.quality import Quality
from twin.settings import Document
from twin.signals import MBAR, Command, Samples, Signal

PATIENCE_S = 60.0
MODBUS, OPCUA = re.findall(r"```toml\n(.*?)```", (rigs.ROOT / "docs/hil.md").read_text(), re.DOTALL)
AIR = Outputs(101_325.0, False, False)


# The model as the plant.


def commanded(seconds: float = 8.0, name: str = "test_rig") -> Samples:
    return rigs.recorded(name, seconds)[0]


def free(name: str, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """The same by the kernel, in one piece."""
    theta = rigs.theta(name)
    dt = np.diff(samples["time_ns"], prepend=samples["time_ns"][:1]) * 1e-9
    phase, expected = np.empty(len(dt), np.uint8), np.empty(len(dt))
    state = kernel.at_rest(theta)
    kernel.simulate(state, theta, dt, samples["commands"].copy(), phase, expected)
    return expected, phase


@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("size", [1, 30, 777])
def test_it_runs_free_to_the_bit_however_blocks_are_cut(name: str, size: int) -> None:
    samples = commanded(8.0, name)[: 900 if size == 1 else None]
    plant = Plant(rigs.theta(name))
    parts = [plant.run(block) for block in rigs.cut(samples, size)]
    pressure, _ = (np.concatenate(column) for column in zip(*parts, strict=True))
    assert pressure.tobytes() == free(name, samples)[0].tobytes()


def test_h1_and_h2_are_those_of_the_data_set() -> None:
    samples, theta = commanded(), rigs.theta("test_rig")
    pressure, signals = Plant(theta).run(samples)
    vacuum = theta[c.AMBIENT] - pressure
    present = (signals & Signal.PART_PRESENT) != 0
    saving = (signals & Signal.AIR_SAVING) != 0
    assert present.any()
    assert saving.any()
    suction = samples["commands"] == Command.SUCTION  # blow-off reaches its own sensor first
    assert vacuum[present & suction].min() > theta[c.H2_LOW] - 5 * MBAR  # the sensor's lag apart
    assert vacuum[~present & suction].max() < theta[c.H2] + 5 * MBAR
    assert vacuum.max() == pytest.approx(theta[c.H1], abs=10 * MBAR)


@pytest.mark.parametrize(
    ("flag", "seconds", "anew"),
    [
        (Quality.GAP, 0.9 * LONGEST_GAP_S, False),
        (Quality.GAP, 1.1 * LONGEST_GAP_S, True),
        (Quality.RESTART, 1.0, True),
        (Quality.CLOCK, -1.0, True),
    ],
)
def test_where_commands_are_missing_it_goes_on_or_begins_anew(
    flag: Quality, seconds: float, anew: bool
) -> None:
    samples = commanded()[:2500].copy()  # to the end of suction
    samples["time_ns"][1500:] += round(seconds * 1e9)
    samples["quality"][1500] = flag
    pressure, _ = Plant(rigs.theta("test_rig")).run(samples)
    vacuum = (rigs.theta("test_rig")[c.AMBIENT] - pressure) / MBAR
    assert vacuum[1499] > 500
    assert (abs(vacuum[1500]) < 1.0) == anew
    if anew:
        assert vacuum[2499] > 500  # suction is still commanded


def test_nothing_new_is_nothing_to_answer() -> None:
    plant = Plant(rigs.theta("test_rig"))
    pressure, signals = plant.run(commanded()[:0])
    assert len(pressure) == len(signals) == 0


def test_the_newest_of_each_block_is_handed_out_before_the_block_goes_on() -> None:
    samples = commanded(4.0).copy()
    samples["quality"][100:200] = Quality.OVERFLOW | Quality.OUT_OF_RANGE
    samples["quality"][300] = Quality.GAP | Quality.BAD
    written: list[tuple[float, bool, bool]] = []
    closed: list[bool] = []

    def source() -> Iterator[Samples]:
        try:
            for number, block in enumerate([samples[:0], *rigs.cut(samples, 50)]):
                assert len(written) == max(number - 1, 0)
                yield block
        finally:
            closed.append(True)

    stream = in_place(source(), Plant(rigs.theta("test_rig")), lambda *one: written.append(one))
    rows = np.concatenate([block for block in stream if len(block) or not written])
    expected, _ = free("test_rig", samples)
    assert rows["pressure"].tobytes() == expected.astype(np.float32).tobytes()
    assert [outputs[0] for outputs in written] == expected[49::50].tolist()
    assert set(np.flatnonzero(rows["quality"])) == {300}
    assert rows["quality"][300] == Quality.GAP
    assert (rows["commands"] == samples["commands"]).all()
    assert any(outputs[1] for outputs in written)
    assert closed == [True]


# What is written: telegrams, groups, ranges.


def driver(port: int = 502, **changes: Any) -> ModbusSettings:
    table = tomllib.loads(rigs.path_of("test_rig").read_text())["driver"]
    return ModbusSettings.model_validate(table | {"host": "127.0.0.1", "port": port} | changes)


def hil(text: str = MODBUS, **tags: Any) -> HilSettings:
    table = tomllib.loads(text)["hil"]
    table["tags"] = {key: value for key, value in (table["tags"] | tags).items() if value}
    return HilSettings.model_validate(table)


def outlet(order: str = "big", **tags: Any) -> RegisterOutlet:
    to = driver(word_order=order)
    return RegisterOutlet(ModbusClient(to), to, hil(**tags).tags)


def f32(number: float) -> tuple[int, int]:
    return struct.unpack(">HH", struct.pack(">f", number))


def test_neighbours_go_in_one_request_the_watchdog_last() -> None:
    groups = outlet().groups(Outputs(45_678.0, True, False), 7)
    assert groups == [(Address("holding", 200), (*f32(456.78), 1, 0, 6))]


def test_the_low_word_first_where_the_plc_has_it_so() -> None:
    ((_, values),) = outlet("little").groups(Outputs(45_678.0, True, True), 7)
    assert values == (*f32(456.78)[::-1], 1, 1, 6)


LISTED = {"pressure": {200, 201}, "part_present": {202}, "air_saving": {203}, "watchdog": {204}}


@pytest.mark.parametrize("missing", LISTED)
def test_what_is_not_listed_is_not_written(missing: str) -> None:
    groups = outlet(**{missing: None}).groups(Outputs(45_678.0, True, True), 1)
    written = {address.offset + place for address, values in groups for place in range(len(values))}
    assert written == set().union(*LISTED.values()) - LISTED[missing]


def test_there_is_no_hole_that_would_be_written_over() -> None:
    apart = {"address": "holding:206", "type": "uint16"}
    groups = outlet(air_saving=apart).groups(AIR, 1)
    assert [address.offset for address, _ in groups] == [200, 206, 204]


def test_coils_are_written_as_bits() -> None:
    coils = {"part_present": {"address": "coil:16"}, "air_saving": {"address": "coil:17"}}
    groups = outlet(**coils).groups(Outputs(5e4, False, True), 1)
    assert (Address("coil", 16), (0, 1)) in groups


PLACE = {"address": "holding:200", "range": [0, 1200]}


@pytest.mark.parametrize(
    ("tag", "raw"),
    [
        ({"type": "int16", "unit": "mbar", "reference": "vacuum", "scale": 0.1}, 5566),
        ({"type": "uint16", "unit": "mbar", "reference": "absolute"}, 457),
        ({"type": "int16", "unit": "kPa", "reference": "gauge", "range": [-101, 0]}, -56 & 0xFFFF),
    ],
)
def test_a_pressure_is_written_as_the_plc_expects_it(tag: dict[str, Any], raw: int) -> None:
    one = outlet(pressure=PLACE | tag, part_present=None, air_saving=None, watchdog=None)
    ((_, (word,)),) = one.groups(Outputs(101_325.0 - 55_656.0, True, True), 1)
    assert word == raw


def test_beyond_the_range_its_end_is_written_and_that_is_said_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    tag = PLACE | {"type": "uint16", "unit": "mbar", "reference": "absolute", "range": [300, 1000]}
    one = outlet(pressure=tag, part_present=None, air_saving=None, watchdog=None)
    with caplog.at_level(logging.WARNING):
        words = [one.groups(Outputs(p * MBAR, True, True), 1)[0][1][0] for p in (200, 1100, 500)]
    assert words == [300, 1000, 500]
    assert len(caplog.records) == 1
    assert "200.0 mbar absolute" in caplog.text


def test_the_watchdog_counts_round_its_range() -> None:
    tag = {"address": "holding:204", "range": [3, 5]}
    one = outlet(watchdog=tag, pressure=None, part_present=None, air_saving=None)
    shown = [one.groups(AIR, blocks)[0][1][0] for blocks in range(1, 8)]
    assert shown == [3, 4, 5, 3, 4, 5, 3]


@pytest.mark.parametrize(
    ("tags", "why"),
    [
        ({"part_present": {"address": "input:3", "type": "uint16"}}, "cannot be written"),
        ({"part_present": {"address": "holding:3", "bit": 2}}, "takes a coil, or a register"),
        ({"air_saving": {"address": "discrete:3"}}, "cannot be written"),
        ({"pressure": {"address": "holding:1", "type": "float32", "unit": "mbar"}}, "reference"),
        (
            {"pressure": PLACE | {"range": None, "type": "int16", "unit": "mbar",
                                  "reference": "gauge"}},
            "needs its range",
        ),
        ({"watchdog": {"address": "holding:3", "range": [5, 5]}}, "low < high"),
        ({"supply": PLACE}, "Extra inputs"),
    ],
)  # fmt: skip
def test_what_cannot_be_written_is_refused(tags: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        hil(**tags)


def test_the_nodes_of_the_page_are_settings() -> None:
    tags = OpcuaHilSettings.model_validate(tomllib.loads(OPCUA)["hil"]).tags
    assert all(tag is not None for _, tag in tags)


# Whoever writes.


class Outlet:
    """Takes what is written, and fails as told."""

    def __init__(self) -> None:
        self.written: list[tuple[Outputs, int, float]] = []
        self.fails: list[Exception] = []
        self.opened = self.closed = 0

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None:
        self.closed += 1

    def write(self, outputs: Outputs, watchdog: int) -> None:
        if self.fails:
            raise self.fails.pop()
        self.written.append((outputs, watchdog, time.monotonic()))


def until(reached: Callable[[], object], patience_s: float = 10.0) -> None:
    deadline = time.monotonic() + patience_s
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_the_newest_is_written_and_no_more_often_than_allowed() -> None:
    to = Outlet()
    with Writer(to, "plc", 50.0) as writer:
        for number in range(200):
            writer.put(Outputs(float(number), True, False))
            time.sleep(0.001)
        until(lambda: to.written and to.written[-1][1] == 200)
    apart = np.diff([at for *_, at in to.written])
    assert apart.min() >= 0.049
    assert to.written[-1][0].pressure == 199.0
    assert to.closed == 1
    assert len(to.written) < 20


def test_nothing_is_written_that_was_not_put() -> None:
    to = Outlet()
    with Writer(to, "plc", 1.0) as writer:
        writer.put(AIR)
        until(lambda: to.written)
        time.sleep(0.1)
    assert [count for _, count, _ in to.written] == [1]


def test_a_plc_that_is_lost_is_written_to_again_when_it_is_back() -> None:
    to = Outlet()
    to.fails = [LostError("gone", "")]
    with Writer(to, "plc", 1.0) as writer:
        writer.put(AIR)
        until(lambda: to.closed)  # lost
        until(lambda: to.opened == 3)
        writer.put(AIR)
        until(lambda: to.written)
    assert to.written[0][1] == 2
    assert to.closed == 2


def test_a_plc_that_refuses_ends_the_run() -> None:
    to = Outlet()
    to.fails = [SourceError("holding:200: illegal data address", "")]
    with Writer(to, "plc", 1.0) as writer:
        writer.put(AIR)
        until(lambda: to.closed)
        with pytest.raises(SourceError, match="illegal data address"):
            writer.put(AIR)
    assert to.written == []


# The partner.


def partner(**program: Any) -> PartnerTask:
    tables = {"start_ms": 100, "suction_ms": 200, "blow_off_ms": 50, "idle_ms": 80} | program
    return PartnerTask(PlcSettings.model_validate({"program": {"commands": "hil"} | tables}))


def fed(task: PartnerTask, scans: int, **written: float) -> np.ndarray:
    """Scans with a watchdog that counts every 30 of them."""
    status = []
    for name, value in written.items():
        setattr(task.written, name, value)
    for _ in range(scans // 30):
        task.written.watchdog = (task.written.watchdog + 1) % 65_536
        status.append(task.compute(30)[0]["status"])
    return np.concatenate(status)


def test_without_a_twin_nothing_is_commanded() -> None:
    scans, _ = partner().compute(3000)
    assert (scans["status"] == TRIPPED).all()
    assert scans["pressure"][0] == 1013.0


def test_the_program_waits_for_the_part() -> None:
    task = partner()
    waiting = fed(task, 1200)
    assert (waiting[100:] == Command.SUCTION).all()
    going_on = fed(task, 330, part_present=1)
    assert [int(value) for value in going_on[[0, 199, 201, 249, 251, 329]]] == [1, 1, 2, 2, 0, 0]


def test_a_part_that_does_not_come_is_given_up() -> None:
    status = fed(partner(), LONGEST_PICK + 600)
    assert (status[110:LONGEST_PICK] == Command.SUCTION).all()
    assert (status & NO_PART).any()


def test_a_watchdog_that_stands_still_drops_the_commands_until_it_counts_again() -> None:
    task = partner()
    fed(task, 300)
    status = task.compute(2000)[0]["status"]
    assert (status[: PATIENCE - 60] == Command.SUCTION).all()
    assert (status[PATIENCE:] == TRIPPED).all()
    again = fed(task, 300)
    assert not (again & TRIPPED).any()
    assert again[0] == 0  # from idle on
    assert again[-1] == Command.SUCTION


# At the wire.


class Tap:
    """A proxy that keeps all that the client sends."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.sent: list[bytearray] = []
        self._sockets: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            server = socket.create_connection(("127.0.0.1", self._target))
            self.sent.append(bytearray())
            self._sockets += [client, server]
            for ends, kept in (((client, server), self.sent[-1]), ((server, client), None)):
                self._threads.append(threading.Thread(target=self._pass, args=(*ends, kept)))
                self._threads[-1].start()

    def _pass(self, source: socket.socket, to: socket.socket, kept: bytearray | None) -> None:
        with suppress(OSError):
            while data := source.recv(65_536):
                if kept is not None:
                    kept += data
                to.sendall(data)
        with suppress(OSError):
            to.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self._sockets:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for connection in self._sockets:
            connection.close()


def modbus_requests(sent: bytearray) -> list[tuple[int, int]]:
    """Function code and address of each request."""
    requests, at = [], 0
    while at + 12 <= len(sent):
        *_, length, _, function, address = struct.unpack_from(">HHHBBH", sent, at)
        requests.append((function, address))
        at += 6 + length
    return requests


# NodeIds of their binary encodings
READ_REQUEST, WRITE_REQUEST, PUBLISH_REQUEST = 631, 673, 826


def opcua_services(sent: bytearray) -> list[int]:
    """NodeId of the type of each request, over a channel that is not secured."""
    services, at = [], 0
    while at + 8 <= len(sent):
        kind, size = bytes(sent[at : at + 3]), struct.unpack_from("<I", sent, at + 4)[0]
        if kind == b"MSG":
            encoding, _, number = struct.unpack_from("<BBH", sent, at + 24)
            assert encoding == 1  # four bytes
            services.append(number)
        at += size
    return services


def configured(folder: Path, name: str, change: Callable[[dict[str, Any]], object]) -> Path:
    """A shipped configuration with the page's tables for hardware in the loop."""
    tables = tomllib.loads(rigs.path_of(name).read_text(encoding="utf-8"))
    tables |= tomllib.loads(OPCUA if name == "test_rig_opcua" else MODBUS)
    tables["plc"]["program"] |= {
        "commands": "hil", "start_ms": 200.0, "suction_ms": 400.0, "idle_ms": 400.0,
    }  # fmt: skip
    tables["driver"]["interval_ms"] = 10
    change(tables)
    path = folder / f"{name}.toml"
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return path


@contextmanager
def partner_plc(folder: Path, name: str) -> Iterator[tuple[PlcProcess, int]]:
    """A running partner, and the port of its protocol."""

    def free_port(tables: dict[str, Any]) -> None:
        if name == "test_rig_opcua":
            tables["plc"]["opcua"]["port"] = 0

    with start_plc(configured(folder, name, free_port)) as plc:
        port = plc.port
        if name == "test_rig_opcua":
            assert plc.process.stdout is not None
            port = int(plc.process.stdout.readline().strip().rpartition(":")[2])
        yield plc, port


@contextmanager
def running(*arguments: str | Path) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "twin.cli", "run", *map(str, arguments)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=rigs.ROOT, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def poll_mode(tables: dict[str, Any]) -> None:
    tables["driver"] |= {"mode": "poll"}


@pytest.mark.slow
@pytest.mark.parametrize("change", [lambda _: None, poll_mode], ids=["block", "poll"])
def test_beside_a_plc_only_reading_function_codes_are_sent(
    change: Callable[[dict[str, Any]], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In shadow mode, although the configuration lists what may be written."""
    config = configured(tmp_path, "test_rig", change)
    with start_plc(config) as plc, closing(Tap(plc.port)) as tap:
        address = ("--address", f"127.0.0.1:{tap.port}")
        assert twin(monkeypatch, "run", config, *address, "--duration", "1.5") == 0
        assert twin(monkeypatch, "probe", config, *address) in (0, 3)
    requests = [request for sent in tap.sent for request in modbus_requests(sent)]
    assert len(requests) > 100
    assert {function for function, _ in requests} <= {1, 2, 3, 4}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "asked"), [("block", READ_REQUEST), ("subscribe", PUBLISH_REQUEST)]
)
def test_beside_an_opcua_server_no_write_is_sent(
    mode: str, asked: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with partner_plc(tmp_path, "test_rig_opcua") as (_, port), closing(Tap(port)) as tap:
        config = configured(
            tmp_path, "test_rig_opcua", lambda tables: tables["driver"].update(mode=mode)
        )
        command = ("run", config, "--address", f"127.0.0.1:{tap.port}", "--duration")
        assert twin(monkeypatch, *command, "2") == 0
        services = [service for sent in tap.sent for service in opcua_services(sent)]
        assert services.count(asked) > 20
        assert WRITE_REQUEST not in services
        assert twin(monkeypatch, *command, "2", "--hil") == 0  # that the tap would have seen it
        assert WRITE_REQUEST in [service for sent in tap.sent for service in opcua_services(sent)]


@pytest.mark.slow
def test_in_the_loop_only_what_is_listed_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fewer(tables: dict[str, Any]) -> None:
        del tables["hil"]["tags"]["air_saving"]

    config = configured(tmp_path, "test_rig", fewer)
    with start_plc(config) as plc, closing(Tap(plc.port)) as tap:
        command = ("run", config, "--address", f"127.0.0.1:{tap.port}", "--hil")
        assert twin(monkeypatch, *command, "--duration", "2") == 0
    first, *rest = tap.sent
    assert {code for code, _ in modbus_requests(first)} == {3}  # it only asks whether it answers
    (shared,) = rest  # reading and writing share the connection
    requests = set(modbus_requests(shared))
    assert {request for request in requests if request[0] > 4} == {(16, 200), (16, 204)}
    assert 3 in {code for code, _ in requests}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "code", "complaint"),
    [
        (lambda tables: tables.pop("hil"), 2, "nothing is listed under [hil.tags]"),
        (lambda tables: tables["hil"].update(tags={}), 2, "nothing is listed"),
        (lambda tables: tables["hil"]["tags"]["pressure"].pop("range"), 2, "needs its range"),
        (
            lambda tables: tables["hil"]["tags"]["watchdog"].update(address="holding:300"),
            3,
            "holding:300",
        ),
    ],
)
def test_what_cannot_be_in_the_loop_is_said(
    change: Callable[[dict[str, Any]], object],
    code: int,
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = configured(tmp_path, "test_rig", change)
    with start_plc(config) as plc:
        address = ("--address", f"127.0.0.1:{plc.port}")
        command = ("run", config, *address, "--hil", "--log", tmp_path / "a.mcap")
        assert twin(monkeypatch, *command, "--duration", "3") == code
    assert complaint in capsys.readouterr().err
    assert (tmp_path / "a.mcap").exists() == (code == 3)


# The whole loop, in three processes.


def observed(port: int, picks: int) -> Samples:
    """What the PLC has in its trace until suction has begun so often: what it commanded and saw."""
    end = time.monotonic() + PATIENCE_S
    rows: list[Samples] = []
    with closing(modbus.blocks(driver(port))) as source:
        for block in source:
            rows.append(block)
            if len(suction_starts(np.concatenate(rows))) >= picks or time.monotonic() > end:
                break
    return np.concatenate(rows)


def suction_starts(samples: Samples) -> np.ndarray:
    """The rows before which suction was off and at which it is on, shape (picks,)."""
    return np.flatnonzero(np.diff((samples["commands"] & Command.SUCTION).astype(int)) == 1)


def latency_ms(model: Samples, plc: Samples) -> np.ndarray:
    """From each of the PLC's commands to the first pressure there that answers it, in scans."""
    falls = np.flatnonzero(np.diff(model["pressure"]) < -30.0)  # Pa in a ms: no two rows alike
    rows, fallen = model["sequence"][falls], model["pressure"][falls]
    pairs = []
    for at in np.flatnonzero(np.diff(plc["pressure"]) < 0) + 1:
        scan, value = int(plc["sequence"][at]), float(plc["pressure"][at])
        near = np.flatnonzero((rows < scan) & (rows > scan - 500) & (abs(fallen - value) < 0.1))
        if len(near):
            pairs.append((int(rows[near[-1]]), scan))
    answered, when = np.array(pairs).T
    late = []
    for before, row, scan in zip(answered[:-1], answered[1:], when[1:], strict=True):
        if 0 < row - before < 200:  # in one evacuation
            late += [scan - command for command in range(before + 1, row + 1)]
    return np.array(late)


def status(port: int, unit: int = 1) -> int:
    """Its commands, asked again where a PLC has no time to answer: the computer may be busy."""
    end = time.monotonic() + PATIENCE_S
    while True:
        link = ModbusClient(driver(port).model_copy(update={"unit": unit}))
        link.open()
        with closing(link):
            try:
                return int(link.read(Address("input", 4), 1)[0])
            except LostError:
                assert time.monotonic() < end


def commands(port: int, unit: int) -> int:
    """The same, asked no more often than a PLC has time to answer."""
    time.sleep(0.05)
    return status(port, unit)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["test_rig", "test_rig_opcua"])
def test_a_plcs_program_runs_on_the_models_answers(name: str, tmp_path: Path) -> None:
    """Its picks wait for H2; when the twin is killed, its watchdog drops everything."""
    with partner_plc(tmp_path, name) as (plc, port):
        log = tmp_path / "a.mcap"
        command = (tmp_path / f"{name}.toml", "--address", f"127.0.0.1:{port}", "--hil")
        assert status(plc.port) == TRIPPED
        with running(*command, "--log", log) as process:
            until(lambda: status(plc.port) == Command.SUCTION, PATIENCE_S)
            seen = observed(plc.port, 4)
            assert process.poll() is None, process.communicate()
            process.kill()
            process.wait()
            until(lambda: status(plc.port) == TRIPPED, 1.5)
            with running(*command) as again:  # and goes on with the next one
                until(lambda: status(plc.port) == Command.SUCTION, PATIENCE_S)
                again.send_signal(signal.SIGINT)
                assert again.wait(PATIENCE_S) == 130
    suction = (seen["commands"] & Command.SUCTION).astype(int)
    picks = suction_starts(seen)[1:]
    assert len(picks) >= 3
    written = open_log(log)
    assert "model's own" in written.header.metadata["hil"]
    model = np.concatenate([samples for samples, _ in written.blocks()])
    late = latency_ms(model, seen)
    logging.info("%s: ms: %s of %d", name, np.quantile(late, [0.5, 0.95, 1.0]), len(late))
    assert len(late) > 300
    assert np.median(late) < 60
    # The program went on when it saw part present, and held the part for 400 scans more.
    _, signals = Plant(rigs.theta("test_rig")).run(model)
    present = model["sequence"][1:][np.diff((signals & Signal.PART_PRESENT).astype(int)) == 1]
    for start in picks[:-1]:
        end = start + int(np.flatnonzero(np.diff(suction[start:]) == -1)[0])
        saw = int(seen["sequence"][end]) - 400
        assert 0 <= saw - present[present <= saw][-1] < 200


@pytest.mark.slow
def test_two_ejectors_of_one_plc_are_each_in_the_loop_with_a_model_of_their_own(
    tmp_path: Path,
) -> None:
    def behind(port: int) -> list[Path]:
        paths = []
        for unit, system in enumerate(("test_rig", "gripper"), 1):

            def change(tables: dict[str, Any], unit: int = unit) -> None:
                tables["driver"] |= {"port": port, "unit": unit}
                tables["plc"]["server"]["unit"] = unit

            paths.append(configured(tmp_path, system, change))
        return paths

    first, second = behind(1)
    with start_plc(first, str(second)) as plc:
        assert [status(plc.port, unit) for unit in (1, 2)] == [TRIPPED, TRIPPED]
        with running(*behind(plc.port), "--hil", "--log", tmp_path / "a.mcap") as process:
            for unit in (1, 2):  # each program goes on when it sees its part present
                until(lambda unit=unit: commands(plc.port, unit) == Command.SUCTION, PATIENCE_S)
                until(lambda unit=unit: commands(plc.port, unit) == Command.BLOW_OFF, PATIENCE_S)
            process.send_signal(signal.SIGINT)
            _, complaints = process.communicate(timeout=PATIENCE_S)
            assert process.returncode == 130, complaints
    for system in ("test_rig", "gripper"):
        log = open_log(tmp_path / f"a.{rigs.config(system).asset.id}.mcap")
        rows = np.concatenate([samples for samples, _ in log.blocks()])
        anew, _ = Plant(rigs.theta(system)).run(rows)
        assert anew.astype(np.float32).tobytes() == rows["pressure"].tobytes()


@pytest.mark.slow
def test_the_log_of_a_loop_replays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, log = configured(tmp_path, "test_rig", lambda _: None), tmp_path / "a.mcap"
    with start_plc(config) as plc:
        command = ("run", config, "--address", f"127.0.0.1:{plc.port}", "--hil")
        assert twin(monkeypatch, *command, "--log", log, "--duration", "6") == 0
    assert twin(monkeypatch, "replay", log, "-o", tmp_path / "b.mcap") == 0
    first, again = (
        [rows.tobytes() for pair in open_log(tmp_path / name).blocks() for rows in pair]
        for name in ("a.mcap", "b.mcap")
    )
    assert first == again
    rows = np.concatenate([samples for samples, _ in open_log(log).blocks()])
    plant = Plant(rigs.theta("test_rig"))
    anew, _ = plant.run(rows)
    assert anew.astype(np.float32).tobytes() == rows["pressure"].tobytes()


def test_hil_needs_its_table_in_the_configuration() -> None:
    from drivers.outputs.open import open_writer

    with pytest.raises(ConfigError, match=r"hil\.tags"):
        open_writer(Document.read(rigs.path_of("test_rig")))
