"""The PLC's side that docs/plc ships: it is parsed, made to run, and followed by the real drivers.

No PLC is here. What runs is the function blocks' text; what reads is what reads a PLC, configured
as the page for each family says.
"""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from asyncua import ua

from drivers.modbus.ring import Header, Trace
from drivers.modbus.settings import ModbusSettings
from drivers.opcua.settings import BIT_NODES, Node, OpcuaSettings
from drivers.opcua.trace import NodeTrace
from drivers.optional_signals import BITS
from drivers.plc.opcua import MEASURED, TRACE
from drivers.plc.registers import HEADER, HEADER_SIZE, MAP, RECORD, RING, Registers
from drivers.plc.scan import OVERFLOW, PERIOD_NS
from drivers.reconnect import Clock
from drivers.tags import Address
from tests.structured_text import Block, iec, parsed
from twin.quality import Quality
from twin.settings import Document
from twin.signals import MBAR, SAMPLE, Command, Reported, Samples

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "connect-your-plc.md").read_text(encoding="utf-8")
ST = (DOCS / "plc" / "trace_ring.st").read_text(encoding="utf-8")
SCL = (DOCS / "plc" / "trace_ring.scl").read_text(encoding="utf-8")
TABLES = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)

FAMILIES = {"s7": ("scl", 0), "twincat": ("st", 12288), "codesys": ("st", 0)}  # as on the page
DEPTH, NODES = 2048, 1024  # records in the ring of registers, and in that of the nodes
NAMES = {  # of a scan's values in either language
    "st": ("rPressure", "iSupply", "xSuction", "xBlowOff", "xOverflow", "wReported", "ulTimeNs"),
    "scl": ("pressure", "supply", "suction", "blowOff", "overflow", "reported", "timeNs"),
}
MEMORY = {"st": ("awRegisters", "stNodes"), "scl": ("registers", "nodes")}
COUNTER = {"st": "udiSequence", "scl": "sequence"}
REPORTS = ("air_saving", "part_present")
UA = {
    "INT": ua.VariantType.Int16,
    "UINT": ua.VariantType.UInt16,
    "UDINT": ua.VariantType.UInt32,
    "ULINT": ua.VariantType.UInt64,
    "REAL": ua.VariantType.Float,
}
START_NS = 1_790_000_000_123_456_789
WRAP = 1 << 32
AMBIENT = 1013.0  # mbar, on the page

Sources = dict[str, list[Any]]


@pytest.fixture(scope="module")
def sources() -> Sources:
    return {"st": parsed(ST), "scl": parsed(iec(SCL))}


def modbus(table: str) -> ModbusSettings:
    table += "[driver.tags]\n" + "\n".join(
        f'{name} = {{ address = "30005", bit = {BITS[name]} }}' for name in REPORTS
    )
    return Document.parse(table, "connect-your-plc.md").section(ModbusSettings, "driver")


def opcua() -> OpcuaSettings:
    table = (
        TABLES[4]
        + "[driver.tags]\n"
        + "\n".join(f'{name} = {{ node = "s={BIT_NODES[name]}" }}' for name in REPORTS)
    )
    return Document.parse(table, "connect-your-plc.md").section(OpcuaSettings, "driver")


class Plc:
    """A PLC that runs a block every ms; ``step`` goes on by statements, for torn reads."""

    def __init__(
        self, sources: Sources, language: str, first: int = 0, name: str = "FB_TraceRing"
    ) -> None:
        self.block = Block(sources[language], name, real_bits=language == "scl")
        self.names = NAMES[language]
        self.registers, self.nodes = MEMORY[language]
        self.block.values[COUNTER[language]] = first % WRAP
        self.scan = first  # that runs, or runs next
        self._inside = 0  # statements of it that ran
        self._running = self._scans()

    @property
    def words(self) -> npt.NDArray[np.uint16]:
        """The registers."""
        words: npt.NDArray[np.uint16] = self.block.values[self.registers]
        return words

    def node(self, name: str) -> Any:
        """What an OPC UA client would read."""
        return self.block.values[f"{self.nodes}.{name}"]

    def values(self, scan: int) -> tuple[Any, ...]:
        pressure = float(np.float32(13.25 - scan * 0.37 % 900))
        suction, blow_off, overflow = scan % 7 < 4, scan % 11 > 8, scan % 501 == 0
        reported = 0xFFE3 | (scan % 5 < 2) << 3 | (scan % 3 < 1) << 4  # more than it may be
        time_ns = START_NS + scan * PERIOD_NS
        return pressure, scan % 5000, suction, blow_off, overflow, reported, time_ns

    def now_ns(self) -> int:
        return self.scan * PERIOD_NS + self._inside * PERIOD_NS // 64

    def _scans(self) -> Iterator[bool]:
        """True where a scan ends."""
        while True:
            inputs = dict(zip(self.names, self.values(self.scan), strict=True))
            for _ in self.block.scan(inputs):
                self._inside += 1
                yield False
            self.scan, self._inside = self.scan + 1, 0
            yield True

    def step(self, statements: int) -> None:
        for _ in range(statements):
            next(self._running)

    def run(self, scans: int) -> None:
        for _ in range(scans):
            while not next(self._running):
                pass


