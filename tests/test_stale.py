"""While the PLC is stale one alarm stands, and no other is raised; the clock here is the test's."""

from collections.abc import Iterator, Sequence
from itertools import takewhile

import numpy as np
import pytest
import rigs
import test_modbus_block
import test_opcua_block
from modbus_server import CUT, ModbusServer, PlcTime, TracePlc
from rigs import Collect

from twin.diagnosis import process
from twin.diagnosis.process import LiveDiagnosis
from twin.events import Event, Kind
from twin.live import run
from twin.monitor.detect import Monitor
from twin.signals import SAMPLE, Command, Quality, Samples, Ticks

EMPTY = np.empty(0, SAMPLE)
S, MS = 1_000_000_000, 1_000_000
STALENESS = (Kind.PLC_STALE, Kind.PLC_BACK)


def kinds(events: Sequence[Event]) -> list[Kind]:
    return [event.kind for event in events]


# A PLC that answers, and whose program stands still.


class Beside:
    """The loop beside a PLC of the test's own time, ended when the PLC is back or time is over."""

    def __init__(self, stream: Iterator[Samples], time: PlcTime) -> None:
        self.seen = Collect()
        self.time, self.stream = time, stream

    def run(self, seconds: float) -> list[Event]:
        end = self.time.ns + round(seconds * S)
        blocks = takewhile(lambda _: self.time.ns < end, self.stream)
        monitor = Monitor(rigs.config("test_rig").monitor, rigs.theta("test_rig"))
        run(blocks, rigs.twin("test_rig"), monitor, [self.seen], self.time.wall_ns)
        return self.seen.of(*STALENESS, Kind.PLC_RESTARTED, Kind.GAP)


def standing_still(scan: object, time: PlcTime, begin_s: float, end_s: float) -> object:
    """A PLC's scan that does nothing between two times, though the PLC answers."""
    start = time.ns

    def scan_or_not(scans: int) -> None:
        if not begin_s <= (time.ns - start) / S < end_s:
            scan(scans)  # type: ignore[operator]

    return scan_or_not


@pytest.mark.parametrize("lasts_s", [3.0, 1000.0])
def test_a_modbus_header_that_repeats_for_ever_is_stale(lasts_s: float) -> None:
    with ModbusServer() as server:
        rig = test_modbus_block.Rig(server, TracePlc(server))
        rig.plc.scan = standing_still(rig.plc.scan, rig.time, 2.0, 2.0 + lasts_s)  # type: ignore[assignment]
        told = Beside(rig.stream, rig.time).run(8.0)
    if lasts_s < 8:
        assert kinds(told) == [Kind.PLC_STALE, Kind.PLC_BACK]
        assert told[1].data["silence_ms"] == pytest.approx(1e3 * lasts_s, abs=100)
    else:
        assert kinds(told) == [Kind.PLC_STALE]


@pytest.mark.parametrize("lasts_s", [3.0, 1000.0])
def test_an_opcua_trace_that_repeats_for_ever_is_stale(lasts_s: float) -> None:
    server = test_opcua_block.TornServer()
    rig = test_opcua_block.Rig(server)
    rig.time.scan = standing_still(server.scan, rig.time, 2.0, 2.0 + lasts_s)  # type: ignore[assignment]
    told = Beside(rig.stream, rig.time).run(8.0)
    assert kinds(told) == [Kind.PLC_STALE, Kind.PLC_BACK][: 2 if lasts_s < 8 else 1]


def test_a_connection_that_comes_and_goes_for_longer_than_the_ring_is_one_silence_each() -> None:
    with ModbusServer() as server:
        rig = test_modbus_block.Rig(server, TracePlc(server))
        start = rig.time.ns

        def cut(*_: int) -> str | None:
            second = (rig.time.ns - start) / S
            return CUT if 2 <= second < 8 or 11 <= second < 18 else None

        server.hook = cut
        told = Beside(rig.stream, rig.time).run(22.0)
    assert kinds(told) == [Kind.PLC_STALE, Kind.PLC_BACK, Kind.GAP] * 2


