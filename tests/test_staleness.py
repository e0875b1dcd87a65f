"""While the PLC is stale one alarm stands, and no other is raised; the clock here is the test's."""

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
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
from twin.events import Event, Kind, Severity
from twin.live import run
from twin.monitor.monitor import Monitor
from twin.monitor.staleness import Listening
from twin.quality import Quality
from twin.signals import SAMPLE, Command, Samples, Ticks

EMPTY = np.empty(0, SAMPLE)
S, MS = 1_000_000_000, 1_000_000
STALENESS = (Kind.PLC_STALE, Kind.PLC_BACK)


def kinds(events: Sequence[Event]) -> list[Kind]:
    return [event.kind for event in events]


class Timed:
    """A live source in time of its own: a wait of 0.1 s for each block, longer where it is told."""

    def __init__(self, blocks: Sequence[Samples], waits: Mapping[int, int] | None = None) -> None:
        self.ns, self.blocks, self.waits = 0, blocks, waits or {}
        self.listening = Listening(lambda: self.ns)

    def __iter__(self) -> Iterator[Samples]:
        for number, block in enumerate(self.blocks):
            self.ns += self.waits.get(number, 100 * MS)
            yield block


# A PLC that answers, and whose program stands still.


class Beside:
    """The loop beside a PLC of the test's own time, ended when the PLC is back or time is over."""

    def __init__(self, stream: Generator[Samples, None, None], time: PlcTime) -> None:
        self.seen = Collect()
        self.time, self.stream = time, stream

    def run(self, seconds: float) -> list[Event]:
        end = self.time.ns + round(seconds * S)
        blocks = takewhile(lambda _: self.time.ns < end, self.stream)
        monitor = Monitor(rigs.config("test_rig").monitor, rigs.theta("test_rig"))
        with closing(self.stream):
            run(blocks, rigs.twin("test_rig"), monitor, [self.seen], Listening(self.time.now_ns))
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


# A twin that is late itself, and a wall clock that is set.


class Slow(Collect):
    """A sink that takes its time at some blocks, as a view that opens does."""

    def __init__(self, source: Timed, slow: Sequence[int], takes_ns: int) -> None:
        super().__init__()
        self.source, self.slow, self.takes_ns = source, slow, takes_ns

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        super().write(samples, ticks, events)
        if len(self.samples) in self.slow:
            self.source.ns += self.takes_ns


def received_late(samples: Samples, rows: Sequence[int], by_ns: int) -> Samples:
    """Each pause before a row is caught up in the next 100 rows, which all come at once."""
    samples = samples.copy()
    for row in rows:
        late = samples["host_ns"][row - 1] + by_ns
        samples["host_ns"][row:] = np.maximum(samples["host_ns"][row:], late)
    return samples


def beside(blocks: Sequence[Samples], slow: Sequence[int] = (), by_ns: int = 0) -> Collect:
    source = Timed(blocks)
    seen = Slow(source, slow, by_ns)
    run(source, rigs.twin("test_rig"), rigs.monitor("test_rig"), [seen], source.listening)
    return seen


def test_a_twin_that_is_late_says_so_once_and_nothing_is_stale() -> None:
    late = (30, 40, 50)  # blocks after which it does something else for 2 s
    samples = received_late(healthy(), [3000, 4000, 5000], 2 * S)
    seen = beside(rigs.cut(samples, 100), late, 2 * S)
    (told,) = seen.of(Kind.TWIN_LATE, *STALENESS)
    assert told.kind is Kind.TWIN_LATE
    assert told.severity is Severity.WARNING
    assert told.time_ns == samples["time_ns"][2999]  # since then it took none
    assert told.data["seconds"] == pytest.approx(2.1)
    again = rigs.watch("test_rig", seen.samples)  # as a log has them
    assert again.events == [event for event in seen.events if event is not told]


def test_while_a_run_loads_its_model_being_late_is_no_news() -> None:
    samples = received_late(healthy(), [3000], 2 * S)
    source = Timed(rigs.cut(samples, 100))
    source.listening.is_starting = lambda: source.ns < 6 * S
    seen = Slow(source, (30,), 2 * S)
    run(source, rigs.twin("test_rig"), rigs.monitor("test_rig"), [seen], source.listening)
    assert seen.of(Kind.TWIN_LATE, *STALENESS) == []