class Client:
    """A driver's link and clock, beside a PLC that goes on while it asks and waits."""

    def __init__(self, plc: Plc, stall_ms: int, *, torn: bool = False, base: int = 0) -> None:
        self._plc, self._torn, self._base, self._stall = plc, torn, base, stall_ms
        self._random = np.random.default_rng(5)
        self.clock = Clock(plc.now_ns, plc.now_ns, self.sleep)

    def sleep(self, seconds: float) -> None:
        stalls = self._random.random() < 0.1
        self._plc.run(round(seconds * 1e3) + stalls * self._stall)

    def _pass(self) -> None:
        """Time goes by."""
        if self._torn:
            self._plc.step(int(self._random.integers(60)))
        else:
            self._plc.run(int(self._random.integers(3)))

    def take(self, blocks: Iterator[Samples], count: int = 100) -> Samples:
        return np.concatenate([np.empty(0, SAMPLE), *itertools.islice(blocks, count)])


class Registered(Client):
    """Of Modbus."""

    def read(self, address: Address, count: int) -> npt.NDArray[np.uint16]:
        self._pass()
        return self._plc.words[address.offset - self._base :][:count].copy()


class Noded(Client):
    """Of OPC UA: each node at a time of its own."""

    def read(self, nodes: tuple[Node, ...]) -> list[ua.DataValue]:
        return [self._value(node.identifier.strip('"').rpartition('"')[2]) for node in nodes]

    def _value(self, name: str) -> ua.DataValue:
        self._pass()
        kind = UA[self._plc.block.types[f"{self._plc.nodes}.{name}"]]
        value = self._plc.node(name)
        return ua.DataValue(ua.Variant(value.tolist() if name.endswith("es") else value, kind))


def assert_whole(samples: Samples, plc: Plc, late: int) -> None:
    """Nothing missing, and what the PLC had; time may be that of a scan ``late`` later."""
    assert (np.diff(samples["sequence"]) == 1).all()
    expected = [plc.values(int(scan)) for scan in samples["sequence"]]
    pressure, _, suction, blow_off, overflow, reported, time_ns = map(
        np.array, zip(*expected, strict=True)
    )
    saving, part = reported >> 3 & 1, reported >> 4 & 1
    asked = (suction != 0) & (blow_off == 0)
    known = Reported.NOZZLE_KNOWN | Reported.PART_KNOWN
    said = known + Reported.NOZZLE * (asked & (saving == 0)) + Reported.PART * part
    np.testing.assert_array_equal(samples["reported"], said)
    pascal = ((pressure + AMBIENT) * MBAR).astype(np.float32)
    np.testing.assert_allclose(samples["pressure"], pascal, rtol=1e-7)
    commands = suction * Command.SUCTION + blow_off * Command.BLOW_OFF
    np.testing.assert_array_equal(samples["commands"], commands)
    np.testing.assert_array_equal((samples["quality"] & Quality.OVERFLOW) != 0, overflow)
    assert (np.abs(samples["time_ns"] - time_ns) <= late * PERIOD_NS).all()
    assert not (samples["quality"] & (Quality.GAP | Quality.RESTART | Quality.BAD)).any()


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 65_000, WRAP - 3000])
@pytest.mark.parametrize("family", FAMILIES)
def test_the_driver_follows_the_registers_and_loses_nothing(
    sources: Sources, family: str, first: int
) -> None:
    language, base = FAMILIES[family]
    plc = Plc(sources, language, first)
    plc.run(5)
    client: Any = Registered(plc, stall_ms=1900, base=base)
    settings = modbus(TABLES[list(FAMILIES).index(family)])
    samples = client.take(Trace(settings, client.clock).samples(client))
    assert len(samples) > 2 * DEPTH  # the ring went round, and so did the sequence's words
    assert_whole(samples, plc, late=0)
    assert set(samples["quality"]) == {0, Quality.OVERFLOW}


