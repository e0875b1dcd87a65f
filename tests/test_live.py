"""The loop: what comes in goes through twin and monitor to every sink, live and from a log."""

import itertools
import subprocess
import sys
from collections.abc import Iterator, Sequence
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
import rigs
from plc_process import PlcProcess
from rigs import Collect

import twin
from drivers.sources import open_source
from twin.events import Event, Kind
from twin.live import run
from twin.log.header import LogHeader
from twin.log.reader import Log, open_log
from twin.log.recorder import Recorder
from twin.monitor.staleness import Listening
from twin.quality import Quality
from twin.signals import SAMPLE, Command, Phase, Samples, Ticks

EMPTY = np.empty(0, SAMPLE)


class Failing(Collect):
    """A sink that cannot do one thing."""

    def __init__(self, what: str) -> None:
        super().__init__()
        self.what = what

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        super().write(samples, ticks, events)
        if self.what == "write":
            raise OSError("disk full")

    def close(self) -> None:
        super().close()
        if self.what == "close":
            raise OSError("disk full")


def header(name: str) -> LogHeader:
    document = rigs.config(name).document
    return LogHeader("type", "id", "cell.toml", document.text)


def rows_of(seen: Collect) -> tuple[bytes, bytes]:
    return b"".join(part.tobytes() for part in seen.samples), b"".join(
        part.tobytes() for part in seen.ticks
    )


# Sinks.


def test_every_sink_is_given_every_row_and_is_closed() -> None:
    samples, _ = rigs.recorded("gripper", 6.0)
    one, other = Collect(), Collect()
    run(rigs.cut(samples, 30), rigs.twin("gripper"), rigs.monitor("gripper"), [one, other])
    assert rows_of(one)[0] == samples.tobytes()
    assert rows_of(one) == rows_of(other)
    assert one.events == other.events
    assert one.closed == other.closed == 1


def test_the_rows_held_back_are_flushed_at_the_end() -> None:
    samples, _ = rigs.recorded("gripper", 6.0)
    samples = samples[: int(np.flatnonzero(samples["commands"] == Command.SUCTION)[-1])]
    seen = Collect()
    run([samples], rigs.twin("gripper"), rigs.monitor("gripper"), [seen])
    first, last = (len(part) for part in seen.samples)
    assert first + last == len(samples)
    assert 0 < last <= rigs.detector("gripper").lag


def test_no_source_no_rows() -> None:
    seen = rigs.watch("gripper", [])
    assert rows_of(seen) == (b"", b"")
    assert seen.events == []
    assert seen.closed == 1


def test_all_sinks_are_closed_when_the_source_breaks() -> None:
    def source() -> Iterator[Samples]:
        yield rigs.recorded("gripper", 6.0)[0][:500]
        raise OSError("cable")

    sinks = [Collect(), Collect()]
    with pytest.raises(OSError, match="cable"):
        run(source(), rigs.twin("gripper"), rigs.monitor("gripper"), sinks)
    assert [sink.closed for sink in sinks] == [1, 1]
    assert sinks[0].samples


@pytest.mark.parametrize("what", ["write", "close"])
def test_all_sinks_are_closed_when_one_fails(what: str) -> None:
    sinks = [Collect(), Failing(what), Collect()]
    blocks = rigs.cut(rigs.recorded("gripper", 6.0)[0], 100)
    with pytest.raises(OSError, match="disk full"):
        run(blocks, rigs.twin("gripper"), rigs.monitor("gripper"), sinks)
    assert [sink.closed for sink in sinks] == [1, 1, 1]


# Silence.


