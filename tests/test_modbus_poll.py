"""Polling slot by slot over a real socket; time passes only when told, but for the last tests."""

import itertools
import struct
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from drivers.modbus.plan import plan
from drivers.modbus.poll import Poller
from drivers.modbus.poll_socket import PollSocket
from drivers.modbus.settings import ModbusSettings
from drivers.modbus.source import blocks
from drivers.reconnect import Clock, LostError
from drivers.tags import Tag
from tests.modbus_server import CUT, ModbusServer, PlcTime
from twin.errors import SourceError
from twin.quality import Quality
from twin.signals import SAMPLE, Command, Samples

TAGS: dict[str, Any] = {
    "pressure": {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"},
    "suction": {"address": "30005", "bit": 0},
    "blow_off": {"address": "30005", "bit": 1},
    "supply": {"address": "30004", "type": "int16", "unit": "mbar", "reference": "gauge"},
    "heartbeat": {"address": "30006", "type": "uint32"},
}


def settings_for(server: ModbusServer, **changes: Any) -> ModbusSettings:
    table = {"host": "127.0.0.1", "port": server.port, "mode": "poll", "tags": TAGS}
    return ModbusSettings.model_validate(table | {"timeout_ms": 60} | changes)


class Plc:
    """A counter of scans; the pressure is 500 mbar and one for each."""

    def __init__(self, server: ModbusServer) -> None:
        self.server = server
        self.sequence = 0
        self.status = 0b01
        self.running = True
        self.scan(0)

    def scan(self, scans: int) -> None:
        self.sequence += scans * self.running
        pressure = struct.unpack(">HH", struct.pack(">f", 500.0 + self.sequence))
        words = [*pressure, 5000, self.status, self.sequence >> 16, self.sequence & 0xFFFF]
        self.server.areas[4][1:7] = words


class Rig:
    """Server, PLC, time, connection and the slots of one test."""

    def __init__(self, server: ModbusServer, **changes: Any) -> None:
        self.server = server
        self.plc = Plc(server)
        self.time = PlcTime(self.plc.scan)
        settings = settings_for(server, **changes)
        self.clock = Clock(self.time.wall_ns, self.time.now_ns, self.time.sleep)
        self.link = PollSocket(settings)
        self.poller = Poller(settings, self.clock)

    def take(self, count: int) -> Samples:
        self.link.open()
        return np.concatenate(list(itertools.islice(self.poller.samples(self.link), count)))


@pytest.fixture
def server() -> Iterator[ModbusServer]:
    with ModbusServer() as server:
        yield server


@pytest.fixture
def rig(server: ModbusServer) -> Iterator[Rig]:
    rig = Rig(server)
    yield rig
    rig.link.close()


def test_one_request_a_slot_gives_one_sample_a_millisecond(rig: Rig) -> None:
    samples = rig.take(4)
    assert len(samples) == 4 * 30
    assert (np.diff(samples["sequence"]) == 1).all()
    assert len(rig.server.requests) == len(samples)
    assert set(rig.server.requests) == {(4, 1, 6)}
    assert not samples["quality"].any()
    scans = samples["pressure"] / 100.0 - 500.0
    assert set(np.diff(scans)) <= {0, 1, 2}  # which scan a slot meets is not ours to say
    assert (samples["supply"] == 500_000).all()
    assert (samples["commands"] == Command.SUCTION).all()


def test_time_is_the_middle_of_the_request_by_a_clock_that_runs_on(rig: Rig) -> None:
    begun = rig.take(1)
    rig.server.hook = lambda function, address, count: setattr(
        rig.time, "ns", rig.time.ns + 400_000
    )
    samples = rig.take(1)
    half = samples["host_ns"] - samples["time_ns"]
    assert (abs(half - 200_000) <= 2_000).all()
    anchored = rig.time.wall_ns
    rig.time.wall_ns = lambda: anchored() - 10**12  # type: ignore[method-assign]
    assert rig.take(1)["time_ns"][0] > samples["time_ns"][-1] > begun["time_ns"][-1]


@pytest.mark.parametrize(("missed_ms", "flagged"), [(15, False), (40, True)])
def test_missed_slots_are_missing_numbers_and_many_are_a_gap(
    rig: Rig, missed_ms: int, flagged: bool
) -> None:
    last = rig.take(1)["sequence"][-1]
    rig.time.sleep(missed_ms * 1e-3)
    samples = rig.take(2)
    assert missed_ms <= samples["sequence"][0] - last <= missed_ms + 2
    assert bool(samples["quality"][0] & Quality.GAP) == flagged
    assert not samples["quality"][1:].any()


def test_a_slow_plc_gives_fewer_slots_but_no_gap(rig: Rig) -> None:
    rig.server.hook = lambda function, address, count: rig.time.sleep(0.0042)
    samples = rig.take(3)
    assert set(np.diff(samples["sequence"])) <= {4, 5}
    assert not samples["quality"].any()


def test_a_heartbeat_at_rest_makes_samples_stale_until_it_beats_again(rig: Rig) -> None:
    rig.take(1)
    rig.plc.running = False
    stopped = rig.take(6)
    fresh = (stopped["quality"] & Quality.STALE) == 0
    assert 95 <= fresh.sum() <= 105
    assert fresh[: fresh.sum()].all()
    rig.plc.running = True
    assert not rig.take(2)["quality"][2:].any()


def test_values_in_several_areas_take_a_request_each(server: ModbusServer) -> None:
    tags = TAGS | {"suction": {"address": "00001"}, "blow_off": {"address": "coil:1"}}
    rig = Rig(server, tags=tags)
    server.areas[1][1] = 1
    samples = rig.take(1)
    rig.link.close()
    assert (samples["commands"] == Command.BLOW_OFF).all()
    assert server.requests[:4] == [(1, 0, 2), (4, 1, 6)] * 2


def test_the_pressure_is_asked_for_last_since_its_time_counts(server: ModbusServer) -> None:
    rig = Rig(server, tags=TAGS | {"pressure": TAGS["pressure"] | {"address": "holding:1"}})
    rig.take(1)
    rig.link.close()
    assert server.requests[:2] == [(4, 3, 4), (3, 1, 2)]


def test_requests_are_as_few_as_125_words_allow() -> None:
    offsets = [300, 0, 124, 125, 200]
    tags = [Tag(address=f"input:{at}", type="int16") for at in offsets]  # type: ignore[arg-type]
    requests = [(request.address.offset, request.count) for request in plan(tags)]
    assert requests == [(0, 125), (125, 76), (300, 1)]


def test_the_slots_before_a_break_are_kept_and_those_after_it_a_gap(rig: Rig) -> None:
    rig.take(1)
    told = iter([None] * 10)
    rig.server.hook = lambda function, address, count: next(told, CUT)
    partly = rig.take(1)
    assert len(partly) == 10
    rig.server.hook = lambda function, address, count: None
    with pytest.raises(LostError, match="no answer"):
        next(rig.poller.samples(rig.link))
    rig.time.sleep(0.5)
    samples = rig.take(1)
    assert samples["quality"][0] == Quality.GAP
    assert samples["sequence"][0] >= partly["sequence"][-1] + 500


def sampled(stream: Iterator[Samples], least: int) -> Samples:
    """Blocks until there are enough samples."""
    block = np.empty(0, SAMPLE)
    while len(block) < least:
        block = np.concatenate([block, next(stream)])
    return block


def test_polling_runs_in_its_own_thread_and_stops_when_closed(server: ModbusServer) -> None:
    rig = Rig(server)
    with closing(blocks(settings_for(server), rig.clock)) as stream:
        samples = sampled(stream, 100)
    assert (np.diff(samples["sequence"]) >= 1).all()


def test_in_real_time_a_lost_connection_comes_back_with_a_gap(server: ModbusServer) -> None:
    Plc(server)
    tags = {name: TAGS[name] for name in ("pressure", "suction", "blow_off")}
    with closing(blocks(settings_for(server, tags=tags))) as stream:
        sampled(stream, 30)
        server.hang_up()
        while not (samples := next(stream))["quality"].any():
            pass
    assert samples["quality"][0] == Quality.GAP


def test_a_refused_address_comes_out_of_the_thread(server: ModbusServer) -> None:
    server.refused = [range(3, 4)]
    with (
        closing(blocks(settings_for(server))) as stream,
        pytest.raises(SourceError, match=r"input:1–6 \[30002–30007\]: illegal data address"),
    ):
        sampled(stream, 1)


def test_no_plc_comes_out_of_the_thread(server: ModbusServer) -> None:
    with ModbusServer() as gone:
        pass
    with pytest.raises(SourceError, match="no connection"):
        sampled(blocks(settings_for(gone)), 1)
