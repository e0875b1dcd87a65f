"""The PLC's ring, followed over a real socket; the PLC's time and ours pass only when told."""

import itertools
import re
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.modbus.settings import ModbusSettings
from drivers.modbus.source import blocks
from drivers.reconnect import Away, Clock
from tests.modbus_server import CUT, HALF, SILENT, ModbusServer, PlcTime, TracePlc
from twin.errors import ConfigError, SourceError, TwinError
from twin.events import Kind
from twin.monitor.clock import ClockWatch
from twin.quality import Quality
from twin.settings import Document
from twin.signals import SAMPLE, Samples

TAGS = {
    "pressure": {
        "address": "input:1",
        "type": "float32",
        "unit": "mbar",
        "reference": "absolute",
        "range": [0, 1300],
    },
    "supply": {"address": "input:3", "type": "int16", "unit": "mbar", "reference": "gauge"},
}


def settings_for(server: ModbusServer, **changes: Any) -> ModbusSettings:
    table = {"host": "127.0.0.1", "port": server.port, "timeout_ms": 250, "tags": TAGS}
    return ModbusSettings.model_validate(table | changes)


def clock_of(time: PlcTime) -> Clock:
    return Clock(time.wall_ns, time.now_ns, time.sleep)


class Rig:
    """Server, PLC, time and the stream of one test."""

    def __init__(
        self, server: ModbusServer, plc: TracePlc, away: Away | None = None, **changes: Any
    ) -> None:
        self.server = server
        self.plc = plc
        self.time = PlcTime(lambda scans: self.plc.scan(scans))  # noqa: PLW0108 - tests replace scan
        told = settings_for(server, **changes)
        self.stream = blocks(told, clock_of(self.time), away=away)

    def take(self, count: int) -> Samples:
        return np.concatenate([np.empty(0, SAMPLE), *itertools.islice(self.stream, count)])

    def at_work(self) -> "Rig":
        assert len(self.take(3))
        return self


@pytest.fixture
def server() -> Iterator[ModbusServer]:
    with ModbusServer() as server:
        yield server


@pytest.fixture
def rig(server: ModbusServer) -> Iterator[Rig]:
    rig = Rig(server, TracePlc(server))
    with closing(rig.stream):
        yield rig


def flags(samples: Samples, quality: int) -> list[int]:
    """Rows that carry it."""
    return [int(row) for row in np.flatnonzero(samples["quality"] & quality)]


def assert_whole(samples: Samples) -> None:
    """Nothing missing, nothing twice, nothing flagged, PLC time as the PLC's."""
    assert (np.diff(samples["sequence"]) == 1).all()
    assert (np.diff(samples["time_ns"]) == 1_000_000).all()
    assert not samples["quality"].any()


def test_every_scan_comes_once_with_its_values_and_times(rig: Rig) -> None:
    rig.plc.status = 0b10
    samples = rig.take(20)
    assert_whole(samples)
    assert samples["sequence"][0] == 10  # the newest when we came, and no flag
    assert samples["sequence"][-1] == rig.plc.sequence
    assert samples["time_ns"][-1] == rig.plc.time_ns
    expected = (200.0 + samples["sequence"] % 512) * 100.0
    np.testing.assert_array_equal(samples["pressure"], expected.astype(np.float32))
    assert (samples["supply"] == 500_000.0).all()
    assert set(samples["commands"][1:]) == {0b10}
    assert (np.diff(samples["host_ns"]) >= 0).all()
    assert samples["host_ns"][-1] <= rig.time.wall_ns()


def test_reading_takes_few_requests(rig: Rig) -> None:
    rig.take(21)
    assert len(rig.server.requests) == 3 + 2 * 21  # to begin; then header and records
    assert max(count for _, _, count in rig.server.requests) <= 125


def test_little_word_order(server: ModbusServer) -> None:
    rig = Rig(server, TracePlc(server, little=True), word_order="little")
    with closing(rig.stream):
        samples = rig.take(5)
    assert_whole(samples)
    assert samples["pressure"][0] == 21_000.0