@pytest.mark.parametrize("language", NAMES)
def test_registers_read_between_any_two_statements_give_no_wrong_value(
    sources: Sources, language: str
) -> None:
    plc = Plc(sources, language, WRAP - 3000)
    plc.run(5)
    client: Any = Registered(plc, stall_ms=1900, torn=True)
    samples = client.take(Trace(modbus(TABLES[0]), client.clock).samples(client))
    assert len(samples) > 2 * DEPTH
    assert_whole(samples, plc, late=1)  # in a header the time may be one scan off the sequence
    assert not (samples["quality"] & Quality.CLOCK).any()


@pytest.mark.parametrize("first", [0, WRAP - 3000])
@pytest.mark.parametrize("language", NAMES)
def test_the_driver_follows_the_nodes_and_loses_nothing(
    sources: Sources, language: str, first: int
) -> None:
    plc = Plc(sources, language, first, "FB_TraceNodes")
    plc.run(200)
    client: Any = Noded(plc, stall_ms=750, torn=True)
    samples = client.take(NodeTrace(opcua(), client.clock).samples(client))
    assert len(samples) > 2 * NODES
    assert_whole(samples, plc, late=60)  # sequence and time are read one after the other


@pytest.mark.parametrize("language", NAMES)
def test_an_overwritten_record_is_void_before_its_values_go(
    sources: Sources, language: str
) -> None:
    plc = Plc(sources, language)
    plc.run(DEPTH + 7)
    slot = RING + RECORD * 7
    before = plc.words[slot : slot + RECORD].copy()
    assert before[0] == 7
    while plc.scan == DEPTH + 7:
        plc.step(1)
        now = plc.words[slot : slot + RECORD]
        assert (now == before).all() or now[0] == DEPTH + 7
    assert (now[2:] != before[2:]).any()


@pytest.mark.parametrize("language", NAMES)
def test_the_header_announces_only_what_is_whole(sources: Sources, language: str) -> None:
    plc = Plc(sources, language, DEPTH - 20)
    plc.run(1)
    for _ in range(40 * 30):
        plc.step(1)
        newest = int(plc.words[HEADER + 1])
        slot = RING + RECORD * (newest % DEPTH)
        assert plc.words[slot] == newest
        pressure = plc.words[slot + 2 : slot + 4].astype(">u2").view(">f4")[0]
        assert pressure == plc.values(newest)[0]


@pytest.mark.parametrize("language", NAMES)
def test_there_is_no_ring_before_the_first_scan_is_whole(sources: Sources, language: str) -> None:
    plc = Plc(sources, language, first=9)
    while plc.scan == 9:
        header = Header.parse(plc.words[HEADER : HEADER + HEADER_SIZE], "big")
        assert not header.ready
        plc.step(1)
        if (plc.words[HEADER + 9]) == RECORD:
            break
    header = Header.parse(plc.words[HEADER : HEADER + HEADER_SIZE], "big")
    assert header.ready
    assert (header.sequence, header.time_ns) == (9, START_NS + 9 * PERIOD_NS)
    assert header.boot == START_NS // 10**9 % 65536
    assert (header.period_ns, header.depth, int(header.supply[0, 0])) == (PERIOD_NS, DEPTH, 9)
    assert plc.words[HEADER + 11] == 0


@pytest.mark.parametrize("language", NAMES)
def test_the_registers_are_those_of_the_simulated_plc(sources: Sources, language: str) -> None:
    plc = Plc(sources, language)
    plc.run(700)
    ours = np.zeros(
        DEPTH, [("sequence", "<i8"), ("pressure", "<f4"), ("supply", "<i2"), ("status", "<u2")]
    )
    for scan in range(700):
        pressure, supply, suction, blow_off, overflow, reported, _ = plc.values(scan)
        ours[scan] = (
            scan,
            pressure,
            supply,
            (suction + 2 * blow_off + OVERFLOW * overflow + (reported & 0x1C)),
        )
    settings = SimpleNamespace(server=SimpleNamespace(word_order="big"))
    task: Any = SimpleNamespace(ring=ours, newest=699, settings=settings)
    simulated = Registers(task, START_NS, boot=int(plc.words[HEADER + 6]))
    assert plc.words[:6].tolist() == simulated.test()
    assert plc.words[RING : RING + 700 * RECORD].tolist() == simulated.ring(0, 700 * RECORD)
    header = simulated.header()
    header[8] = DEPTH  # the only difference: the depth
    assert plc.words[HEADER : HEADER + HEADER_SIZE].tolist() == header


