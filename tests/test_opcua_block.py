"""The trace's arrays, followed without losing or inventing a scan, however a server reads them."""

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

import numpy as np
import pytest
import rigs
from asyncua import ua
from hypothesis import given, settings
from hypothesis import strategies as st
from modbus_server import PlcTime

from drivers.opcua.settings import Node, OpcuaSettings
from drivers.opcua.trace import NodeTrace
from drivers.reconnect import AbsentError, Away, Clock, LostError, reconnecting
from twin.errors import SourceError
from twin.events import Event, Kind
from twin.monitor.clock import ClockWatch
from twin.quality import Quality
from twin.signals import SAMPLE, Samples

T = ua.VariantType
DEPTH = 1024
TAGS = {
    "pressure": {"node": "s=P", "unit": "mbar", "reference": "absolute", "range": [0, 1300]},
    "supply": {"node": "s=Supply", "unit": "mbar", "reference": "gauge"},
}


def settings_for(**changes: Any) -> OpcuaSettings:
    table = {"url": "opc.tcp://plc:4840", "namespace": "urn:plc", "tags": TAGS}
    return OpcuaSettings.model_validate(table | changes)


NODES = [f"Trace.{name}" for name in ("Sequence", "Time", "Boot", "Period")]
NODES += ["Trace.Sequences", "Trace.Statuses", "Trace.Pressures", "Supply"]


class TornServer:
    """A PLC and its server, which reads each node at a time of its own while it answers.

    ``order`` says in which order (by NODES), ``pauses`` how many scans go by after each. The server
    sees the PLC's memory as an image that is renewed every ``image`` scans.
    """

    def __init__(self, depth: int = DEPTH, sequence: int = 10) -> None:
        self.depth = depth
        self.sequence = sequence
        self.time_ns = 1_000_000_000_000
        self.boot = 7
        self.codes: dict[str, int] = {}
        self.replaced: dict[str, ua.Variant] = {}
        self.order: list[int] = []
        self.pauses: list[int] = []
        self.image, self.unseen = 1, 0
        self.clock: PlcTime | None = None
        self.sequences = np.zeros(depth, np.int64)
        self.pressures = np.zeros(depth)
        self.open_count = self.close_count = self.broken = self.absent = 0
        self.sequence -= min(sequence, depth)
        self.record(self.sequence)
        self.scan(min(sequence, depth))

    def pressure(self, sequence: int) -> float:
        return 200.0 + sequence % 997  # never the same at the same place of the ring

    def scan(self, scans: int) -> None:
        self.unseen += scans
        seen = self.unseen - self.unseen % self.image
        self.unseen -= seen
        self.show(seen)

    def show(self, scans: int) -> None:
        self.sequence += scans
        self.time_ns += scans * 1_000_000
        for sequence in range(self.sequence - min(scans, self.depth) + 1, self.sequence + 1):
            self.record(sequence)

    def record(self, sequence: int) -> None:
        slot = sequence % (1 << 32) % self.depth
        self.sequences[slot] = sequence % (1 << 32)
        self.pressures[slot] = self.pressure(sequence)

    def restart(self, sequence: int = 0) -> None:
        self.boot += 1
        self.sequence, self.time_ns = sequence, self.time_ns + 3_000_000_000
        self.sequences[:], self.pressures[:] = 0, 0
        self.record(sequence)

    def value(self, node: Node) -> ua.DataValue:
        name = node.identifier.removeprefix("s=")
        sequence = self.sequence % (1 << 32)
        variant = (
            self.replaced.get(name)
            or {
                "Trace.Sequence": lambda: ua.Variant(sequence, T.UInt32),
                "Trace.Time": lambda: ua.Variant(self.time_ns, T.UInt64),
                "Trace.Boot": lambda: ua.Variant(self.boot, T.UInt16),
                "Trace.Period": lambda: ua.Variant(1000, T.UInt16),
                "Trace.Sequences": lambda: ua.Variant(
                    self.sequences.tolist(), T.UInt32, None, True
                ),
                "Trace.Statuses": lambda: ua.Variant([0x101] * self.depth, T.UInt16, None, True),
                "Trace.Pressures": lambda: ua.Variant(self.pressures.tolist(), T.Float, None, True),
                "Supply": lambda: ua.Variant(5000, T.Int16),
            }[name]()
        )
        return ua.DataValue(variant, ua.StatusCode(self.codes.get(name, 0)))

    # As a link:

    def open(self) -> None:
        self.open_count += 1

    def close(self) -> None:
        self.close_count += 1

    def read(self, nodes: tuple[Node, ...]) -> list[ua.DataValue]:
        if self.broken:
            self.broken -= 1
            raise LostError("lost")
        if self.absent:
            self.absent -= 1
            raise AbsentError("there is no node")
        assert self.clock is not None
        values: dict[Node, ua.DataValue] = {}
        asked = {node.identifier.removeprefix("s="): node for node in nodes}
        for number, place in enumerate(self.order or range(len(NODES))):
            if (node := asked.get(NODES[place])) is not None:
                values[node] = self.value(node)
                if self.pauses and self.pauses[number]:
                    self.clock.sleep(self.pauses[number] * 1e-3)
        return [values[node] for node in nodes]