@pytest.mark.parametrize("order", ["big", "little"])
@pytest.mark.parametrize("sequence", [5, 70_000])
def test_the_wrong_word_order_is_told_at_once(
    server: ModbusServer, order: str, sequence: int
) -> None:
    plc = TracePlc(server, little=order == "big")
    plc.scan(sequence)
    with pytest.raises(SourceError) as caught:
        next(Rig(server, plc, word_order=order).stream)
    assert "word_order" in caught.value.hint


def test_supply_is_missing_where_no_tag_declares_it(server: ModbusServer) -> None:
    rig = Rig(server, TracePlc(server), tags={"pressure": TAGS["pressure"]})
    with closing(rig.stream):
        assert np.isnan(rig.take(3)["supply"]).all()


def test_values_that_are_none_are_flagged(rig: Rig) -> None:
    values = {40: float("nan"), 41: 1400.0, 42: float("inf")}
    rig.plc.pressure = lambda sequence: values.get(sequence, 500.0)
    samples = rig.take(3)
    assert list(samples["sequence"][flags(samples, Quality.BAD)]) == [40, 42]
    assert list(samples["sequence"][flags(samples, Quality.OUT_OF_RANGE)]) == [41, 42]
    assert np.isnan(samples["pressure"][flags(samples, Quality.BAD)]).all()
    rig.plc.status = 1 << 8
    assert (rig.take(2)["quality"] == Quality.OVERFLOW).all()


def test_a_stall_of_four_seconds_loses_nothing_and_blocks_stay_bounded(rig: Rig) -> None:
    before = rig.take(3)
    rig.time.sleep(4.0)
    assert_whole(np.concatenate([before, rig.take(5)]))


def test_a_slow_link_yields_a_block_in_time_and_still_loses_nothing(rig: Rig) -> None:
    rig.at_work()
    rig.time.sleep(2.0)
    rig.server.hook = lambda function, address, count: rig.time.sleep(0.02)
    sizes = [len(next(rig.stream)) for _ in range(60)]
    assert max(sizes) <= 7 * 31  # 0.1 s at 20 ms a request
    rest = rig.take(300)
    assert_whole(rest)
    assert rig.plc.sequence - rest["sequence"][-1] < 200


def test_too_slow_for_the_ring_takes_what_is_left_and_flags_the_gap(rig: Rig) -> None:
    last = rig.take(3)["sequence"][-1]
    rig.time.sleep(10.0)
    samples = rig.take(3)
    assert flags(samples, Quality.GAP) == [0]
    assert last + 5000 < samples["sequence"][0] < rig.plc.sequence - 3900
    assert_whole(samples[1:])
    np.testing.assert_array_equal(samples["pressure"], pressures(samples))


def pressures(samples: Samples) -> np.ndarray:
    return ((200.0 + samples["sequence"] % 512) * 100.0).astype(np.float32)


def test_a_record_that_is_just_being_overwritten_is_not_read(rig: Rig) -> None:
    rig.at_work()
    rig.time.sleep(6.0)

    def half_written(function: int, address: int, count: int) -> None:  # the sequence still old
        oldest = 1000 + 4 * ((rig.plc.sequence + 1) % rig.plc.depth)
        rig.plc.put(3, oldest + 2, rig.plc.words(">f", 999.0))

    rig.server.hook = half_written
    samples = rig.take(1)
    np.testing.assert_array_equal(samples["pressure"], pressures(samples))


def test_records_overwritten_while_they_are_read_are_not_believed(rig: Rig) -> None:
    rig.at_work()
    rig.time.sleep(4.0)  # the oldest are about to be overwritten

    def lap_exactly(function: int, address: int, count: int) -> None:
        if address >= 1000:  # 65536 scans on, the low words would fit again
            rig.server.hook = lambda function, address, count: None
            rig.plc.scan(65536)
            rig.time.ns += 3_000_000_000

    rig.server.hook = lap_exactly
    samples = rig.take(4)
    assert flags(samples, Quality.GAP) == [0]
    np.testing.assert_array_equal(samples["pressure"], pressures(samples))
    assert samples["sequence"][0] > 60_000


