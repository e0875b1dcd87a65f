"""The register map over a real socket, read with pymodbus's own client."""

import asyncio
import struct
from contextlib import asynccontextmanager

import numpy as np
import pytest
from plc_process import start_plc
from pymodbus.client import AsyncModbusTcpClient, ModbusTcpClient
from pymodbus.constants import ExcCodes

from drivers.plc.faults import parse_fault
from drivers.plc.registers import Registers
from drivers.plc.scan import DEPTH, Task
from drivers.plc.server import listening
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.errors import ConfigError, SourceError
from twin.signals import Command

START_NS = 1_767_225_600_123_456_789
BOOT = 0xBEEF


class Plc:
    """A PLC whose clock the test holds, and a client connected to it."""

    def __init__(self, task, client):
        self.task, self.client, self.now = task, client, 1

    async def input(self, address, count):
        return (await self.client.read_input_registers(address, count=count)).registers

    async def holding(self, address, count):
        return (await self.client.read_holding_registers(address, count=count)).registers


@asynccontextmanager
async def plc(faults=(), **tables):
    """Serve with the scans up to ``Plc.now``, whatever the time."""
    tables["server"] = {"port": 0} | tables.get("server", {})
    task = Task(PlcSettings.model_validate(tables), faults)
    served = Plc(task, None)
    memory = Registers(task, START_NS, BOOT)
    async with listening([memory], lambda: task.advance_to(served.now)) as port:
        served.client = AsyncModbusTcpClient("127.0.0.1", port=port, timeout=2, retries=0)
        assert await served.client.connect()
        try:
            yield served
        finally:
            served.client.close()


def in_plc(body, **options):
    """Run ``body(plc)`` in an event loop."""

    async def run():
        async with plc(**options) as served:
            return await body(served)

    return asyncio.run(run())


def big(words, kind):
    """Decode words with the high word first."""
    return struct.unpack(">" + kind, struct.pack(f">{len(words)}H", *words))[0]


def test_input_registers_are_the_newest_scan():
    async def body(served):
        served.now = 1500
        words = await served.input(0, 7)
        pressure = big(words[1:3], "f")
        newest = served.task.ring[1499]
        assert pressure == newest["pressure"] != 0
        assert big(words[:1], "h") == round(pressure * 10)
        assert big(words[3:4], "h") == newest["supply"] == pytest.approx(4800, abs=100)
        assert words[4] == Command.SUCTION
        assert big(words[5:7], "I") == 1499

    in_plc(body)


def test_input_overflow_is_bit_8():
    async def body(served):
        served.now = 100
        assert (await served.input(4, 1)) == [0x100]

    in_plc(body, faults=[parse_fault("sensor_offset=300")], sensor={"full_scale_mbar": 1200})


def test_header_tells_where_the_trace_stands():
    async def body(served):
        served.now = 70_000
        words = await served.holding(100, 12)
        assert big(words[0:2], "I") == 69_999
        assert big(words[2:6], "Q") == START_NS + 69_999 * 1_000_000
        assert words[6:10] == [BOOT, 1000, DEPTH, 4]
        assert big(words[10:11], "h") == served.task.ring[69_999 % DEPTH]["supply"]
        assert words[11] == 0

    in_plc(body)


@pytest.mark.parametrize("first", [0, 1, 2, 3, 4000])
def test_records_lie_at_their_sequence_modulo_depth(first):
    async def body(served):
        served.now = DEPTH + 900
        words = await served.holding(1000 + first, 122)
        expected = np.concatenate(list(blocks(served.task.settings, 5)))
        for i in range(-first % 4, 119, 4):
            slot = (first + i) // 4
            sequence = slot + DEPTH if slot < 900 else slot
            assert words[i] == sequence & 0xFFFF
            assert words[i + 1] == expected["commands"][sequence]
            read = np.float32(np.float64(np.float32(big(words[i + 2 : i + 4], "f"))) * 100)
            assert read == expected["pressure"][sequence]  # bit for bit what the simulation gives

    in_plc(body)


def test_the_ring_ends_where_the_map_says():
    async def body(served):
        served.now = DEPTH
        words = await served.holding(17380, 4)
        assert words[0] == DEPTH - 1
        response = await served.client.read_holding_registers(17380, count=5)
        assert response.exception_code == ExcCodes.ILLEGAL_ADDRESS

    in_plc(body)


@pytest.mark.parametrize("order", ["big", "little"])
def test_word_order_is_as_configured_and_the_test_registers_show_it(order):
    async def body(served):
        served.now = 70_000
        ordered = (lambda words: words) if order == "big" else (lambda words: words[::-1])
        test = await served.holding(0, 6)
        assert test[0] == 0x1234
        assert big(test[1:2], "h") == -12345
        assert big(ordered(test[2:4]), "I") == 0x12345678
        assert big(ordered(test[4:6]), "f") == pytest.approx(123.456)
        header = await served.holding(100, 6)
        assert big(ordered(header[:2]), "I") == 69_999
        assert big(ordered(header[2:]), "Q") == START_NS + 69_999 * 1_000_000
        record = await served.holding(1000 + 4 * (69_999 % DEPTH), 4)
        newest = served.task.ring[69_999 % DEPTH]
        assert big(ordered(record[2:]), "f") == newest["pressure"]
        plain = await served.input(0, 7)
        assert big(ordered(plain[1:3]), "f") == newest["pressure"]
        assert big(ordered(plain[5:7]), "I") == 69_999

    in_plc(body, server={"word_order": order})