class Rig:
    def __init__(self, server: TornServer, away: Away | None = None, **changes: Any) -> None:
        self.server = server
        self.time = server.clock = PlcTime(server.scan)
        clock = Clock(self.time.wall_ns, self.time.now_ns, self.time.sleep)
        trace = NodeTrace(settings_for(**changes), clock)
        self.stream: Iterator[Samples] = reconnecting(trace, server, clock, away)  # type: ignore[type-var]

    def take(self, count: int) -> Samples:
        return np.concatenate([np.empty(0, SAMPLE), *islice(self.stream, count)])


@pytest.fixture
def rig() -> Rig:
    return Rig(TornServer())


def flags(samples: Samples, quality: int) -> list[int]:
    return [int(row) for row in np.flatnonzero(samples["quality"] & quality)]


def assert_true(rig: Rig, samples: Samples) -> None:
    """Every row has the pressure of its own scan."""
    assert samples["pressure"] == pytest.approx(
        [rig.server.pressure(int(s)) * 100 for s in samples["sequence"]]
    )


def test_every_scan_comes_once_with_its_values_and_times(rig: Rig) -> None:
    samples = rig.take(20)
    assert len(samples) > 900
    assert (np.diff(samples["sequence"]) == 1).all()
    assert (np.diff(samples["time_ns"]) == 1_000_000).all()
    assert_true(rig, samples)
    assert set(samples["quality"]) == {Quality.OVERFLOW}  # bit 8 of every status here
    assert set(samples["commands"]) == {1}
    assert samples["supply"] == pytest.approx(5e5)


@settings(max_examples=80, deadline=None)
@given(
    order=st.permutations(range(8)),
    pauses=st.lists(st.integers(0, 25), min_size=8, max_size=8),
    stalls=st.lists(st.integers(0, 400), min_size=3, max_size=6),
)
def test_in_whatever_order_nodes_are_read_no_wrong_value_is_taken(
    order: list[int], pauses: list[int], stalls: list[int]
) -> None:
    rig = Rig(TornServer())
    parts = [rig.take(2)]
    rig.server.order, rig.server.pauses = order, pauses
    for stall in stalls:
        rig.time.sleep(stall * 1e-3)
        parts.append(rig.take(3))
    rig.server.pauses = []
    samples = np.concatenate([*parts, rig.take(2)])
    assert_true(rig, samples)
    assert (np.diff(samples["sequence"]) == 1).all()  # the ring is deeper than any of the stalls
    assert not flags(samples, Quality.GAP | Quality.CLOCK | Quality.RESTART)
    assert (np.diff(samples["time_ns"]) > 0).all()