def test_a_restart_while_records_are_read_discards_them(rig: Rig) -> None:
    rig.at_work()
    rig.time.sleep(4.0)

    def restart(function: int, address: int, count: int) -> None:
        if address >= 1000:
            rig.server.hook = lambda function, address, count: None
            rig.plc.restart()
            rig.time.ns += 3_000_000_000

    rig.server.hook = restart
    samples = rig.take(3)
    assert samples["quality"][0] == Quality.RESTART | Quality.GAP
    assert samples["sequence"][0] == 0
    assert_whole(samples[1:])


def test_torn_records_are_missing_and_flagged_behind(rig: Rig) -> None:
    rig.at_work()
    scan = rig.plc.scan

    def scan_torn(scans: int) -> None:
        scan(scans)
        rig.plc.put(3, 1000 + 4 * 80, [79])
        rig.plc.put(3, 1000 + 4 * 83, [0xFFFF])

    rig.plc.scan = scan_torn  # type: ignore[method-assign]
    samples = rig.take(3)
    assert not {80, 83} & set(samples["sequence"])
    assert list(samples["sequence"][flags(samples, Quality.GAP)]) == [81, 84]
    assert len(samples) > 50


def test_records_that_come_after_their_header_are_waited_for(rig: Rig) -> None:
    before = rig.take(3)
    publish = rig.plc.publish

    def publish_early() -> None:
        rig.plc.sequence += 2
        rig.plc.time_ns += 2_000_000
        publish()
        rig.plc.sequence -= 2
        rig.plc.time_ns -= 2_000_000

    rig.plc.publish = publish_early  # type: ignore[method-assign]
    samples = rig.take(5)
    assert_whole(np.concatenate([before, samples]))
    assert samples["sequence"][-1] == rig.plc.sequence


def test_a_ring_that_carries_other_records_is_told_at_the_start(server: ModbusServer) -> None:
    rig = Rig(server, TracePlc(server), ring={"records": "holding:30000"})
    with pytest.raises(SourceError, match=r"records at holding:30000 \[430001\]"):
        next(rig.stream)


def test_no_trace_at_all_is_told_at_the_start(server: ModbusServer) -> None:
    rig = Rig(server, TracePlc(server), ring={"header": "40301"})
    with pytest.raises(SourceError, match=r"no trace header at holding:300–311 \[40301–40312\]"):
        next(rig.stream)


def test_a_torn_header_is_read_again(rig: Rig) -> None:
    before = rig.at_work().take(1)

    def tear(function: int, address: int, count: int) -> None:
        if address == 100:
            rig.plc.put(3, 100, [5])  # the high word of the sequence
            rig.server.hook = repair

    def repair(function: int, address: int, count: int) -> None:
        rig.plc.publish()

    rig.server.hook = tear
    assert_whole(np.concatenate([before, rig.take(3)]))


@pytest.mark.parametrize("boot", [None, 7], ids=["boot counter", "sequence only"])
def test_a_restart_is_flagged_and_goes_on_from_zero(rig: Rig, boot: int | None) -> None:
    rig.plc.scan(500)
    rig.at_work()
    rig.plc.restart(boot=boot)
    samples = rig.take(3)
    assert samples["sequence"][0] == 0
    assert samples["quality"][0] == Quality.RESTART | Quality.GAP  # what ran meanwhile
    assert_whole(samples[1:])


def test_a_restart_that_sets_the_clock_back_is_flagged_as_both(rig: Rig) -> None:
    rig.at_work()
    rig.plc.time_ns = 0
    rig.plc.restart()
    samples = rig.take(3)
    assert samples["quality"][0] == Quality.RESTART | Quality.CLOCK | Quality.GAP
    assert_whole(samples[1:])