@pytest.mark.parametrize("size", [1, 100])
def test_a_silence_that_the_ring_fills_is_told_before_its_end(size: int) -> None:
    """The program here was stopped: nothing is missing, and no empty block came."""
    samples = rigs.recorded("test_rig", 20.0)[0][:3000].copy()
    samples["host_ns"][2000:] += 900 * MS
    seen = rigs.watch("test_rig", rigs.cut(samples, size))
    assert kinds(seen.of(*STALENESS)) == [Kind.PLC_STALE, Kind.PLC_BACK]


# Values that the driver calls stale: a polled PLC whose heartbeat is at rest.


def with_stale(samples: Samples, begin: int, end: int) -> Samples:
    samples = samples.copy()
    samples["quality"][begin:end] |= Quality.STALE.value
    return samples


def healthy(seconds: float = 20.0) -> Samples:
    return rigs.recorded("test_rig", seconds)[0]


@pytest.mark.parametrize("size", [30, 333, 10_000])
def test_rows_that_are_not_fresh_are_silence(size: int) -> None:
    samples = with_stale(healthy(), 6000, 8500)
    seen = rigs.watch("test_rig", rigs.cut(samples, size))
    stale, back = seen.of(*STALENESS)
    assert kinds([stale, back]) == [Kind.PLC_STALE, Kind.PLC_BACK]
    assert stale.time_ns == samples["time_ns"][5999] + 500 * MS
    assert back.time_ns == samples["time_ns"][8500]
    assert back.data["silence_ms"] == pytest.approx(2501)
    assert kinds(seen.of(Kind.SIGNAL_BAD, Kind.SIGNAL_GOOD)) == [Kind.SIGNAL_BAD, Kind.SIGNAL_GOOD]


def test_short_of_the_limit_it_is_none() -> None:
    samples = with_stale(healthy(), 6000, 6490)
    assert rigs.watch("test_rig", [samples]).of(*STALENESS) == []


def test_what_follows_silence_of_both_kinds_is_one_silence() -> None:
    """First the heartbeat is at rest, then the connection is gone, then at rest again."""
    samples = with_stale(healthy(), 6000, 6600)
    samples["host_ns"][6300:] += 3 * S
    samples["time_ns"][6300:] += 3 * S
    samples["sequence"][6300:] += 3000
    samples["quality"][6300] |= Quality.GAP.value
    live = Collect()
    now = 0

    def blocks() -> Iterator[Samples]:
        nonlocal now
        for block in [*rigs.cut(samples[:6300], 30), *[EMPTY] * 25, *rigs.cut(samples[6300:], 30)]:
            now = int(block["host_ns"][-1]) if len(block) else now + 100 * MS
            yield block

    run(blocks(), rigs.twin("test_rig"), rigs.monitor("test_rig"), [live], lambda: now)
    replayed = rigs.watch("test_rig", rigs.cut(samples, 1000))
    assert kinds(live.of(*STALENESS)) == [Kind.PLC_STALE, Kind.PLC_BACK]
    assert sorted(live.events, key=str) == sorted(replayed.events, key=str)


# Alarms of the twin.


def lost(samples: Samples, row: int, seconds: float) -> Samples:
    """Nothing comes for so long, and what the PLC did meanwhile is lost."""
    rows = round(seconds * 1000)
    rest = np.delete(samples, np.s_[row : row + rows])
    rest["quality"][row] |= Quality.GAP.value
    return rest


def edges(samples: Samples) -> list[int]:
    """Rows at which suction begins."""
    suction = (samples["commands"] & Command.SUCTION).astype(int)
    return [int(row) + 1 for row in np.flatnonzero(np.diff(suction) == 1)]