@settings(max_examples=80, deadline=None)
@given(
    order=st.permutations(range(8)),
    pauses=st.lists(st.integers(0, 4), min_size=8, max_size=8),
    image=st.integers(2, 40),
)
def test_scans_that_the_server_sees_in_bursts_are_not_torn(
    order: list[int], pauses: list[int], image: int
) -> None:
    rig = Rig(TornServer())
    rig.take(2)
    rig.server.order, rig.server.pauses, rig.server.image = order, pauses, image
    samples = rig.take(12)
    assert len(samples) > 300
    assert_true(rig, samples)
    assert (np.diff(samples["sequence"]) == 1).all()
    assert not flags(samples, Quality.GAP | Quality.RESTART)


def test_a_record_that_is_just_being_overwritten_is_not_believed(rig: Rig) -> None:
    rig.take(3)
    server = rig.server

    def begin_the_next(scans: int) -> None:
        TornServer.show(server, scans)
        slot = (server.sequence + 1) % DEPTH
        server.pressures[slot] = server.pressure(server.sequence + 1)  # its sequence comes last

    server.show = begin_the_next  # type: ignore[method-assign]
    rig.time.sleep(0.95)
    server.order, server.pauses = list(range(8)), [0, 0, 0, 0, 0, 100, 0, 0]
    rig.time.ns += 999_500 - rig.time.ns % 1_000_000  # the next scan is due as we ask
    assert_true(rig, rig.take(1))


@settings(max_examples=40, deadline=None)
@given(
    order=st.permutations(range(8)),
    pauses=st.lists(st.integers(0, 150), min_size=8, max_size=8),
)
def test_a_server_too_slow_for_the_ring_loses_some_and_says_so(
    order: list[int], pauses: list[int]
) -> None:
    rig = Rig(TornServer())
    parts = [rig.take(2)]
    rig.server.order, rig.server.pauses = order, pauses
    samples = np.concatenate([*parts, rig.take(6)])
    assert_true(rig, samples)
    missing = np.diff(samples["sequence"]) != 1
    assert (np.flatnonzero(missing) + 1).tolist() == flags(samples, Quality.GAP)


def test_away_for_longer_than_the_ring_is_a_gap(rig: Rig) -> None:
    rig.take(3)
    rig.time.sleep(2.0)
    samples = rig.take(2)
    assert flags(samples, Quality.GAP) == [0]
    assert_true(rig, samples)


def test_a_restart_is_flagged_and_goes_on_from_zero(rig: Rig) -> None:
    rig.take(3)
    rig.server.restart()
    samples = rig.take(3)
    assert flags(samples, Quality.RESTART) == [0]
    assert (np.diff(samples["sequence"]) == 1).all()
    assert_true(rig, samples)


@pytest.mark.parametrize("jump_ms", [-10_000, 3_600_000])
def test_a_jump_of_the_plcs_clock_is_flagged_and_followed(rig: Rig, jump_ms: int) -> None:
    before = rig.take(3)
    rig.server.time_ns += jump_ms * 1_000_000
    after = rig.take(2)
    assert flags(after, Quality.CLOCK) == [0]
    elapsed = int(after["time_ns"][0] - before["time_ns"][-1])
    assert elapsed == pytest.approx(jump_ms * 1_000_000, abs=5_000_000)


def test_a_small_correction_of_the_plcs_clock_is_followed(rig: Rig) -> None:
    rig.take(3)
    rig.server.time_ns += 20_000_000
    samples = rig.take(30)
    newest = rig.server.time_ns - (rig.server.sequence - samples["sequence"][-1]) * 1_000_000
    assert samples["time_ns"][-1] == pytest.approx(newest, abs=2_000_000)
    assert not flags(samples, Quality.CLOCK)


SEQUENCE_FIRST, TIME_FIRST = [0, 1, 2, 3, 4, 5, 6, 7], [1, 0, 2, 3, 4, 5, 6, 7]
TORN = [20, 0, 0, 0, 0, 0, 0, 0]  # so many scans lie between sequence and time