@pytest.mark.parametrize(
    ("address", "count"), [(6, 1), (99, 1), (5, 2), (112, 1), (999, 2), (17384, 1), (65535, 1)]
)
def test_holding_registers_off_the_map_are_refused(address, count):
    async def body(served):
        response = await served.client.read_holding_registers(address, count=count)
        assert response.exception_code == ExcCodes.ILLEGAL_ADDRESS

    in_plc(body)


def test_other_requests_off_the_map_are_refused():
    async def body(served):
        client = served.client
        assert (await client.read_input_registers(7)).exception_code == ExcCodes.ILLEGAL_ADDRESS
        assert (await client.read_coils(2)).exception_code == ExcCodes.ILLEGAL_ADDRESS
        assert (await client.write_coil(2, True)).exception_code == ExcCodes.ILLEGAL_ADDRESS
        discrete = await client.read_discrete_inputs(0)
        assert discrete.exception_code == ExcCodes.ILLEGAL_FUNCTION
        written = await client.write_register(0, 7)
        assert written.exception_code == ExcCodes.ILLEGAL_FUNCTION
        assert (await served.holding(0, 1)) == [0x1234]

    in_plc(body)


def test_another_unit_is_not_there():
    async def body(served):
        for call in (served.client.read_holding_registers, served.client.read_coils):
            response = await call(0, device_id=9)
            assert response.exception_code == ExcCodes.GATEWAY_NO_RESPONSE

    in_plc(body)


def test_coils_mirror_the_program_and_refuse_to_be_written():
    async def body(served):
        served.now = 600
        assert (await served.client.read_coils(0, count=2)).bits[:2] == [True, False]
        for value in (True, False):
            refused = await served.client.write_coil(1, value)
            assert refused.exception_code == ExcCodes.ILLEGAL_FUNCTION
        assert (await served.client.read_coils(0, count=2)).bits[:2] == [True, False]

    in_plc(body)


def test_written_coils_command_the_rig():
    async def body(served):
        served.now = 100
        assert not (await served.client.write_coil(0, True)).isError()
        assert (await served.client.read_coils(0, count=2)).bits[:2] == [True, False]
        served.now = 1000
        sucked = await served.input(0, 7)
        assert sucked[4] == Command.SUCTION
        assert served.task.ring["status"][[99, 100]].tolist() == [0, Command.SUCTION]
        assert not (await served.client.write_coils(0, [False, True])).isError()
        served.now = 1200
        blown = await served.input(0, 7)
        assert blown[4] == Command.BLOW_OFF
        assert big(blown[1:3], "f") > big(sucked[1:3], "f") + 100
        assert not (await served.client.write_coil(1, False)).isError()
        served.now = 1201
        assert (await served.input(4, 1)) == [0]

    in_plc(body, program={"commands": "coils"})


def test_a_taken_port_is_an_error_for_people():
    async def body(served):
        port = served.client.comm_params.port
        with pytest.raises(SourceError, match=str(port)) as refused:
            async with plc(server={"port": port}):
                pass
        assert refused.value.hint

    in_plc(body)


def test_only_a_port_is_a_port():
    assert PlcSettings().on_port(None) == PlcSettings()
    assert PlcSettings().on_port(1234).server.port == 1234
    with pytest.raises(ConfigError):
        PlcSettings().on_port(70_000)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("plc") / "coils.toml"
    path.write_text('[plc.program]\ncommands = "coils"\n[plc.server]\nport = 5020\n')
    return path


def newest(port):
    client = ModbusTcpClient("127.0.0.1", port=port, timeout=2, retries=0)
    try:
        assert client.connect()
        words = client.read_holding_registers(100, count=12).registers
    finally:
        client.close()
    return big(words[0:2], "I"), big(words[2:6], "Q"), words[6]


def test_as_a_process_it_runs_with_the_clock_restarts_and_ends(config):
    with start_plc(config, "--fault", "leakage=2@1") as first:
        before, after = newest(first.port), newest(first.port)
        assert after[0] >= before[0]
        assert after[1] - before[1] == (after[0] - before[0]) * 1_000_000
        assert before[2] == after[2]
        first.kill()
    with start_plc(config, port=first.port) as second:
        assert second.port == first.port
        assert newest(second.port)[2] != before[2]
        assert newest(second.port)[1] > after[1]
        assert second.stop() == 0


def test_as_a_process_it_ends_after_its_duration(config):
    with start_plc(config, "--duration", "0.1") as process:
        assert process.process.wait(10) == 0


def test_as_a_process_it_explains_what_it_cannot_use(config, capfd):
    with pytest.raises(RuntimeError, match="exit code 2"):
        start_plc(config, "--fault", "leak=1")
    assert "no effect 'leak'" in capfd.readouterr().err