def test_a_restart_behind_our_back_is_flagged_with_what_is_missing(rig: Rig) -> None:
    rig.at_work()
    rig.plc.restart()
    rig.time.sleep(9.0)
    samples = rig.take(2)
    assert samples["quality"][0] == Quality.RESTART | Quality.GAP
    assert_whole(samples[1:])


@pytest.mark.parametrize("jump_ms", [-3_600_000, -1000, 51, 3_600_000])
def test_a_jump_of_the_plcs_clock_is_flagged_and_followed(rig: Rig, jump_ms: int) -> None:
    last = rig.take(3)[-1]
    rig.plc.time_ns += jump_ms * 1_000_000
    rig.time.sleep(0.03)
    samples = rig.take(3)
    assert flags(samples, Quality.CLOCK) == [0]
    assert_whole(samples[1:])
    assert samples["time_ns"][0] == last["time_ns"] + (jump_ms + 1) * 1_000_000


def test_a_small_correction_of_the_plcs_clock_is_no_jump(rig: Rig) -> None:
    rig.at_work()
    rig.plc.time_ns += 2_000_000
    assert not rig.take(3)["quality"].any()


def test_a_clock_that_is_set_ahead_by_little_is_told_once(rig: Rig) -> None:
    rig.at_work()
    watch = ClockWatch()
    before = rig.take(100)
    rig.plc.time_ns += 20_000_000
    samples = np.concatenate([before, rig.take(20)])
    (jump,) = [event for block in rigs.cut(samples, 30) for event in watch.push(block)]
    assert jump.kind is Kind.CLOCK_JUMPED
    assert jump.data["jump_s"] * 1e3 == pytest.approx(20.0, abs=1.0)


def test_a_small_step_back_of_the_plcs_clock_is_flagged(rig: Rig) -> None:
    last = rig.take(3)[-1]
    rig.plc.time_ns -= 10_000_000
    rig.time.sleep(0.005)
    samples = rig.take(2)
    assert flags(samples, Quality.CLOCK) == [0]
    assert samples["time_ns"][0] < last["time_ns"]


def test_a_plc_that_stands_still_gives_empty_blocks_and_then_goes_on(rig: Rig) -> None:
    before = rig.take(3)
    scan, rig.plc.scan = rig.plc.scan, lambda scans: None  # type: ignore[method-assign]
    assert not len(rig.take(20)[30:])
    rig.plc.scan = scan  # type: ignore[method-assign]
    samples = rig.take(4)
    assert samples["sequence"][0] > before["sequence"][-1]
    assert_whole(samples)


@pytest.mark.parametrize("depth", [4096, 4000])
def test_the_sequence_goes_on_beyond_32_bits(server: ModbusServer, depth: int) -> None:
    plc = TracePlc(server, depth)
    plc.sequence = 2**32 - 200
    plc.scan(100)
    rig = Rig(server, plc)
    with closing(rig.stream):
        samples = rig.take(10)
    assert_whole(samples)
    assert samples["sequence"][-1] > 2**32
    np.testing.assert_array_equal(samples["pressure"], pressures(samples))


@pytest.mark.parametrize("how", [CUT, HALF, SILENT, 6, 11])
def test_a_lost_connection_comes_back_and_the_ring_fills_the_gap(rig: Rig, how: str | int) -> None:
    before = rig.at_work().take(1)
    broken = iter([None, how])  # in the middle of a block: after its header
    rig.server.hook = lambda function, address, count: next(broken, None)
    rig.time.sleep(0.2)
    samples = [next(rig.stream) for _ in range(8)]
    assert [len(block) for block in samples[:3]] == [0, 0, 0]
    assert_whole(np.concatenate([before, *samples]))


def test_a_connection_that_left_a_request_unanswered_is_given_up(rig: Rig) -> None:
    rig.at_work()
    told = iter([SILENT])  # its answer might come late, for the next request
    rig.server.hook = lambda function, address, count: next(told, None)
    rig.take(8)
    assert rig.server.accepted == 2