def assert_even(rig: Rig, samples: Samples) -> None:
    """Time runs on without a step but where a jump is flagged, and is right at the end."""
    steps = np.delete(np.diff(samples["time_ns"]), np.array(flags(samples, Quality.CLOCK), int) - 1)
    assert (steps >= 500_000).all()
    assert (steps <= 1_500_000).all()
    newest = rig.server.time_ns - (rig.server.sequence - samples["sequence"][-1]) * 1_000_000
    assert samples["time_ns"][-1] == pytest.approx(newest, abs=1_000_000)


@pytest.mark.parametrize("order", [SEQUENCE_FIRST, TIME_FIRST])
def test_time_that_is_torn_from_its_sequence_at_the_start_is_put_right_without_a_step(
    order: list[int],
) -> None:
    rig = Rig(TornServer(sequence=3000))
    rig.server.order, rig.server.pauses = order, TORN
    first = rig.take(2)
    rig.server.pauses = []
    samples = np.concatenate([first, rig.take(60)])
    assert not flags(samples, Quality.CLOCK)
    assert_even(rig, samples)


@pytest.mark.parametrize("order", [SEQUENCE_FIRST, TIME_FIRST])
@pytest.mark.parametrize("jump_ms", [-10_000, 3_600_000])
def test_a_clock_that_is_set_while_the_server_is_slow_is_flagged_once(
    rig: Rig, order: list[int], jump_ms: int
) -> None:
    before = rig.take(3)
    rig.server.time_ns += jump_ms * 1_000_000
    rig.server.order, rig.server.pauses = order, TORN
    then = rig.take(2)
    rig.server.pauses = []
    samples = np.concatenate([before, then, rig.take(60)])
    assert flags(samples, Quality.CLOCK) == [len(before)]
    assert_even(rig, samples)


def told_of_clocks(samples: Samples) -> list[Event]:
    watch = ClockWatch()
    return [event for block in rigs.cut(samples, 50) for event in watch.push(block)]


def test_a_clock_that_is_set_ahead_by_little_is_told_once(rig: Rig) -> None:
    before = rig.take(400)
    rig.server.time_ns += 20_000_000
    events = told_of_clocks(np.concatenate([before, rig.take(20)]))
    estimate, jump = events
    assert estimate.kind is Kind.CLOCK
    assert estimate.data["drift_ppm"] == pytest.approx(-20.0, abs=2.0)  # as PlcTime runs here
    assert jump.kind is Kind.CLOCK_JUMPED
    assert jump.data["jump_s"] * 1e3 == pytest.approx(20.0, abs=1.0)


def test_time_that_is_put_right_is_no_clock_that_was_set() -> None:
    rig = Rig(TornServer(sequence=3000))
    rig.server.pauses = TORN
    first = rig.take(2)
    rig.server.pauses = []
    assert told_of_clocks(np.concatenate([first, rig.take(100)])) == []


@settings(max_examples=20, deadline=None)
@given(
    order=st.permutations(range(8)),
    pauses=st.lists(st.integers(0, 8), min_size=8, max_size=8),
    jump_ms=st.sampled_from([0, -10_000, 3_600_000]),
)
def test_time_steps_only_where_the_clock_was_set(
    order: list[int], pauses: list[int], jump_ms: int
) -> None:
    rig = Rig(TornServer(sequence=3000))
    rig.server.order, rig.server.pauses = order, pauses
    parts = [rig.take(4)]
    rig.server.time_ns += jump_ms * 1_000_000
    parts.append(rig.take(4))
    rig.server.pauses = []
    samples = np.concatenate([*parts, rig.take(140)])
    assert len(flags(samples, Quality.CLOCK)) == (jump_ms != 0)
    assert (np.diff(samples["sequence"]) == 1).all()
    assert_even(rig, samples)


@pytest.mark.parametrize("depth", [DEPTH, 900])
def test_the_sequence_goes_on_beyond_32_bits(depth: int) -> None:
    rig = Rig(TornServer(depth, (1 << 32) - 1100))
    rig.server.scan(900)
    samples = rig.take(10)
    assert samples["sequence"][0] < 1 << 32 < samples["sequence"][-1]
    assert (np.diff(samples["sequence"]) == 1).all()


