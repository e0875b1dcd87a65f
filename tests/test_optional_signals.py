"""What an ejector and its surroundings tell besides, from both transports in every mode."""

import itertools
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import opcua_plc
import pytest
import tomli_w
from modbus_server import ModbusServer, PlcTime, TracePlc

from drivers.modbus.settings import ModbusSettings
from drivers.modbus.source import blocks
from drivers.opcua import source as opcua
from drivers.opcua.settings import OpcuaSettings
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from drivers.reconnect import Clock
from twin.errors import ConfigError
from twin.settings import Document
from twin.signals import MBAR, SAMPLE, SL_MIN, Command, Reported, Samples

PRESSURE: dict[str, Any] = {
    "address": "30002",
    "type": "float32",
    "unit": "mbar",
    "reference": "absolute",
}
STATUS = {name: {"address": "30005", "bit": bit} for name, bit in (("suction", 0), ("blow_off", 1))}
REPORTS: dict[str, Any] = {
    "air_saving": {"address": "30005", "bit": 3},
    "part_present": {"address": "30005", "bit": 4},
    "ambient": {
        "address": "30008",
        "type": "int16",
        "scale": 0.1,
        "unit": "mbar",
        "reference": "absolute",
    },
    "temperature": {"address": "30009", "type": "int16", "scale": 0.1, "unit": "C"},
    "pressure_2": {
        "address": "30010",
        "type": "float32",
        "unit": "mbar",
        "reference": "absolute",
    },
    "flow": {"address": "30012", "type": "float32", "unit": "sl/min"},
}
NODES: dict[str, Any] = {
    "nozzle": {"node": "s=Meas.Nozzle"},
    "part_present": {"node": "s=Meas.PartPresent"},
    "ambient": {"node": "s=Meas.Ambient", "unit": "mbar", "reference": "absolute"},
    "temperature": {"node": "s=Meas.Temperature", "unit": "C"},
    "pressure_2": {"node": "s=Meas.Pressure2", "unit": "mbar", "reference": "absolute"},
    "flow": {"node": "s=Meas.Flow", "unit": "sl/min"},
}


@pytest.fixture(scope="module")
def plc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, int, str]]:
    """Host and port for Modbus, and the address for OPC UA; its rig evacuates within 0.3 s."""
    document = opcua_plc.tables()
    document["plc"]["reports"] = {"bits": True, "values": True}
    document["plc"]["rig"]["vessel_ml"] = 50.0
    document["plc"]["program"] |= {"start_ms": 0, "suction_ms": 600, "blow_off_ms": 200}
    document["plc"]["program"]["idle_ms"] = 200
    document["plc"]["opcua"] |= {"port": 0, "trace_depth": 1024}
    path = tmp_path_factory.mktemp("reports") / "plc.toml"
    path.write_text(tomli_w.dumps(document), encoding="utf-8")
    process = opcua_plc.start_plc(path)
    with process:
        assert process.process.stdout is not None
        url = process.process.stdout.readline().strip().removeprefix("OPC UA on ")
        yield "127.0.0.1", process.port, url


def taken(source: Iterator[Samples], rows: int) -> Samples:
    parts = [np.empty(0, SAMPLE)]
    while sum(map(len, parts)) < rows:
        parts.append(next(source))
    return np.concatenate(parts)


def modbus(plc: tuple[str, int, str], mode: str, rows: int = 1500) -> Samples:
    tags = {"pressure": PRESSURE, **STATUS, **REPORTS}
    table = {"host": plc[0], "port": plc[1], "mode": mode, "tags": tags}
    with closing(blocks(ModbusSettings.model_validate(table))) as source:
        return taken(source, rows)


def over_opcua(plc: tuple[str, int, str], mode: str) -> Samples:
    tags = opcua_plc.tables()["driver"]["tags"] | NODES
    table = opcua_plc.tables()["driver"] | {"url": plc[2], "mode": mode, "tags": tags}
    if mode == "subscribe":
        table["sampling_ms"] = 2
    with closing(opcua.blocks(OpcuaSettings.model_validate(table))) as source:
        return taken(source, 1500 if mode == "block" else 600)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["modbus block", "modbus poll", "opcua block", "opcua subscribe"])
