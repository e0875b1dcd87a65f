"""What the probe says of a PLC, line by line."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from drivers.lasting import Clock
from drivers.link import ModbusSettings
from drivers.probe import Line, probe, word_order_of
from tests.modbus_server import SILENT, ModbusServer, PlcTime, TracePlc

TAGS: dict[str, Any] = {
    "pressure": {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"},
    "suction": {"address": "00001"},
    "blow_off": {"address": "input:4", "bit": 1},
}


@pytest.fixture
def plc() -> Iterator[TracePlc]:
    with ModbusServer() as server:
        plc = TracePlc(server)
        plc.test_registers()
        plc.put(4, 1, plc.words(">f", 612.5))
        plc.put(1, 0, [1])
        yield plc


def lines(plc: TracePlc, **changes: Any) -> dict[str, Line]:
    table = {"host": "127.0.0.1", "port": plc.server.port, "timeout_ms": 60, "tags": TAGS}
    time = PlcTime(plc.scan)
    clock = Clock(time.wall_ns, time.now_ns, time.sleep)
    found = probe(ModbusSettings.model_validate(table | changes), clock)
    return {line.what: line for line in found}


def test_a_healthy_plc(plc: TracePlc) -> None:
    found = lines(plc)
    assert all(line.good for line in found.values()), found
    assert "big 612.5 → 612.5 mbar absolute" in found["pressure"].text
    assert "input:1 [30002]: 0x4419 0x2000" in found["pressure"].text
    assert found["suction"].text == "coil:0 [00001]: 0x0001 = 1"
    assert found["word order"].text.startswith("big, by the test registers at holding:0 [40001]")
    assert "4096 records, one every 1000 µs; boot 7, sequence 10" in found["trace header"].text
    assert "header's sequence (10)" in found["trace records"].text
    assert found["scan rate"].text == "1000.0 scans/s, nominal 1000.0"


def test_the_other_word_order_is_found(plc: TracePlc) -> None:
    plc.little = True
    plc.scan(70_000)
    plc.test_registers()
    found = lines(plc)
    assert not found["word order"].good
    assert 'set word_order = "little"' in found["word order"].text
    assert not found["trace records"].good


def test_without_test_registers_both_orders_are_shown(plc: TracePlc) -> None:
    plc.put(3, 0, [0] * 6)
    found = lines(plc)
    assert found["word order"].good
    assert "no test registers" in found["word order"].text
    assert "little" in found["pressure"].text


def test_what_the_plc_refuses_is_said_and_the_rest_goes_on(plc: TracePlc) -> None:
    plc.server.refused = [range(5), range(1000, 65536)]
    found = lines(plc)
    assert "(Modbus exception 2)" in found["pressure"].text
    assert not found["suction"].good
    assert found["word order"].good
    assert found["trace header"].good
    assert "holding:1036" in found["trace records"].text


def test_a_plc_that_does_not_answer(plc: TracePlc) -> None:
    plc.server.hook = lambda function, address, count: SILENT
    found = lines(plc)
    assert found["connection"].good
    assert "no answer" in found["trace header"].text


def test_no_plc(plc: TracePlc) -> None:
    plc.server.stop()
    found = lines(plc)
    assert list(found) == ["connection"]
    assert "no connection" in found["connection"].text


def test_a_plc_that_stands_still(plc: TracePlc) -> None:
    plc.scan = lambda scans: None  # type: ignore[method-assign]
    assert "the sequence went from 10 to 10" in lines(plc)["scan rate"].text


def test_polling_is_told_how_fast_it_will_be(plc: TracePlc) -> None:
    found = lines(plc, mode="poll")
    assert found["round trip"].good
    assert "trace header" not in found


@pytest.mark.parametrize("spoiled", range(6))
def test_test_registers_must_all_be_right(plc: TracePlc, spoiled: int) -> None:
    words = plc.server.areas[3][:6].copy()
    assert word_order_of(words) == "big"
    words[spoiled] ^= 1
    assert word_order_of(words) is None
    assert word_order_of(np.zeros(6, np.uint16)) is None
