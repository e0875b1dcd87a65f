"""Clocks of known distance behind a way of unknown length: what is told of them, and when not."""

import re
from pathlib import Path

import numpy as np
import pytest
import rigs
from log_rows import HEADER
from mcap.reader import make_reader

from twin.events import Event, Kind
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.monitor.clock import EVERY, WINDOW_NS, ClockWatch, line, slope_pm
from twin.monitor.monitor import Monitor
from twin.monitor.settings import MonitorSettings
from twin.quality import Quality
from twin.signals import SAMPLE, TICK, Samples

S, MS = 1_000_000_000, 1_000_000
START_NS = 1_790_000_000 * S
WAY_MS = 1.0  # the shortest


def stream(
    seconds: float,
    ahead_ms: float = 0.0,
    ppm: float = 0.0,
    seed: int = 1,
    block_ms: int = 30,
    waits_ms: float = 3.0,
) -> Samples:
    """Blocks as they come: the PLC's clock so far ahead, and so much faster; the way has jitter."""
    rng = np.random.default_rng(seed)
    count = round(seconds * 1000)
    samples = np.zeros(count, SAMPLE)
    samples["sequence"] = np.arange(count)
    samples["pressure"] = 1e5
    true_ns = samples["sequence"] * MS
    samples["time_ns"] = START_NS + true_ns + round(ahead_ms * MS)
    newest = np.minimum(np.arange(count) // block_ms * block_ms + block_ms, count) - 1
    way_ms = WAY_MS + rng.exponential(waits_ms, count) + 80 * (rng.random(count) < 0.02)
    # The time here, at which the PLC's clock says time_ns: it lags behind, the more the later.
    here_ns = START_NS + np.round(true_ns * (1 - ppm * 1e-6)).astype(np.int64)
    samples["host_ns"] = (here_ns + (way_ms * MS).astype(np.int64))[newest]
    samples["host_ns"] = np.maximum.accumulate(samples["host_ns"])
    return samples


def told(samples: Samples, size: int = 977) -> list[Event]:
    watch, events = ClockWatch(), []
    breaks = np.flatnonzero(samples["quality"] & (Quality.RESTART | Quality.CLOCK | Quality.GAP))
    for stretch in np.split(samples, breaks):
        for part in rigs.cut(stretch, size):
            events += watch.push(part)
    return events + watch.close()


def of(events: list[Event], kind: Kind) -> list[Event]:
    return [event for event in events if event.kind is kind]


def close_to(event: Event, ahead_ms: float, ppm: float) -> None:
    """Within the shortest way and 0.15 ms of the truth, and within 2 ppm; and it says so."""
    data = event.data
    assert data["offset_ms"] == pytest.approx(ahead_ms - WAY_MS, abs=0.15)
    assert data["offset_pm_ms"] < 1.0
    assert data["drift_ppm"] == pytest.approx(ppm, abs=2.0)


@pytest.mark.parametrize("ahead_ms", [0.0, 12.5, -3456.0, 1.79e12])
@pytest.mark.parametrize("ppm", [0.0, 37.0, -150.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_offset_and_drift_are_found_through_a_way_with_jitter(
    ahead_ms: float, ppm: float, seed: int
) -> None:
    seconds = 130.0
    reports = of(told(stream(seconds, ahead_ms, ppm, seed)), Kind.CLOCK)
    assert len(reports) == 3  # after one minute, after two, and at the end
    # At the time of the last report the clocks have parted by what the drift says.
    close_to(reports[-1], ahead_ms + ppm * 1e-6 * seconds * 1e3, ppm)
    assert (reports[0].time_ns - START_NS - ahead_ms * MS) / S == pytest.approx(60.0, abs=0.2)


def test_how_sure_it_is_holds_the_truth_most_times() -> None:
    hits = 0
    for seed in range(40):
        (report,) = of(told(stream(40.0, 5.0, 20.0, seed)), Kind.CLOCK)
        hits += abs(report.data["drift_ppm"] - 20.0) <= report.data["drift_pm_ppm"]
    assert hits >= 35


@pytest.mark.parametrize("by_ms", [-40.0, -5.0, 5.0, 40.0])
def test_a_clock_that_is_set_by_little_is_told_and_the_estimate_begins_anew(by_ms: float) -> None:
    samples = stream(160.0, 8.0, 10.0)
    samples["time_ns"][80_000:] += round(by_ms * MS)
    events = told(samples)
    (jump,) = of(events, Kind.CLOCK_JUMPED)
    assert jump.data["jump_s"] * 1e3 == pytest.approx(by_ms, abs=0.1)
    at = int(samples["time_ns"][80_000])
    assert 0 < jump.time_ns - at < 0.3 * S
    reports = of(events, Kind.CLOCK)
    close_to(reports[-1], 8.0 + by_ms + 1.6, 10.0)
    before = [report for report in reports if report.time_ns <= jump.time_ns]
    close_to(before[-1], 8.0 + 0.8, 10.0)


@pytest.mark.parametrize("size", [1, 30, 10_000])
def test_what_is_told_does_not_depend_on_blocks(size: int) -> None:
    samples = stream(75.0, 8.0, 10.0)[:: 1 if size > 1 else 5]
    samples["time_ns"][len(samples) // 2 :] += 20 * MS
    samples["quality"][len(samples) // 3] = Quality.GAP
    assert told(samples, size) == told(samples, 977)


def test_a_slow_network_is_no_clock_that_was_set() -> None:
    samples = stream(100.0, 8.0)
    samples["host_ns"][40_000:55_000] += 30 * MS  # 15 s in which nothing is quick
    events = told(samples)
    assert of(events, Kind.CLOCK_JUMPED) == []
    close_to(of(events, Kind.CLOCK)[-1], 8.0, 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_busy_beginning_is_no_clock_that_was_set(seed: int) -> None:
    samples = stream(100.0, 8.0)
    busy_ms = 3.5 + np.random.default_rng(seed).exponential(8.0, 1000)
    samples["host_ns"][:30_000] += np.repeat(busy_ms * MS, 30).astype(np.int64)
    samples["host_ns"] = np.maximum.accumulate(samples["host_ns"])
    events = told(samples)
    assert of(events, Kind.CLOCK_JUMPED) == []
    data = of(events, Kind.CLOCK)[-1].data
    assert data["offset_ms"] == pytest.approx(8.0 - WAY_MS, abs=data["offset_pm_ms"])


def test_a_clock_here_that_is_set_back_is_told_since_no_way_is_that_short() -> None:
    samples = stream(100.0, 8.0)
    samples["host_ns"][50_000:] -= 30 * MS
    (jump,) = of(told(samples), Kind.CLOCK_JUMPED)
    assert jump.data["jump_s"] == pytest.approx(0.030, abs=0.002)
    assert "against each other" in jump.text
    assert (jump.time_ns - int(samples["time_ns"][50_000])) / S < 15.0
    close_to(of(told(samples), Kind.CLOCK)[-1], 38.0, 0.0)


def test_what_the_clocks_had_parted_by_does_not_hide_that_one_was_set() -> None:
    """From where they began neither is 3 ms off."""
    samples = stream(60.0, 8.0, -120.0, waits_ms=0.3)
    samples["host_ns"][24_000:] -= round(5.5 * MS)
    (jump,) = of(told(samples), Kind.CLOCK_JUMPED)
    assert jump.data["jump_s"] == pytest.approx(0.0055, abs=0.001)
    assert (jump.time_ns - int(samples["time_ns"][24_000])) / S < 15.0


def test_a_way_that_stays_longer_is_told_as_what_it_may_be() -> None:
    samples = stream(200.0, 8.0)
    samples["host_ns"][60_000:] += 30 * MS
    (jump,) = of(told(samples), Kind.CLOCK_JUMPED)
    assert "or the samples' way is longer" in jump.text
    close_to(of(told(samples), Kind.CLOCK)[-1], -22.0, 0.0)


def test_a_time_stamp_that_is_late_once_is_no_clock_that_was_set() -> None:
    samples = stream(30.0)
    for row in range(3000, 27_000, 3000):  # one block's header took its time from 5 ms later
        block = slice(row // 30 * 30, row // 30 * 30 + 30)
        samples["time_ns"][block] += 5 * MS
    assert of(told(samples), Kind.CLOCK_JUMPED) == []


@pytest.mark.parametrize("flag", [Quality.RESTART, Quality.CLOCK])
def test_after_a_restart_and_a_jump_it_begins_anew(flag: Quality) -> None:
    samples = stream(120.0, 8.0)
    samples["quality"][60_500] = flag
    samples["time_ns"][60_500:] += 3600 * S
    if flag is Quality.RESTART:
        samples["sequence"][60_500:] -= 60_500
    reports = of(told(samples), Kind.CLOCK)
    close_to(reports[-2], 8.0, 0.0)
    close_to(reports[-1], 3.6e6 + 8.0, 0.0)


def test_a_gap_does_not_begin_anew() -> None:
    samples = stream(100.0, 8.0, 25.0)
    rest = np.delete(samples, np.s_[30_000:50_000])
    rest["quality"][30_000] = Quality.GAP
    events = told(rest)
    assert of(events, Kind.CLOCK_JUMPED) == []
    close_to(events[-1], 8.0 + 2.5, 25.0)


def test_little_is_no_report() -> None:
    assert told(stream(9.0)) == []
    assert told(stream(0.05)) == []
    assert ClockWatch().close() == []


def test_what_was_received_at_plc_time_has_one_clock_only() -> None:
    samples = stream(100.0)
    samples["host_ns"] = samples["time_ns"]
    assert told(samples) == []


def test_the_line_is_scipys() -> None:
    from scipy.stats import theilslopes

    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(0, 100, 30))
    y = 0.3 * x + rng.standard_normal(30)
    y[7] += 500
    slope, at_end = line(x, y)
    theirs = theilslopes(y, x)
    assert slope == pytest.approx(theirs.slope)
    assert 2 * slope_pm(x, y) == pytest.approx(theirs.high_slope - theirs.low_slope)
    assert at_end == pytest.approx(30.0, abs=1.0)


def test_transport_is_no_offset_of_the_clocks() -> None:
    """Clocks that agree: what is read is the transport alone, and it is said to be in it."""
    report = of(told(stream(75.0)), Kind.CLOCK)[-1]
    assert report.text.startswith("PLC clock offset −1.0")
    assert "transport included" in report.text
    assert "clock is" not in report.text


def monitored(samples: Samples, size: int = 500) -> list[Event]:
    monitor = Monitor(MonitorSettings(), rigs.theta("test_rig"))
    events = []
    for part in rigs.cut(samples, size):
        ticks = np.zeros(len(part), TICK)
        ticks["expected"] = ticks["level"] = np.nan
        events += monitor.update(part, ticks)
    return events + monitor.close()


def test_the_monitor_says_it_and_in_a_replay_the_same() -> None:
    samples = stream(70.0, 8.0)
    events = monitored(samples)
    assert [event.kind for event in events] == [Kind.CLOCK, Kind.CLOCK]
    assert re.fullmatch(
        r"PLC clock offset \+6\.\d\d ms ± \d\.\d\d ms, transport included;"
        r" drift [+−]\S+ ± \S+ ppm",
        events[0].text,
    )
    assert monitored(samples, 10_000) == events


def test_the_log_says_it_at_its_end(tmp_path: Path) -> None:
    samples = stream(EVERY * WINDOW_NS / S + 3, 8.0)
    events = monitored(samples)
    ticks = np.zeros(len(samples), TICK)
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(samples, ticks, events)
    with (tmp_path / "a.mcap").open("rb") as file:
        stored = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
    assert float(stored["clock"]["offset_ms"]) == events[-1].data["offset_ms"]
    assert float(stored["clock"]["drift_pm_ppm"]) == events[-1].data["drift_pm_ppm"]
    log = open_log(tmp_path / "a.mcap")
    assert log.complete
    assert log.header == HEADER
    assert list(log.events()) == events