@pytest.mark.parametrize("language", NAMES)
def test_each_program_gives_the_block_all_it_takes(sources: Sources, language: str) -> None:
    text = ST if language == "st" else iec(SCL)
    call = r"^\s*(?:fbTrace|fbNodes|TraceRing|TraceNodesRing)\((.*?)\);"
    calls = re.findall(call, text, re.MULTILINE | re.DOTALL)
    given = [re.findall(r"(\w+) :=", arguments) for arguments in calls]
    once = [[*NAMES[language], memory] for memory in MEMORY[language]]
    assert given == once * {"st": 2, "scl": 1}[language]


@pytest.mark.parametrize("language", NAMES)
def test_the_nodes_hold_the_same_scans(sources: Sources, language: str) -> None:
    first = WRAP - 700
    plc = Plc(sources, language, first, "FB_TraceNodes")
    plc.run(1500)
    assert plc.node("Boot") == (START_NS + first * PERIOD_NS) // 10**9 % 65536
    assert (plc.node("Period"), plc.node("Sequence")) == (PERIOD_NS // 1000, 799)
    assert plc.node("TimeNs") == START_NS + (first + 1499) * PERIOD_NS
    for scan in range(plc.scan - NODES, plc.scan):
        pressure, _, suction, blow_off, overflow, reported, _ = plc.values(scan)
        status = suction + 2 * blow_off + OVERFLOW * overflow + (reported & 0x1C)
        record = [plc.node(name)[scan % NODES] for name in ("Sequences", "Statuses", "Pressures")]
        assert record == [scan % WRAP, status, pressure]


@pytest.mark.parametrize("language", NAMES)
def test_the_nodes_announce_only_what_is_whole(sources: Sources, language: str) -> None:
    plc = Plc(sources, language, 0, "FB_TraceNodes")
    while not plc.node("Period"):
        plc.step(1)
    for _ in range(NODES * 20):
        plc.step(1)
        newest = plc.node("Sequence")
        for scan in range(max(newest - 2, 0), newest + 1):
            assert plc.node("Sequences")[scan % NODES] == scan
            assert plc.node("Pressures")[scan % NODES] == plc.values(scan)[0]


def test_the_nodes_are_named_as_the_simulated_plc_s(sources: Sources) -> None:
    names = {name.partition(".")[2].replace("Time", "TimeNs") for name in TRACE}
    names |= {"Pressure", "Supply"}
    assert {"Meas.Pressure", "Meas.Supply"} <= set(MEASURED)
    for language, (_, memory) in MEMORY.items():
        types = Plc(sources, language, 0, "FB_TraceNodes").block.types
        assert {name.partition(".")[2] for name in types if name.startswith(f"{memory}.")} == names


@pytest.mark.parametrize("number", range(4))
def test_the_page_s_configurations_fit_its_registers(number: int) -> None:
    assert len(TABLES) == 5
    settings = modbus(TABLES[number])
    if number == 3:
        assert settings.mode == "poll"
        return
    base = list(FAMILIES.values())[number][1]
    header, records = settings.ring.header, settings.ring.records
    assert (header.offset, records.offset) == (base + HEADER, base + RING)
    assert settings.tags.pressure.address == records + 2  # of slot 0
    assert settings.tags.supply is not None
    assert settings.tags.supply.address == header + 10


def test_the_page_s_register_map_is_the_code_s() -> None:
    rows = re.findall(r"^\| (\d+)(?:–(\d+))? \| (\S+) \| (.+) \|$", PAGE, re.MULTILINE)
    written = [(int(a), int(b or a), kind, what) for a, b, kind, what in rows]
    places = [place for place in MAP if place.area == "holding"]
    sizes = [RECORD * DEPTH if place.first == RING else place.size for place in places]
    assert written == [
        (place.first, place.first + size - 1, place.type, place.meaning)
        for place, size in zip(places, sizes, strict=True)
    ]