def test_records_that_come_after_their_sequence_is_announced_are_not_believed(rig: Rig) -> None:
    rig.take(3)
    rig.server.record = lambda sequence: None  # type: ignore[method-assign]
    assert len(rig.take(4)) <= 1  # of before


def test_bad_values_are_kept_and_marked(rig: Rig) -> None:
    rig.take(3)
    rig.server.codes["Trace.Pressures"] = ua.StatusCodes.UncertainLastUsableValue
    assert set(rig.take(1)["quality"]) == {Quality.OVERFLOW | Quality.STALE}
    rig.server.codes["Trace.Pressures"] = ua.StatusCodes.BadSensorFailure
    rig.server.replaced["Trace.Pressures"] = ua.Variant(None, T.Null)
    rig.server.codes["Supply"] = ua.StatusCodes.BadNoCommunication
    samples = rig.take(1)
    assert len(samples)
    assert set(samples["quality"]) == {Quality.OVERFLOW | Quality.BAD}
    assert np.isnan(samples["pressure"]).all()
    assert np.isnan(samples["supply"]).all()


def test_a_lost_connection_comes_back_and_the_ring_fills_the_gap(rig: Rig) -> None:
    first = rig.take(3)
    rig.server.broken = 1
    samples = np.concatenate([first, rig.take(6)])
    assert rig.server.open_count == 2
    assert rig.server.close_count == 1
    assert (np.diff(samples["sequence"]) == 1).all()


def test_what_is_not_there_at_the_start_is_waited_for_and_each_reason_is_told_once() -> None:
    server, reasons = TornServer(), list[SourceError]()
    server.broken, server.absent = 3, 4
    samples = Rig(server, reasons.append).take(80)
    assert [str(reason) for reason in reasons] == ["lost", "there is no node"]
    assert server.open_count == 1 + 3 + 4
    assert len(samples)
    assert not samples["quality"][0] & (Quality.GAP | Quality.RESTART)


@pytest.mark.parametrize("why", ["broken", "absent"])
def test_what_is_not_there_at_the_start_comes_out_where_nobody_waits(why: str) -> None:
    server = TornServer()
    setattr(server, why, 1)
    with pytest.raises(SourceError):
        Rig(server).take(1)
    assert server.close_count


def test_a_program_that_stands_still_gives_empty_blocks(rig: Rig) -> None:
    rig.take(3)
    rig.server.codes["Trace.Sequence"] = ua.StatusCodes.BadOutOfService
    assert not len(rig.take(8))
    rig.server.codes.clear()
    assert len(rig.take(8))


def wrong(server: TornServer, name: str, variant: ua.Variant) -> None:
    server.replaced[name] = variant


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda server: wrong(server, "Trace.Boot", ua.Variant("x", T.String)),
            "s=Trace.Boot holds String; expected is a whole number",
        ),
        (
            lambda server: wrong(server, "Trace.Pressures", ua.Variant(1.0, T.Float)),
            "s=Trace.Pressures holds Float; expected is an array of numbers",
        ),
        (
            lambda server: wrong(server, "Trace.Statuses", ua.Variant([1], T.UInt16, None, True)),
            "arrays have 1024, 1 and 1024 elements",
        ),
        (lambda server: wrong(server, "Trace.Period", ua.Variant(0, T.UInt16)), "no trace at"),
        (lambda server: server.sequences.fill(3), "does not hold the sequence numbers"),
    ],
)
def test_a_trace_that_is_none_is_told_at_once(
    change: Callable[[TornServer], None], message: str
) -> None:
    rig = Rig(TornServer(sequence=5000))
    rig.server.scan(DEPTH)
    change(rig.server)
    with pytest.raises(SourceError, match=message) as caught:
        rig.take(1)
    assert caught.value.hint