def test_away_for_longer_than_the_ring_is_a_gap(rig: Rig) -> None:
    rig.at_work()
    port = rig.server.port
    rig.server.stop()
    assert not len(rig.take(50))  # 10 s of trying
    with ModbusServer(port=port) as server:
        rig.plc.server = server
        rig.plc.scan(4096)
        samples = rig.take(6)
    assert samples["quality"][0] == Quality.GAP
    assert_whole(samples[1:])


def test_while_the_plc_is_away_a_block_comes_every_quarter_second(rig: Rig) -> None:
    rig.at_work()
    rig.server.hook = lambda function, address, count: CUT
    next(rig.stream)
    for _ in range(20):
        before = rig.time.ns
        assert len(next(rig.stream)) == 0
        assert rig.time.ns - before <= 250_000_000
    rig.server.hook = lambda function, address, count: None
    before = rig.time.ns
    assert any(len(next(rig.stream)) for _ in range(12))
    assert rig.time.ns - before <= 2_000_000_000


def test_a_plc_that_starts_with_an_empty_header_is_waited_for(rig: Rig) -> None:
    rig.at_work()
    scan, rig.plc.scan = rig.plc.scan, lambda scans: None  # type: ignore[method-assign]
    rig.plc.put(3, 100, [0] * 12)
    assert not len(rig.take(5))
    rig.plc.scan = scan  # type: ignore[method-assign]
    rig.plc.restart()
    assert rig.take(8)["quality"][0] == Quality.RESTART | Quality.GAP


@pytest.mark.parametrize("why", [CUT, "blank header", "illegal address"])
def test_a_plc_that_is_not_there_yet_is_tried_until_it_is_and_said_once(why: str) -> None:
    told: list[str] = []
    with ModbusServer() as server:
        time = PlcTime(lambda _scans: None)
        stream = blocks(
            settings_for(server), clock_of(time), away=lambda error: told.append(str(error))
        )
        with closing(stream):
            if why == CUT:
                server.hook = lambda *_: CUT
            if why == "illegal address":
                server.refused = [range(65536)]
            assert not any(len(next(stream)) for _ in range(20))
            server.hook = lambda *_: None
            server.refused = []
            time.scan = TracePlc(server).scan
            assert any(len(next(stream)) for _ in range(8))
    assert len(told) == 1


def test_an_address_that_is_not_served_any_more_is_tried_until_it_is(rig: Rig) -> None:
    """As while the PLC takes a new program."""
    rig.at_work()
    rig.server.refused = [range(100, 112)]
    assert not any(len(next(rig.stream)) for _ in range(8))
    rig.server.refused = []
    assert any(len(next(rig.stream)) for _ in range(8))


@pytest.mark.parametrize("code", range(1, 12))
def test_a_request_that_is_refused_once_rows_came_is_a_lost_connection(code: int) -> None:
    told: list[TwinError] = []
    with ModbusServer() as server:
        rig = Rig(server, TracePlc(server), away=told.append)
        with closing(rig.stream):
            rig.at_work()
            server.hook = lambda *_: code
            assert not len(rig.take(8))
            server.hook = lambda *_: None
            assert (np.diff(rig.take(12)["sequence"]) == 1).all()
    (reason,) = told
    assert re.search(r"holding:100–111 \[40101–40112\]: .+ \(Modbus exception", str(reason))


def header(plc: TracePlc, **changes: Any) -> list[int]:
    """Words of the trace's header that say something else."""
    said = {"sequence": plc.sequence, "time_ns": plc.time_ns, "boot": plc.boot}
    said |= {"period": 1000, "depth": plc.depth, "words": 4} | changes
    counts = [said[name] for name in ("boot", "period", "depth", "words")]
    return [*plc.words(">I", said["sequence"]), *plc.words(">q", said["time_ns"]), *counts, 5000, 0]