def test_each_way_brings_what_is_reported(plc: tuple[str, int, str], way: str) -> None:
    transport, mode = way.split()
    samples = (modbus if transport == "modbus" else over_opcua)(plc, mode)
    known = Reported.NOZZLE_KNOWN | Reported.PART_KNOWN
    assert ((samples["reported"] & known) == known).all()
    on, part = (samples["reported"] & bit != 0 for bit in (Reported.NOZZLE, Reported.PART))
    suction = samples["commands"] == Command.SUCTION
    assert np.mean(on & ~suction) < 0.01  # single values come one after the other
    assert (suction & on).any()
    assert (suction & ~on).any()
    assert samples["pressure"][part].max() < 600 * MBAR < samples["pressure"][~part].max()
    assert samples["ambient"] == pytest.approx(1013 * MBAR)
    assert samples["temperature"] == pytest.approx(293.15)
    beside = samples["pressure_2"] > 0.0
    assert np.median(np.abs(samples["pressure_2"] - samples["pressure"])[beside]) < 5 * MBAR
    flow = (samples["reported"] & Reported.FLOW_KNOWN) != 0
    assert flow.any()
    assert samples["flow"].max() > 5 * SL_MIN
    per_row = mode in ("poll", "subscribe")
    assert flow.all() == beside.all() == per_row  # read once a block, it is the newest row's


def test_a_gauge_counts_from_the_barometer() -> None:
    with ModbusServer() as server:
        plc = TracePlc(server)
        plc.pressure = lambda sequence: -300.0
        server.areas[4][7] = 9800
        gauge = PRESSURE | {"reference": "gauge"}
        tags = {"pressure": gauge, "ambient": REPORTS["ambient"]}
        time = PlcTime(plc.scan)
        clock = Clock(time.wall_ns, time.now_ns, time.sleep)
        settings = {"host": "127.0.0.1", "port": server.port, "tags": tags}
        with closing(blocks(ModbusSettings.model_validate(settings), clock)) as source:
            samples = np.concatenate(list(itertools.islice(source, 3)))
            assert samples["pressure"][-1] == pytest.approx(680 * MBAR)
            server.areas[4][7] = 0  # broken: what is configured counts
            samples = np.concatenate(list(itertools.islice(source, 3)))
    assert samples["ambient"][-1] == 0.0
    assert samples["pressure"][-1] == pytest.approx(713.25 * MBAR)


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({"nozzle": {"address": "30005", "bit": 5}}, "nozzle in bit 2 of its status"),
        ({"part_present": {"address": "input:9", "bit": 0}}, "part_present in bit 4 of its status"),
        (
            {"nozzle": {"address": "30005", "bit": 2}, "air_saving": REPORTS["air_saving"]},
            "nozzle and air_saving say the same",
        ),
        ({"ambient": REPORTS["ambient"] | {"reference": "gauge"}}, "ambient is a barometer"),
        ({"temperature": REPORTS["temperature"] | {"type": "bit"}}, "tags.temperature.type"),
        ({"flow": REPORTS["flow"] | {"unit": "mbar"}}, "tags.flow.unit"),
        ({"nozzle": {"address": "30005", "type": "int16"}}, "nozzle is a bit"),
    ],
)
def test_tags_that_cannot_be_are_refused(tags: dict[str, Any], message: str) -> None:
    table = {"driver": {"host": "plc", "tags": {"pressure": PRESSURE} | tags}}
    document = Document.parse(tomli_w.dumps(table), "mine.toml")
    with pytest.raises(ConfigError, match=message):
        document.section(ModbusSettings, "driver")


def test_over_opcua_a_bit_is_a_node_of_the_trace() -> None:
    tags = opcua_plc.tables()["driver"]["tags"] | {"nozzle": {"node": "s=Other"}}
    table = {"driver": opcua_plc.tables()["driver"] | {"tags": tags}}
    document = Document.parse(tomli_w.dumps(table), "mine.toml")
    with pytest.raises(ConfigError, match="nozzle in bit 2 of its status"):
        document.section(OpcuaSettings, "driver")


def test_reports_come_as_late_as_their_cycle_says() -> None:
    """And the rig is the same whoever listens."""
    rig = PlcSettings.model_validate({"rig": {"vessel_ml": 50.0}})
    told = rig.model_validate({"rig": {"vessel_ml": 50.0}, "reports": {"bits": True}})
    late = rig.model_validate(
        {"rig": {"vessel_ml": 50.0}, "reports": {"bits": True, "bits_delay_ms": 8}}
    )
    plain, at_once, later = (
        np.concatenate([block for block, _ in with_truth(settings, 4.0, block=333)])
        for settings in (rig, told, late)
    )
    assert (plain["pressure"] == at_once["pressure"]).all()
    assert not plain["reported"].any()
    assert (at_once["reported"][:-8] == later["reported"][8:]).all()
