"""Targets of the fuzzer: each decoder of foreign bytes, with valid examples.

A target returns what came of an input, in one of few texts: a new one makes the input worth
keeping. A TwinError is an answer as good as any.
"""

import asyncio
import atexit
import json
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache, partial
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import h11
import numpy as np
from argon2 import PasswordHasher
from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import from_binary, to_binary
from pymodbus.client import ModbusTcpClient
from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.bit_message import ReadCoilsResponse, WriteMultipleCoilsResponse
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersResponse,
    WriteMultipleRegistersResponse,
)

from drivers.modbus.client import READING, ModbusClient
from drivers.modbus.plan import Request
from drivers.modbus.poll import Poller
from drivers.modbus.poll_socket import PollSocket
from drivers.modbus.ring import Trace
from drivers.modbus.settings import ModbusSettings
from drivers.opcua import values as opcua_values
from drivers.opcua.bounds import refuse_endless_arrays
from drivers.opcua.settings import Node
from drivers.reconnect import Clock
from drivers.sources import settings_of
from drivers.tags import Address, Words
from twin.assets.exchange import parse_export, to_export
from twin.assets.record import Record, checked
from twin.assets.unit import Unit
from twin.audit import Audit
from twin.cli.assets import _read_json
from twin.config import SHIPPED, Config
from twin.errors import SourceError
from twin.events import Event, Kind
from twin.exchange.aas import read_package, write_package
from twin.exchange.fmu_file import DESCRIPTION, read_fmu
from twin.files import json_text
from twin.log.header import RECORDED, LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.login import Authenticator
from twin.notifications.message import asset_of, beside, of_status
from twin.notifications.upload_requests import REQUEST_FORMAT, parse
from twin.page.app import COOKIE, Access, Page
from twin.page.ejector import Ejector
from twin.page.ejector_status import S_NS
from twin.page.plant_overview import PlantOverview
from twin.page.plant_overview_text import details, of_one, overview
from twin.page.recorded import RecordedRows
from twin.page.sessions import SESSION_S, Session, Sessions
from twin.settings import Document
from twin.signals import SAMPLE, TICK
from twin.tables.export import export
from twin.tables.reader import open_table
from twin.tables.settings import ImportSettings
from twin.users import Role, Users

NODE = Node("s=Fuzz")
CONFIG = Document.read(Path(__file__).resolve().parents[1] / "configs" / "test_rig.toml")
HEADER, RECORDS = 100, 1000  # addresses of the trace in CONFIG
DEPTH_BLOCKS = 4  # readings of the ring with one input
AMBIENT = 101_325.0  # Pa
WORD, TOKEN = "correct horse", "t" * 43  # of a user, and of a session
CHEAP = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)
READS = [Request(Address("holding", 100), 2), Request(Address("coil", 0), 9)]
WRITES = [(Address("holding", 7), (1, 2)), (Address("coil", 3), (1, 0, 1))]
LEVELS = "compact-ejector-35", "rig-01"  # of the topics of one ejector