@pytest.mark.parametrize("after_s", [0.3, 1.0, 2.35, 2.5, 2.9])  # suction, hold, blow-off, idle
def test_a_cycle_that_silence_cuts_is_not_judged(after_s: float) -> None:
    """It deviates for the first time; the first whole one after the silence raises the alarm."""
    faulty = rigs.recorded("test_rig", 36.0, ("blow_off_delay=20@c4",), 3)[0].copy()
    faulty["host_ns"] += 5 * MS
    begin = edges(faulty)[4] + round(after_s * 1000)
    seen = rigs.watch("test_rig", rigs.cut(lost(faulty, begin, 2.0), 100))
    (back,) = seen.of(Kind.PLC_BACK)
    assert kinds(seen.of(*STALENESS)) == [Kind.PLC_STALE, Kind.PLC_BACK]
    raised = seen.of(Kind.DEVIATION)
    assert raised
    assert raised[0].time_ns > back.time_ns + 3 * S  # one to swing in, one to be judged


def test_without_the_silence_the_same_cycle_is_the_one_that_raises_it() -> None:
    faulty = rigs.recorded("test_rig", 36.0, ("blow_off_delay=20@c4",), 3)[0]
    (raised, *_) = rigs.watch("test_rig", rigs.cut(faulty, 100)).of(Kind.DEVIATION)
    assert raised.data["cycle"] == 4


@pytest.mark.parametrize("after_s", [0.5, 1.5, 2.4])
def test_commands_that_nobody_saw_are_no_deviation(after_s: float) -> None:
    """The PLC's program stood still, as far as could be read; the valves did something else."""
    samples = rigs.recorded("test_rig", 36.0)[0].copy()
    begin = edges(samples)[4] + round(after_s * 1000)
    samples["commands"][begin : begin + 1500] = samples["commands"][begin - 1]
    seen = rigs.watch("test_rig", rigs.cut(with_stale(samples, begin, begin + 1500), 100))
    assert kinds(seen.of(*STALENESS)) == [Kind.PLC_STALE, Kind.PLC_BACK]
    assert seen.of(Kind.DEVIATION) == []


def test_at_the_end_of_a_silence_that_does_not_end_nothing_is_judged() -> None:
    faulty = rigs.recorded("test_rig", 36.0, ("leakage=4@c4",), 3)[0]
    end = edges(faulty)[5] - 100  # it deviates, and has come to idle
    now = int(faulty["host_ns"][end - 1]) + S
    for empty, raises in ((1, 0), (0, 1)):
        seen = Collect()
        blocks = [*rigs.cut(faulty[:end], 100), *[EMPTY] * empty]
        run(blocks, rigs.twin("test_rig"), rigs.monitor("test_rig"), [seen], lambda: now)
        assert len(seen.of(Kind.PLC_STALE)) == empty
        assert len(seen.of(Kind.DEVIATION)) == raises


def test_no_diagnosis_is_asked_for_while_it_is_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    """An alarm that waits for cycles goes on waiting; its diagnosis comes with the cycles."""
    asked: list[int] = []

    class Asking(LiveDiagnosis):
        def _ask(self, alarm: Event) -> list[Event]:
            asked.append(len(seen.of(Kind.CYCLE)))
            self._alarm = None
            return []

    class Watch(Collect):
        def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
            super().write(samples, ticks, events)
            if kinds(self.of(*STALENESS))[-1:] == [Kind.PLC_STALE]:
                assert asked == []

    monkeypatch.setattr(process, "DEVIATING", 3)
    faulty = rigs.recorded("test_rig", 60.0, ("blow_off_delay=20@c6",), 3)[0]
    begin = edges(faulty)[8] + 500
    rest = lost(faulty, begin, 6.0)
    seen = Watch()
    adviser = Asking(rigs.config("test_rig"), "a", lambda: True, lambda: None)  # type: ignore[arg-type, return-value]
    blocks = [*rigs.cut(rest[:begin], 100), *[EMPTY] * 20, *rigs.cut(rest[begin:], 100)]
    now = int(rest["host_ns"][begin - 1]) + S
    run(
        blocks,
        rigs.twin("test_rig"),
        rigs.monitor("test_rig"),
        [seen],
        lambda: now,
        advisers=[adviser],
    )
    assert len(asked) == 1
    assert kinds(seen.of(*STALENESS)) == [Kind.PLC_STALE, Kind.PLC_BACK]
