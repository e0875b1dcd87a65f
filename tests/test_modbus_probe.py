"""What the probe says of a PLC, line by line."""

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rigs
from command_line import edited, twin

from drivers.modbus.probe import probe, word_order_of
from drivers.modbus.settings import ModbusSettings
from drivers.probe import Line
from drivers.reconnect import Clock
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
    assert found["word order"].hint == 'set word_order = "little" in [driver]'
    assert not found["trace records"].good
    assert not found["scan rate"].good  # with its words swapped the sequence runs at 65 MHz
    assert "does word_order fit" in found["scan rate"].hint


@pytest.mark.parametrize(("per_period", "good"), [(0.5, False), (0.96, True), (1.5, False)])
def test_the_scan_rate_must_be_that_of_the_period(
    plc: TracePlc, per_period: float, good: bool
) -> None:
    scan = plc.scan
    plc.scan = lambda scans: scan(round(scans * per_period))  # type: ignore[method-assign]
    assert lines(plc)["scan rate"].good is good


def test_without_test_registers_both_orders_are_shown(plc: TracePlc) -> None:
    plc.put(3, 0, [0] * 6)
    found = lines(plc)
    assert found["word order"].good
    assert "no test registers" in found["word order"].text
    assert "little" in found["pressure"].text


@pytest.mark.parametrize(
    ("reads", "swapped", "measures", "hint"),
    [
        (612.5, True, None, 'word_order = "little" in [driver] gives one that can be; or check'),
        (-5.0, False, None, "check its address, type, scale"),  # less than nothing
        (0.0, False, None, "check its address, type, scale"),  # no ejector comes so far
        (612.5, False, [0.0, 500.0], "check its address, type, scale"),
    ],
)
def test_a_pressure_that_cannot_be_is_not_good(
    plc: TracePlc, reads: float, swapped: bool, measures: list[float] | None, hint: str
) -> None:
    plc.put(3, 0, [0] * 6)  # without test registers there is nothing else to tell by
    words = plc.words(">f", reads)
    plc.put(4, 1, words[::-1] if swapped else words)
    tag = TAGS["pressure"] | ({"range": measures} if measures else {})
    found = lines(plc, tags=TAGS | {"pressure": tag})
    assert found["word order"].good
    assert not found["pressure"].good
    assert found["pressure"].text.endswith(": this pressure cannot be")
    assert found["pressure"].hint.startswith(hint)


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
    assert list(found) == ["connection", "round trip"]  # the rest would say the same
    assert "no answer" in found["round trip"].text


def test_no_plc(plc: TracePlc) -> None:
    plc.server.stop()
    found = lines(plc)
    assert list(found) == ["connection"]
    assert "no connection: the machine refuses this port" in found["connection"].text


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (socket.gaierror(-2, "Name or service not known"), "no such host"),
        (TimeoutError("timed out"), "no answer"),
        (OSError(113, "No route to host"), "no route to host"),
    ],
)
def test_why_there_is_no_connection(
    plc: TracePlc, monkeypatch: pytest.MonkeyPatch, error: OSError, said: str
) -> None:
    def refuse(*_given: object) -> None:
        raise error

    monkeypatch.setattr(socket, "create_connection", refuse)
    assert lines(plc)["connection"].text.endswith(f"no connection: {said}")


def test_wrong_lines_are_an_error_and_no_hint_is_said_twice(
    plc: TracePlc,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    plc.server.refused = [range(65536)]
    config, _ = edited(tmp_path, "port = 5020", f"port = {plc.server.port}")
    assert twin(monkeypatch, "probe", config) == 3
    out, err = capsys.readouterr()
    assert out.count("(Modbus exception 2)") > 5
    assert out.count("check the addresses in [driver]") == 1
    assert "not as configured: round trip, pressure, suction" in err


@pytest.mark.parametrize("port", ["0", "99999", "abc"])
def test_a_port_that_is_none(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    config = rigs.path_of("test_rig")
    assert twin(monkeypatch, "probe", config, "--address", f"127.0.0.1:{port}") == 2


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