class Served:
    """A link that answers from an input, cyclically."""

    def __init__(self, data: bytes) -> None:
        self._words = np.frombuffer(data[: len(data) // 2 * 2] or b"\0\0", ">u2").astype(np.uint16)
        self._next = 0

    def read(self, address: Address, number: int) -> Words:
        """As ``Link.read``; an address that no request can hold is a mistake."""
        READING[address.area](1, 0, address.offset, number).encode()
        indices = np.arange(self._next, self._next + number) % len(self._words)
        self._next += number
        return self._words[indices]


@cache
def _settings() -> ModbusSettings:
    settings = settings_of(CONFIG)
    assert isinstance(settings, ModbusSettings)
    return settings


class Honest:
    """A link to a PLC whose trace grows with each read; it keeps its answers."""

    def __init__(self) -> None:
        self.answers, self._newest = b"", 99

    def read(self, address: Address, number: int) -> Words:
        """As ``Link.read``."""
        words = self._records(address.offset - RECORDS, number)
        if address.offset == HEADER:
            self._newest += 40
            fields = self._newest, 10**18 + self._newest * 10**6, 7, 1000, 4096, 4, 5000, 0
            words = np.frombuffer(struct.pack(">IqHHHHhH", *fields), ">u2")
        self.answers += words.astype(">u2").tobytes()
        return words.astype(np.uint16)

    def _records(self, first: int, number: int) -> Any:
        """Words of the ring from ``first`` on: number of the scan, status, pressure."""
        slots = np.arange(first // 4, (first + number + 3) // 4)
        scans = self._newest - (self._newest - slots) % 4096
        rows = [struct.pack(">HHf", scan & 0xFFFF, 0, 900.0) for scan in scans.tolist()]
        return np.frombuffer(b"".join(rows), ">u2")[first % 4 :][:number]


def ring(data: bytes) -> str:
    """The trace over Modbus."""
    return f"{_some(_followed(Served(data)))} rows"


def _some(number: int) -> str:
    return "some" if number else "no"


def _followed(link: object) -> int:
    ticks = count(step=5_000_000)  # so that a fetch is over soon
    clock = Clock(lambda: 0, lambda: next(ticks), lambda _seconds: None)
    trace, rows = Trace(_settings(), clock), 0
    trace._header = trace.start(link)  # type: ignore[arg-type]
    for _ in range(DEPTH_BLOCKS):
        rows += len(trace._read(link))  # type: ignore[arg-type]
    return rows


def values(data: bytes) -> str:
    """A value over OPC UA, decoded as each kind that a node may have."""
    refuse_endless_arrays()
    try:
        value = from_binary(ua.DataValue, Buffer(data))
    except Exception as error:  # the library's; the link makes a lost connection of it
        return type(error).__name__
    kinds: list[Callable[[ua.DataValue, Node], object]] = [
        opcua_values.number,
        opcua_values.whole,
        opcua_values.moment,
        opcua_values.numbers,
        opcua_values.wholes,
    ]
    accepted = ""
    for kind in kinds:
        try:
            kind(value, NODE)
            accepted += kind.__name__ + " "
        except SourceError:
            continue
    opcua_values.quality(opcua_values.code_of(value))
    opcua_values.time_ns(value)
    return accepted


class Wire:
    """A socket that sends an input, and then closes."""

    def __init__(self, data: bytes) -> None:
        self._rest = data

    def sendall(self, _request: bytes) -> None:
        """Ignore the request."""

    def recv(self, size: int, _flags: int = 0) -> bytes:
        """The next bytes."""
        chunk, self._rest = self._rest[:size], self._rest[size:]
        return chunk

    def close(self) -> None:
        """Hang up."""
        self._rest = b""


class WiredClient(ModbusTcpClient):
    """pymodbus' client on a wire that sends an input, answer by answer."""

    def __init__(self, data: bytes) -> None:
        super().__init__("", retries=0)
        self._wire = Wire(data)
        self.socket = self._wire  # type: ignore[assignment]

    def send(self, request: bytes, addr: tuple[str, int] | None = None) -> int:
        """Ignore the request."""
        return len(request)

    def recv(self, _size: int | None) -> bytes:
        """The next answer, as long as its head says."""
        head = self._wire.recv(6)
        return head + self._wire.recv(int.from_bytes(head[4:6], "big"))


def modbus(data: bytes) -> str:
    """Answers over Modbus to reads and writes."""
    link = ModbusClient(_settings())
    link._connection = link._line.connection = WiredClient(data)
    outcome = ""
    for ask in (
        *(partial(link.read, request.address, request.count) for request in READS),
        *(partial(link.write, *write) for write in WRITES),
    ):
        outcome += _outcome(ask)
    return outcome


def poll_socket(data: bytes) -> str:
    """Answers over Modbus to reads, as they come from the socket of polling."""
    link = PollSocket(_settings())
    link._socket = Wire(data)  # type: ignore[assignment]
    return "".join(_outcome(partial(link.ask, request)) for request in READS)


def _outcome(ask: Callable[[], object]) -> str:
    try:
        ask()
    except SourceError as error:
        return f" {type(error).__name__}"
    return " answered"


class Answering:
    """A link that answers each request of polling from an input, cyclically."""

    def __init__(self, data: bytes) -> None:
        self._data, self._next = data or b"\0", 0

    def ask(self, request: Request) -> bytes:
        """As ``Link.ask``."""
        indices = (self._next + np.arange(request.size)) % len(self._data)
        self._next += request.size
        return np.frombuffer(self._data, np.uint8)[indices].tobytes()


@cache
def _polled() -> ModbusSettings:
    table = dict(CONFIG.tables["driver"]) | {"mode": "poll", "interval_ms": 5}
    return ModbusSettings.model_validate(table)


def poll(data: bytes) -> str:
    """Values that are polled over Modbus."""
    ticks = count(step=300_000)
    clock = Clock(lambda: 0, lambda: next(ticks), lambda _seconds: None)
    rows = Poller(_polled(), clock)._block(Answering(data))  # type: ignore[arg-type]
    return f"quality {np.unique(rows['quality']).tolist()}"


@contextmanager
def _file(data: bytes, suffix: str) -> Iterator[Path]:
    with tempfile.NamedTemporaryFile(suffix=suffix) as file:
        file.write(data)
        file.flush()
        yield Path(file.name)


def log(data: bytes) -> str:
    """A log."""
    with _file(data, ".mcap") as path:
        opened = open_log(path)
        rows = sum(len(samples) for samples, _ in opened.blocks(1000))
        return f"{_some(rows)} rows, {_some(len(list(opened.events())))} events"


def curve(data: bytes) -> str:
    """A log as the page reads it: by its index, some chunks at a time."""
    with _file(data, ".mcap") as path:
        logs = path.with_suffix("")
        logs.mkdir()
        try:
            shutil.copyfile(path, logs / "a.mcap")
            recorded = RecordedRows(lambda: [logs], ("type", "id"))
            found = recorded.read(10**18 - S_NS, 10**18 + S_NS, 1_000_000)
        finally:
            shutil.rmtree(logs)
    return f"{_some(len(found.bins))} bins, {_some(found.damaged)} damaged"


def head(data: bytes) -> str:
    """The head of a log with a right checksum: configuration, data set, statistics."""
    config, stored, healthy, *_ = [*data.decode(errors="replace").split("\0"), "", ""]
    metadata = {"data": stored, "healthy": healthy}
    config_read = Config.of_recorded(LogHeader("type", "id", "a.toml", config, metadata), "a.mcap")
    return f"gauge {config_read.is_gauge}"


def _table(data: bytes, suffix: str) -> str:
    marking = ImportSettings(values="mark", jumps="mark", gaps="mark")
    with _file(data, suffix) as path:
        table = open_table(path, marking, AMBIENT, derive=b"suction" not in data)
        rows = sum(len(block) for block in table.blocks())
        return f"{_some(rows)} rows, {len(table.layout.lacking)} lacking"


def csv(data: bytes) -> str:
    """A table as text."""
    return _table(data, ".csv")


def parquet(data: bytes) -> str:
    """A table as Parquet."""
    return _table(data, ".parquet")


@cache
def _package() -> dict[str, bytes]:
    """The parts of a package with a data set."""
    record = checked(Record("type", "vs-40", "vs-40", {"ejector": {"bulge": 0.1}}))
    with zipfile.ZipFile(
        BytesIO(write_package([replace(record, id="0" * 32)], 0, {}, ""))
    ) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _packed(parts: dict[str, bytes]) -> bytes:
    content = BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, part in parts.items():
            archive.writestr(zipfile.ZipInfo(name), part)
    return content.getvalue()


def aasx(data: bytes) -> str:
    """A package with shells; input that is no ZIP file becomes the shells of a valid package."""
    if not data.startswith(b"PK"):
        data = _packed({**_package(), _shells(): data})
    with _file(data, ".aasx") as path:
        return f"{_some(len(read_package(path).document['records']))} records"


def _shells() -> str:
    return next(name for name in _package() if name.endswith((".xml", ".json")) and "aas" in name)


def fmu(data: bytes) -> str:
    """An FMU; input that is no ZIP file becomes its description."""
    if not data.startswith(b"PK"):
        data = _packed({DESCRIPTION: data})
    with _file(data, ".fmu") as path:
        return f"{len(read_fmu(path).ways)} ways"


def assets(data: bytes) -> str:
    """Data sets of another database, as JSON."""
    with _file(data, ".json") as path:
        return f"{_some(len(parse_export(_read_json(path))))} records"


def users(data: bytes) -> str:
    """A file of users."""
    with _file(data, ".toml") as path:  # its owner's alone
        stored = Users(path, CHEAP)
        return f"{_some(len(stored.names))} users, {stored.role('ann')} {bool(stored.proof('ann'))}"


def mqtt(data: bytes) -> str:
    """Messages of ejectors over a broker: topic and text in each line."""
    hall = PlantOverview(lambda: 1.8e9)
    hall.connected()
    for line in data.split(b"\n"):
        topic, _, payload = line.partition(b" ")
        levels = topic.decode(errors="replace").split("/")
        hall.take(levels, payload, kept=False)
    target = Unit(*LEVELS)

    def show(heard: Any, why: str, since: float) -> str:
        json.dumps(overview(heard, why, since, 1.8e9), allow_nan=False)
        if (ejector := of_one(heard, target)) is None:
            return f"{_some(len(heard))} others"
        page_details = details(ejector, why, 1.8e9)
        json.dumps(page_details, allow_nan=False)
        return " ".join(f"{_some(len(part))} {name}" for name, part in _lists(page_details).items())

    return f"{hall.look(show)}, {_some(hall.not_understood)} trouble"


def _lists(page_details: dict[str, Any]) -> dict[str, list[Any]]:
    return {name: part for name, part in page_details.items() if isinstance(part, list)}


def upload(data: bytes) -> str:
    """A request for logs over a broker."""
    return parse(data).format


class Deaf(Ejector):
    """An ejector of a page that stores nothing and has no listener."""

    def ask(self, alarm: str, action: str, who: str, seconds: float) -> int:
        """As a database would take it."""
        return len(json.dumps([alarm, action, who, seconds], ensure_ascii=False).encode())


def _ejector(folder: Path) -> Ejector:
    path = folder / "cell.toml"
    tables = [f"[{name}]\nkeep = true\n" for name in ("alarms", "figures", "page")]
    path.write_text("".join([CONFIG.text, *tables]))
    return Deaf(Config.of(Document.read(path), SHIPPED))


@cache
def _page() -> Any:
    """The page with a user who is logged in."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-page-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    users_known = Users(folder / "users.toml", CHEAP)
    users_known.add("ann", WORD, Role.CONFIGURE)
    sessions = Sessions(users_known, lambda: 0.0)
    sessions._by_token[TOKEN] = Session("ann", users_known.proof("ann"), SESSION_S, TOKEN)
    authenticator = Authenticator(users_known, Audit(folder, "page", print))
    return Page([_ejector(folder)], authenticator, sessions, Access(), PlantOverview()).app()


def http(data: bytes) -> str:
    """A request to the page, as it comes from the socket."""
    server = h11.Connection(h11.SERVER)
    try:
        server.receive_data(data)
        server.receive_data(b"")
        request, body = server.next_event(), b""
        while isinstance(event := server.next_event(), h11.Data):
            body += event.data
    except h11.RemoteProtocolError:
        return "no HTTP"
    if not isinstance(request, h11.Request):
        return "no request"
    path, _, query = request.target.partition(b"?")
    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": request.method.decode("ascii"),
        "scheme": "http",
        "path": unquote(path.decode("ascii")),
        "raw_path": path,
        "query_string": query,
        "root_path": "",
        "headers": [(name.lower(), value) for name, value in request.headers],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 8420),
        "state": {},
    }
    statuses: list[int] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: MutableMapping[str, Any]) -> None:
        statuses.extend([message["status"]] if "status" in message else [])

    asyncio.run(_page()(scope, receive, send))
    return f"status {statuses}"


# --- valid examples -----------------------------------------------------------------------------


def seeds(name: str) -> list[bytes]:
    """Valid examples for a target."""
    return SEEDS[name]()


def _values() -> list[bytes]:
    numbers = [
        ua.Variant(1.5, ua.VariantType.Double),
        ua.Variant([1, 2, 3], ua.VariantType.UInt32, None, True),
        ua.Variant(datetime(2026, 1, 1, tzinfo=UTC), ua.VariantType.DateTime),
    ]
    return [to_binary(ua.DataValue, ua.DataValue(target)) for target in numbers]


def _traces() -> list[bytes]:
    _followed(link := Honest())
    return [link.answers, link.answers[:24]]


def _answers() -> list[bytes]:
    """Valid answers to reads and writes, and exceptions in their place."""
    unit, encode = _settings().unit, FramerSocket(DecodePDU(is_server=True)).buildFrame
    answers: list[ModbusPDU] = [
        ReadHoldingRegistersResponse(unit, 1, registers=[1, 2]),
        ReadCoilsResponse(unit, 2, bits=9 * [True]),
        WriteMultipleRegistersResponse(unit, 3, 7, 2),
        WriteMultipleCoilsResponse(unit, 4, 3, 3),
    ]
    exceptions = [
        ExceptionResponse(answer.function_code, 3, unit, answer.transaction_id)
        for answer in answers
    ]
    return [b"".join(map(encode, answers)), b"".join(map(encode, exceptions))]


def _logs(metadata: dict[str, str] | None = None) -> list[bytes]:
    """Valid logs of a few rows and an event."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        header = LogHeader("type", "id", "a.toml", "[data]\n", metadata or {})
        with Recorder(path, header) as recorder:
            recorder.write(*_rows(), [Event(10**18, Kind.GAP, "gap", {"missing": 1})])
        return [b"\x89MCAP0\r\n" + bytes(40), path.read_bytes()]


def _rows() -> tuple[Any, Any]:
    rows, ticks = np.zeros(30, SAMPLE), np.zeros(30, TICK)
    rows["sequence"], rows["pressure"] = range(30), 1e5
    rows["time_ns"] = rows["host_ns"] = 10**18 + rows["sequence"] * 1_000_000
    return rows, ticks


def _heads() -> list[bytes]:
    stored = Config.of(CONFIG, SHIPPED).log_header()
    lines = [line.partition("#")[0].rstrip() for line in stored.config_text.splitlines()]
    text = "\n".join(line for line in lines if line)
    parts = text, stored.metadata["data"], stored.metadata["healthy"]
    return ["\0".join(parts).encode(), text.encode()]


def _tables(suffix: str) -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        export([_rows()], LogHeader("type", "id", "a.toml", ""), path)
        return [path.read_bytes()]


def _exports() -> list[bytes]:
    record = checked(Record("type", "vs-40", "vs-40", {"ejector": {"bulge": 0.1}}))
    return [json_text(to_export([replace(record, id="0" * 32)])).encode()]


def _messages() -> list[bytes]:
    asset = asset_of(Unit(*LEVELS), "B7")
    prefix = "/".join(LEVELS).encode()
    measured = {"low": 0.5, "mean": 300.0, "high": 750.0}
    row = {"time_ns": 1, "measured_mbar": measured, "expected_mbar": {"mean": 301.0}}
    cycle = {"cycle": 1, "t0_measured": 189.0, "t0_expected": None}
    live_rows = {"period_s": 1.0, "rows": [row]}
    alarm = {
        "format": "ejector-twin-alarm/1",
        "id": "1",
        "alarm": "deviation_leakage",
        "time": "2026-01-01T00:00:00Z",
        "active": True,
        "acknowledged": False,
        "state": "unacknowledged",
        "priority": "medium",
        "since": "2026-01-01T00:00:00Z",
        "consequence": "",
        "action": "",
        "evidence": {"words": "+52 mbar", "guess": "leakage", "parameters": {}},
    }
    topics = {
        b"status": of_status(asset, "online", 10**18, "p"),
        b"cycle": beside("ejector-twin-cycle/1", asset, 10**18, cycle).body,
        b"values": beside("ejector-twin-values/1", asset, 10**18, live_rows).body,
        b"alarm/deviation_leakage": json_text(alarm),
    }
    lines = [prefix + b"/" + topic + b" " + text.encode() for topic, text in topics.items()]
    return [*lines, b"\n".join(lines)]


def _asked() -> list[bytes]:
    day = {"from": "2026-01-01T00:00:00Z", "to": "2026-01-02T00:00:00Z"}
    return [json_text({"format": REQUEST_FORMAT, "id": "a", "log": "a.mcap", **day}).encode()]


def _requests() -> list[bytes]:
    host = "Host: 127.0.0.1:8420\r\nOrigin: http://127.0.0.1:8420\r\n"
    session_headers = f"{host}Cookie: {COOKIE}={TOKEN}\r\nX-CSRF-Token: {TOKEN}\r\n"
    request = '{"alarm": "deviation_leakage", "deed": "shelved", "seconds": 60}'
    form = f"name=ann&password={WORD.replace(' ', '+')}"

    def post(path: str, headers: str, body: str) -> str:
        return f"POST {path} HTTP/1.1\r\n{headers}Content-Length: {len(body)}\r\n\r\n{body}"

    ejector = [f"/api/ejectors/0/{name}" for name in ("history", "curve")]
    paths = ("/", "/api/me", "/login", "/static/page.js", "/api/all", *ejector)
    gets = [f"GET {path}?days=7&from=1&to=2 HTTP/1.1\r\n{session_headers}\r\n" for path in paths]
    posts = post("/api/ejectors/0/requests", session_headers, request), post("/login", host, form)
    return [target.encode() for target in (*gets, *posts)]


TARGETS: dict[str, Callable[[bytes], str]] = {
    target.__name__: target
    for target in (
        *(ring, modbus, poll_socket, poll, values),
        *(log, curve, head, csv, parquet, assets, aasx, fmu, users),
        *(mqtt, upload, http),
    )
}
SEEDS: dict[str, Callable[[], list[bytes]]] = {
    "ring": _traces,
    "modbus": _answers,
    "poll_socket": _answers,
    "poll": lambda: [bytes(range(40)), struct.pack(">f", 900.0) * 4],
    "values": _values,
    "log": _logs,
    "curve": lambda: _logs({RECORDED: "twin run"}),
    "head": _heads,
    "csv": lambda: [*_tables(".csv"), b"time_ms;vacuum_mbar\n0;1,5\n1;2,5\n"],
    "parquet": lambda: _tables(".parquet"),
    "assets": _exports,
    "aasx": lambda: [_package()[_shells()], _packed(_package())],
    "fmu": lambda: [
        b'<fmiModelDescription fmiVersion="3.0" version="7"><CoSimulation/></fmiModelDescription>'
    ],
    "users": lambda: [f'[users.ann]\nrole = "look"\nhash = "{CHEAP.hash(WORD)}"\n'.encode()],
    "mqtt": _messages,
    "upload": _asked,
    "http": _requests,
}