def test_silence_is_told_while_it_lasts_and_in_a_replay_the_same() -> None:
    samples = rigs.recorded("gripper", 6.0)[0].copy()
    for field in ("time_ns", "host_ns"):
        samples[field][3000:] += 2_000_000_000
    samples["sequence"][3000:] += 2000
    samples["quality"][3000] = Quality.GAP
    asked = itertools.count()
    told: list[int] = []

    def clock() -> int:
        return (next(asked) + 1) // 2 * 100_000_000  # a block every 0.1 s

    class Watch(Collect):
        def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
            super().write(samples, ticks, events)
            told.extend(len(self.samples) for event in events if event.kind is Kind.PLC_STALE)

    live = Watch()
    blocks = [samples[:3000], *[EMPTY] * 20, samples[3000:]]
    run(blocks, rigs.twin("gripper"), rigs.monitor("gripper"), [live], Listening(clock))
    assert told == [1 + 6]  # with the sixth empty block, 0.6 s after the last sample
    replayed = rigs.watch("gripper", rigs.cut(samples, 700))
    assert replayed.events == live.events
    assert rows_of(replayed) == rows_of(live)


def test_silence_before_the_first_sample_is_not_stale() -> None:
    seen, seconds = Collect(), itertools.count()
    listening = Listening(lambda: next(seconds) * 1_000_000_000)
    run([EMPTY] * 5, rigs.twin("gripper"), rigs.monitor("gripper"), [seen], listening)
    assert seen.events == []


# Through a log.


def recorded_run(path: Path, name: str, blocks: Sequence[Samples]) -> Collect:
    seen = Collect()
    sinks = [Recorder(path, header(name)), seen]
    run(blocks, rigs.twin(name), rigs.monitor(name), sinks)
    return seen


def replay(log: Log, name: str, size: int) -> Collect:
    return rigs.watch(name, (samples for samples, _ in log.blocks(size)))


@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_replay_expects_the_same_to_the_bit_and_tells_the_same(tmp_path: Path, name: str) -> None:
    samples = rigs.recorded(name, 25.0, ("sensor_lag=25@c3",), 4)[0].copy()
    samples["quality"][5000:5100] = Quality.BAD
    samples["quality"][9000] = Quality.GAP
    samples["sequence"][9000:] += 50
    samples["time_ns"][9000:] += 50_000_000
    live = recorded_run(tmp_path / "a.mcap", name, rigs.cut(samples, 30))
    assert {Kind.GAP, Kind.SIGNAL_BAD, Kind.CYCLE, Kind.DEVIATION} <= {e.kind for e in live.events}
    log = open_log(tmp_path / "a.mcap")
    stored = list(log.blocks(10**6))
    assert b"".join(rows.tobytes() for _, rows in stored) == rows_of(live)[1]
    assert list(log.events()) == live.events
    for size in (10_000, 777):
        again = replay(log, name, size)
        assert rows_of(again) == rows_of(live)
        assert again.events == live.events


def without_some(samples: Samples, share: float) -> Samples:
    """The same with so many rows missing, here and there, and marked."""
    kept = np.random.default_rng(1).random(len(samples)) >= share
    holes = samples[kept].copy()
    holes["quality"][1:][np.diff(holes["sequence"]) > 1] |= np.uint8(Quality.GAP)
    return holes


@pytest.mark.parametrize("name", rigs.NAMES)
def test_cycles_with_a_twentieth_of_their_rows_missing_are_judged(
    tmp_path: Path, name: str
) -> None:
    whole = rigs.recorded(name, 25.0)[0]
    holes = without_some(whole, 0.05)
    live = recorded_run(tmp_path / "a.mcap", name, rigs.cut(holes, 30))
    assert rows_of(live)[0] == holes.tobytes(), "what is missing stays marked"
    told = live.of(Kind.CYCLE)
    assert len(told) == len(rigs.watch(name, rigs.cut(whole, 30)).of(Kind.CYCLE))
    assert sum("suction_rms" in event.data for event in told) >= len(told) - 1
    assert not live.of(Kind.DEVIATION)
    gaps = live.of(Kind.GAP)
    assert 20 <= len(gaps) <= 26, "one a second"
    assert sum(event.data.get("gaps", 1) for event in gaps) > 0.9 * 0.04 * len(whole)
    assert "the model steps over them" in gaps[-1].text
    again = replay(open_log(tmp_path / "a.mcap"), name, 777)
    assert again.events == live.events
    assert rows_of(again) == rows_of(live)


