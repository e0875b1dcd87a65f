"""A PLC that lies over a real connection: the run goes on, and each good row is logged or missed.

Nothing that a PLC sends ends the run, and no row is made up; what was wrong is said in an event.
"""

from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import rigs
from log_rows import HEADER
from lying_modbus import LyingServer
from lying_opcua import LyingNodes
from modbus_server import PlcTime, TracePlc
from test_modbus_block import clock_of, settings_for
from test_opcua_block import TornServer
from test_opcua_block import settings_for as opcua_settings

from drivers.modbus.source import blocks
from drivers.opcua.client import OpcuaClient
from drivers.opcua.trace import NodeTrace
from drivers.reconnect import reconnecting
from twin.errors import TwinError
from twin.events import Kind
from twin.live import run
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.monitor.staleness import Listening, Notices
from twin.quality import BREAK, UNUSABLE, Quality
from twin.signals import SAMPLE, Samples

BLOCKS = 400  # with lies, and half as many after them
SHARE = 0.05  # of the answers that are lies


def lied_to(server: LyingServer, stream: Iterator[Samples]) -> Iterator[Samples]:
    """Blocks of an honest PLC at first and at the end, of one that lies between."""
    yield from islice(stream, 5)
    server.share = SHARE
    yield from islice(stream, BLOCKS)
    server.share = 0.0
    yield from islice(stream, BLOCKS // 2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_lies_over_modbus_end_nothing_and_make_nothing_up(seed: int, tmp_path: Path) -> None:
    notices = Notices()
    with LyingServer(seed) as server:
        server.areas[3][:] = 0xFFFF  # beside the ring nothing looks like a record of these scans
        server.plc = plc = TracePlc(server)
        time = PlcTime(plc.scan)

        def away(error: TwinError) -> None:
            notices.tell(Kind.PLC_LOST, str(error))

        stream = blocks(settings_for(server, timeout_ms=20), clock_of(time), away=away)
        twin, monitor = rigs.twin("test_rig"), rigs.monitor("test_rig")
        log, listening = Recorder(tmp_path / "a.mcap", HEADER), Listening(time.now_ns, notices)
        with closing(stream):
            run(lied_to(server, stream), twin, monitor, [log], listening)
    logged = open_log(tmp_path / "a.mcap")
    rows = np.concatenate([np.empty(0, SAMPLE), *(samples for samples, _ in logged.blocks())])
    assert len(set(server.lies)) > 6
    assert_true(rows, plc)
    lost = [event.text for event in logged.events() if event.kind is Kind.PLC_LOST]
    assert lost
    assert all(f"127.0.0.1:{server.port}, unit 1: " in text for text in lost)


def test_lies_over_opcua_end_nothing_and_make_nothing_up() -> None:
    plc, told = TornServer(), list[str]()
    time = plc.clock = PlcTime(plc.scan)
    clock = clock_of(time)
    with LyingNodes(plc, seed=1) as server:
        settings = opcua_settings(url=server.url, timeout_ms=1000)
        stream: Iterator[Samples] = reconnecting(
            NodeTrace(settings, clock),
            OpcuaClient(settings, clock),
            clock,
            lambda error: told.append(str(error)),
        )  # type: ignore[type-var]
        with closing(stream):  # type: ignore[type-var]
            parts = list(islice(stream, 5))
            server.share = 0.03
            parts += islice(stream, 150)
            server.share = 0.0
            parts += islice(stream, 30)
    rows = np.concatenate([np.empty(0, SAMPLE), *parts])
    good = rows[(rows["quality"] & UNUSABLE) == 0]
    true = np.array([plc.pressure(int(number)) * 100.0 for number in good["sequence"] % (1 << 32)])
    np.testing.assert_allclose(good["pressure"], true, rtol=1e-6)
    marked = (rows["quality"][1:] & BREAK) != 0
    assert (marked | (np.diff(rows["sequence"]) == 1)).all()
    assert (np.diff(rows["sequence"][-200:]) == 1).all(), "it did not come back"
    assert rows["sequence"][-1] % (1 << 32) == plc.sequence
    assert len(server.lies) > 8
    assert told
    assert all(server.url in text or "s=" in text for text in told)


def assert_true(rows: Samples, plc: TracePlc) -> None:
    """Each scan is there with its pressure, or between two rows of which the second is marked."""
    scans = rows["sequence"] % (1 << 32)
    true = np.array([plc.pressure(int(scan)) * 100.0 for scan in scans], np.float32)
    np.testing.assert_array_equal(rows["pressure"], true)
    marked = (rows["quality"][1:] & BREAK) != 0
    assert (marked | (np.diff(rows["sequence"]) == 1)).all()
    restarted = (rows["quality"][1:] & Quality.RESTART) != 0
    assert (restarted | (np.diff(rows["sequence"]) > 0)).all()
    assert scans[-1] == plc.sequence
    assert (np.diff(scans[-1000:]) == 1).all(), "it did not come back"