def test_a_twin_that_was_late_for_longer_than_the_ring_calls_nothing_stale() -> None:
    samples = lost(healthy(), 3000, 6.0)
    seen = beside(rigs.cut(samples, 100), [30], 6 * S)
    assert kinds(seen.of(Kind.TWIN_LATE, Kind.GAP, *STALENESS)) == [Kind.TWIN_LATE, Kind.GAP]
    assert rigs.watch("test_rig", seen.samples).of(Kind.GAP, *STALENESS) == seen.of(Kind.GAP)


def test_being_late_does_not_count_as_listening() -> None:
    blocks = rigs.cut(healthy()[:6000], 100)
    seen = beside([*blocks[:30], EMPTY, *blocks[30:]], [30], 5 * S)
    assert kinds(seen.of(*STALENESS)) == []


@pytest.mark.parametrize("step_s", [-3600, 3600])
@pytest.mark.parametrize("empty", [0, 2])
def test_a_wall_clock_that_is_set_is_no_silence(step_s: int, empty: int) -> None:
    samples = healthy().copy()
    samples["host_ns"][3000:] += step_s * S
    blocks = rigs.cut(samples, 100)
    seen = beside([*blocks[:30], *[EMPTY] * empty, *blocks[30:]])
    assert seen.of(Kind.TWIN_LATE, *STALENESS) == []
    assert rigs.watch("test_rig", seen.samples).of(*STALENESS) == []


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_a_wall_clock_that_is_set_in_a_silence_does_not_lengthen_it(step_s: int) -> None:
    """The rows of the silence are missing; PLC time says how long it was."""
    samples = np.delete(healthy(), np.s_[3000:5000])
    samples["host_ns"][3000:] += step_s * S
    samples["quality"][3000] |= Quality.GAP
    blocks = rigs.cut(samples, 100)
    seen = beside([*blocks[:30], *[EMPTY] * 20, *blocks[30:]])
    stale, back = seen.of(*STALENESS)
    assert kinds([stale, back]) == [Kind.PLC_STALE, Kind.PLC_BACK]
    assert back.data["silence_ms"] == pytest.approx(2001)


def test_a_silence_that_the_ring_fills_is_over_after_it_began() -> None:
    """The connection was away: alarms are stamped with the rows, and the rows were all there."""
    samples = received_late(healthy(), [3000], 2 * S)
    blocks = rigs.cut(samples, 100)
    seen = beside([*blocks[:30], *[EMPTY] * 20, *blocks[30:]])
    stale, back = seen.of(*STALENESS)
    assert kinds([stale, back]) == [Kind.PLC_STALE, Kind.PLC_BACK]
    assert stale.time_ns <= back.time_ns
    assert rigs.watch("test_rig", seen.samples).of(*STALENESS) == [stale, back]


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

    run(blocks(), rigs.twin("test_rig"), rigs.monitor("test_rig"), [live], Listening(lambda: now))
    replayed = rigs.watch("test_rig", rigs.cut(samples, 1000))
    assert kinds(live.of(*STALENESS)) == [Kind.PLC_STALE, Kind.PLC_BACK]
    assert sorted(live.events, key=str) == sorted(replayed.events, key=str)


def test_a_plc_that_goes_between_its_answer_and_its_first_row_is_stale() -> None:
    """The run has its answer over one connection, and its rows over the next."""
    samples = healthy().copy()
    samples["host_ns"][6000:] += 3 * S
    timed = Timed([*[EMPTY] * 20, *rigs.cut(samples[6000:], 100)])
    timed.listening.answer.keep(samples[:1])
    timed.listening.notices.tell(Kind.PLC_LOST, "no answer")
    live = Collect()
    run(timed, rigs.twin("test_rig"), rigs.monitor("test_rig"), [live], timed.listening)
    told = live.of(*STALENESS, Kind.PLC_LOST, Kind.GAP, Kind.TWIN_LATE)
    assert sorted(kinds(told)) == sorted([*STALENESS, Kind.PLC_LOST, Kind.GAP])
    logged = np.concatenate(live.samples)
    assert logged["sequence"][:2].tolist() == [samples["sequence"][0], samples["sequence"][6000]]
    replayed = rigs.watch("test_rig", rigs.cut(logged, 1000))
    assert replayed.of(*STALENESS, Kind.GAP) == live.of(*STALENESS, Kind.GAP)