def test_rows_of_a_log_with_holes_stay_marked_and_its_cycles_have_figures(tmp_path: Path) -> None:
    holes = without_some(rigs.recorded("gripper", 25.0)[0], 0.05)
    live = recorded_run(tmp_path / "a.mcap", "gripper", rigs.cut(holes, 30))
    blocks = [block for block, _ in open_log(tmp_path / "a.mcap").blocks()]
    rows = [samples for samples, _ in rigs.twin("gripper").over(blocks)]
    assert b"".join(part.tobytes() for part in rows) == holes.tobytes()
    told = twin.open(tmp_path / "a.mcap").cycles()
    assert len(told) >= len(live.of(Kind.CYCLE)) - 1
    assert sum("t0_measured" in line for line in told) >= len(told) - 1


def test_a_gap_of_more_rows_breaks_the_cycle() -> None:
    whole = rigs.recorded("gripper", 25.0)[0]
    broken = np.delete(whole, np.arange(9000, 9004))
    broken["quality"][9000] |= np.uint8(Quality.GAP)
    seen = rigs.watch("gripper", rigs.cut(broken, 30))
    assert len(seen.of(Kind.CYCLE)) < len(rigs.watch("gripper", [whole]).of(Kind.CYCLE))
    assert [event.data for event in seen.of(Kind.GAP)] == [{"missing": 4, "seconds": 0.005}]


def test_a_replay_of_a_replay_is_the_same(tmp_path: Path) -> None:
    samples, _ = rigs.recorded("gripper", 6.0)
    recorded_run(tmp_path / "a.mcap", "gripper", rigs.cut(samples, 30))
    log = open_log(tmp_path / "a.mcap")
    recorded_run(tmp_path / "b.mcap", "gripper", [samples for samples, _ in log.blocks()])
    first, second = (
        [rows.tobytes() for pair in open_log(tmp_path / name).blocks() for rows in pair]
        for name in ("a.mcap", "b.mcap")
    )
    assert first == second


# End to end.


@pytest.mark.slow
def test_beside_a_plc_nothing_is_lost_and_the_twin_follows(plc: PlcProcess) -> None:
    """Over Modbus from another process, for two whole cycles."""
    seen = Collect()
    source = open_source(rigs.config("gripper").document, f"127.0.0.1:{plc.port}")
    blocks = takewhile(lambda _: len(seen.of(Kind.CYCLE)) < 2, source)
    try:
        run(blocks, rigs.twin("gripper"), rigs.monitor("gripper"), [seen])
    finally:
        source.close()  # type: ignore[attr-defined]
    samples, ticks = np.concatenate(seen.samples), np.concatenate(seen.ticks)
    lost = np.diff(samples["sequence"]) != 1
    assert not (lost & ((samples["quality"][1:] & Quality.GAP) == 0)).any()
    assert set(ticks["phase"].tolist()) == set(Phase)
    follows = np.abs(samples["pressure"] - ticks["expected"].astype(float))
    in_suction = (samples["commands"] == Command.SUCTION) & np.isfinite(ticks["expected"])
    assert in_suction.sum() > 1000
    assert np.median(follows[in_suction]) < 1500  # Pa


@pytest.mark.slow
@pytest.mark.parametrize("name", rigs.NAMES)
def test_nothing_is_compiled_while_the_loop_runs(name: str) -> None:
    """It would take seconds, in which nothing is read and nobody is told anything."""
    command = [sys.executable, Path(__file__).with_name("compiling.py"), name]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=rigs.ROOT)
    assert told.stdout.strip() == "{}"