@pytest.mark.parametrize(
    ("lie", "says"),
    [
        ({"depth": 0}, "it says 0 records of 4 words"),
        ({"depth": 65535}, "it says 65535 records of 4 words"),
        ({"words": 5}, "of 5 words"),
        ({"period": 0}, "one every 0 µs"),
        ({"boot": 8, "time_ns": 2**63 - 1}, "the newest at 9223372036854775807 ns"),
        ({"boot": 8, "time_ns": -(2**63)}, "the newest at -9223372036854775808 ns"),
        ({"sequence": 700_001}, "do not carry the sequence numbers that the header"),
        ({"sequence": 2**31}, "do not carry the sequence numbers that the header"),
    ],
)
def test_a_header_that_lies_once_rows_came_is_a_lost_connection(
    lie: dict[str, int], says: str
) -> None:
    told: list[TwinError] = []
    with ModbusServer() as server:
        rig = Rig(server, TracePlc(server), away=told.append)
        with closing(rig.stream):
            before = rig.at_work().take(1)
            scan, rig.plc.scan = rig.plc.scan, lambda _scans: None  # type: ignore[method-assign]
            rig.plc.put(3, 100, header(rig.plc, **lie))
            assert not len(rig.take(6))
            rig.plc.scan = scan  # type: ignore[method-assign]
            after = rig.take(16)
    assert says in str(told[0])
    assert len(after)
    assert_whole(np.concatenate([before, after]))


def refuse_to_start(server: ModbusServer, **changes: Any) -> SourceError:
    TracePlc(server)
    with pytest.raises(SourceError) as caught:
        next(blocks(settings_for(server, **changes)))
    assert f"127.0.0.1:{changes.get('port', server.port)}" in str(caught.value)
    assert caught.value.hint
    return caught.value


def test_no_plc_at_the_port(server: ModbusServer) -> None:
    with ModbusServer() as gone:
        pass
    assert "no connection" in str(refuse_to_start(server, port=gone.port))


def test_a_wrong_unit_id_gets_no_answer(server: ModbusServer) -> None:
    error = refuse_to_start(server, unit=9)
    assert "unit 9: holding:100–111 [40101–40112]: no answer" in str(error)
    assert "unit id" in error.hint


def test_a_wrong_unit_id_behind_a_gateway(server: ModbusServer) -> None:
    server.hook = lambda function, address, count: 11
    assert "the unit does not answer (Modbus exception 11)" in str(refuse_to_start(server))


def test_a_register_out_of_range(server: ModbusServer) -> None:
    server.refused = [range(4000, 65536)]
    error = refuse_to_start(server, ring={"header": "44096"})
    assert "holding:4095–4106 [44096–44107]: illegal data address" in str(error)
    assert "40001" in error.hint


def test_a_server_of_another_kind_at_the_port(server: ModbusServer) -> None:
    server._answer = lambda connection, request: (  # type: ignore[method-assign]
        connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n") or True
    )
    assert "no answer" in str(refuse_to_start(server))