def test_the_answer_before_the_first_row_is_not_logged_where_rows_come() -> None:
    samples = healthy()
    timed = Timed([EMPTY, *rigs.cut(samples[6000:], 100)])
    timed.listening.answer.keep(samples[:1])
    live = Collect()
    run(timed, rigs.twin("test_rig"), rigs.monitor("test_rig"), [live], timed.listening)
    assert live.of(*STALENESS, Kind.GAP) == []
    assert len(np.concatenate(live.samples)) == len(samples) - 6000


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
    for silent, raises in ((True, 0), (False, 1)):
        seen = Collect()
        source = Timed([*rigs.cut(faulty[:end], 100), *[EMPTY] * (20 * silent)])
        run(source, rigs.twin("test_rig"), rigs.monitor("test_rig"), [seen], source.listening)
        assert len(seen.of(Kind.PLC_STALE)) == silent
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
    source = Timed([*rigs.cut(rest[:begin], 100), *[EMPTY] * 60, *rigs.cut(rest[begin:], 100)])
    run(
        source,
        rigs.twin("test_rig"),
        rigs.monitor("test_rig"),
        [seen],
        source.listening,
        advisers=[adviser],
    )
    assert len(asked) == 1
    assert kinds(seen.of(*STALENESS)) == [Kind.PLC_STALE, Kind.PLC_BACK]


# The order in which things are told.


def restarted(samples: Samples, row: int, seconds: float, back_s: float) -> Samples:
    """The same with a restart: the PLC counts anew, and its time begins ``back_s`` earlier."""
    rest = lost(samples, row, seconds)
    rest["quality"][row] = Quality.GAP | Quality.RESTART | Quality.CLOCK
    rest["sequence"][row:] -= rest["sequence"][row]
    rest["time_ns"][row:] -= round(back_s * S)
    return rest


class Echo:
    """An adviser that says something to each event, at its time."""

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        times = samples["time_ns"]
        assert (np.diff(times) > 0).all()  # one time at once: it may look rows up by it
        return [Event(event.time_ns, Kind.ALARM, str(event.kind)) for event in events]

    def finish(self) -> list[Event]:
        return []

    def close(self) -> None: ...


def with_advice(samples: Samples, size: int) -> list[Event]:
    """What a replay tells of the rig's rows, received 5 ms after they were taken."""
    samples["host_ns"] = samples["host_ns"] + 5 * MS
    seen, blocks = Collect(), rigs.cut(samples, size)
    run(blocks, rigs.twin("test_rig"), rigs.monitor("test_rig"), [seen], advisers=[Echo()])
    return seen.events


@pytest.mark.parametrize("size", [100, 60_000])
def test_a_cycle_that_silence_cuts_is_told_before_the_silence(size: int) -> None:
    begin = edges(healthy(40.0))[6] - 100  # it has come to idle
    told = with_advice(lost(healthy(40.0), begin, 2.0), size)
    times = [event.time_ns for event in told]
    assert times == sorted(times)
    said = [event.kind for event in told if event.kind is not Kind.ALARM]
    stale = said.index(Kind.PLC_STALE)
    assert said[stale - 1 : stale + 3] == [Kind.CYCLE, Kind.PLC_STALE, Kind.PLC_BACK, Kind.GAP]


@pytest.mark.parametrize("size", [100, 60_000])
@pytest.mark.parametrize("back_s", [1.8, 20.0, -100.0])
def test_what_a_restart_cuts_is_told_in_its_own_time(size: int, back_s: float) -> None:
    """The PLC's time steps back once, and so do the events: what went before it, then the rest."""
    begin = edges(healthy(40.0))[6] - 100
    samples = restarted(healthy(40.0), begin, 2.0, back_s)
    told = with_advice(samples, size)
    kinds_told = kinds(told)
    first_after = kinds_told.index(Kind.PLC_BACK)
    for part in (told[:first_after], told[first_after:]):
        times = [event.time_ns for event in part]
        assert times == sorted(times)
    before = [kind for kind in kinds_told[:first_after] if kind is not Kind.ALARM]
    assert before[-3:] == [Kind.CYCLE, Kind.CLOCK, Kind.PLC_STALE]
    assert told[first_after].time_ns == samples["time_ns"][begin]
    answered = [event for event in told if event.kind is Kind.ALARM]
    assert len(answered) == len(told) / 2
    assert all(told.index(event) > kinds_told.index(Kind(event.text)) for event in answered)