def test_an_answer_of_the_wrong_length(server: ModbusServer) -> None:
    server._pdu = lambda function, address, count, told: bytes([function, 2, 0, 0])  # type: ignore[method-assign]
    assert "wrong length" in str(refuse_to_start(server))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "poll"}, "polling needs the tags suction and blow_off"),
        ({"tags": {"pressure": TAGS["supply"]}}, "32-bit"),
        ({"ring": {"header": "coil:0"}}, "holding or input"),
        ({"tags": TAGS | {"suction": TAGS["supply"] | {"unit": "mbar"}}}, "suction"),
    ],
)
def test_settings_that_cannot_work_are_refused(
    server: ModbusServer, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        settings_for(server, **changes)


Act = Callable[[Rig], None]
ACTS: dict[str, Act] = {
    "run": lambda rig: rig.time.sleep(0.05),
    "stall": lambda rig: rig.time.sleep(3.9),
    "overrun": lambda rig: rig.time.sleep(6.0),
    "restart": lambda rig: rig.plc.restart(),
    "hang up": lambda rig: rig.server.hang_up(),
    "clock": lambda rig: setattr(rig.plc, "time_ns", rig.plc.time_ns + 500_000_000),
}


@settings(max_examples=25, deadline=None)
@given(st.lists(st.sampled_from(sorted(ACTS)), max_size=8))
def test_whatever_happens_rows_are_true_and_breaks_are_flagged(acts: list[str]) -> None:
    with ModbusServer() as server:
        rig = Rig(server, TracePlc(server))
        with closing(rig.stream):
            taken = [rig.take(2)]
            for act in acts:
                ACTS[act](rig)
                taken.append(rig.take(7))
            rig.time.sleep(0.05)
            taken.append(rig.take(12))
    samples = np.concatenate(taken)
    np.testing.assert_array_equal(samples["pressure"], pressures(samples))
    assert samples["sequence"][-1] >= rig.plc.sequence - 31
    after, steps = samples["quality"][1:], np.diff(samples["sequence"])
    restarted, lost = (after & Quality.RESTART) != 0, (after & Quality.GAP) != 0
    assert ((steps == 1) | restarted | lost).all()
    assert ((steps > 0) | restarted).all()
    assert restarted.sum() <= acts.count("restart")
    even = np.diff(samples["time_ns"]) == steps * 1_000_000
    assert (even | restarted | ((after & Quality.CLOCK) != 0)).all()


BLOCK = """[driver]
host = "plc"

[driver.tags.pressure]
address = "30002"
type = "float32"
unit = "mbar"
reference = "absolute"

[driver.tags.{tag}]
{lines}
"""


@pytest.mark.parametrize(
    ("tag", "lines"),
    [
        ("suction", 'address = "30005"\nbit = 0'),
        ("blow_off", 'address = "30005"\nbit = 1'),
        ("suction", 'address = "00001"'),
        ("blow_off", 'address = "coil:1"'),
    ],
)
def test_a_command_where_the_register_map_has_it_is_taken(tag: str, lines: str) -> None:
    text = BLOCK.format(tag=tag, lines=lines)
    assert Document.parse(text, "cell.toml").section(ModbusSettings, "driver").mode == "block"


@pytest.mark.parametrize(
    ("tag", "lines"),
    [
        ("suction", 'address = "30005"\nbit = 1'),
        ("blow_off", 'address = "30005"\nbit = 0'),
        ("suction", 'address = "coil:1"'),
        ("blow_off", 'address = "00001"'),
        ("suction", 'address = "holding:20"\nbit = 0'),
        ("suction", 'address = "discrete:0"'),
        ("heartbeat", 'address = "30006"\ntype = "uint32"'),
    ],
)
def test_a_tag_that_would_have_no_effect_is_refused(tag: str, lines: str) -> None:
    text = BLOCK.format(tag=tag, lines=lines)
    with pytest.raises(ConfigError, match="has no effect in block mode") as caught:
        Document.parse(text, "cell.toml").section(ModbusSettings, "driver")
    assert f"cell.toml:10: driver.tags.{tag}: " in str(caught.value)
    assert f"eave out [driver.tags.{tag}]" in str(caught.value)


def test_a_setting_of_polling_is_refused_in_block_mode() -> None:
    text = BLOCK.format(tag="blow_off", lines='address = "coil:1"')
    text = text.replace('"plc"', '"plc"\ngap_ms = 50')
    with pytest.raises(ConfigError, match=r"cell\.toml:3: driver\.gap_ms: .*has no effect"):
        Document.parse(text, "cell.toml").section(ModbusSettings, "driver")
    polled = text.replace("gap_ms", 'mode = "poll"\ngap_ms')
    polled += '[driver.tags.suction]\naddress = "holding:20"\nbit = 7\n'
    assert Document.parse(polled, "cell.toml").section(ModbusSettings, "driver").gap_ms == 50
