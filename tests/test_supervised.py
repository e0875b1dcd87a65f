"""An output of a run that fails does not end it: what it missed comes later, or is told as lost."""

import errno
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_rows import HEADER, START_NS, course, rows_of

from twin.alarms.loop import Alarms
from twin.alarms.settings import board_rules
from twin.alarms.watch import evidence, values
from twin.errors import SourceError
from twin.events import Event, Kind
from twin.log.reader import open_log
from twin.log.recorder import ROOM, Recorder
from twin.monitor.staleness import Notices
from twin.quality import Quality
from twin.signals import Samples, Ticks
from twin.supervised import KEPT_ROWS, Outages, SupervisedEnricher, SupervisedSink


class Clock:
    """Time as the test wants it."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class Fragile:
    """A sink that takes nothing while it is ``broken``."""

    def __init__(self) -> None:
        self.broken, self.tries = False, 0
        self.rows: list[bytes] = []
        self.closed = False

    def write(self, samples: Samples, _ticks: Ticks, _events: Sequence[Event]) -> None:
        self.tries += 1
        if self.broken:
            raise SourceError("the disk is full", "make space")
        self.rows.append(samples.tobytes())

    def close(self) -> None:
        self.closed = True


class Run:
    """A supervised sink with what is told of it."""

    def __init__(self) -> None:
        self.clock, self.notices, self.inner = Clock(), Notices(), Fragile()
        outages = Outages(self.notices)
        self.sink = SupervisedSink("log", self.inner, lambda: self.inner, outages, self.clock)

    def write(self, samples: Samples, ticks: Ticks, block: int = 100) -> None:
        for start in range(0, len(samples), block):
            self.clock.now += block * 1e-3
            self.sink.write(samples[start : start + block], ticks[start : start + block], [])

    def told(self) -> list[Event]:
        return self.notices.taken(START_NS)


def test_what_came_while_it_was_broken_comes_later_and_both_are_told_once() -> None:
    run, (samples, ticks) = Run(), course(20_000)
    run.write(samples[:1000], ticks[:1000])
    run.inner.broken = True
    run.write(samples[1000:9000], ticks[1000:9000])
    (down,) = run.told()
    assert down.kind is Kind.OUTPUT_DOWN
    assert "log: the disk is full" in down.text
    run.inner.broken = False
    run.write(samples[9000:], ticks[9000:])
    (back,) = run.told()
    assert (back.kind, back.data["rows_lost"], back.data["standing"]) == (Kind.OUTPUT_BACK, 0, [])
    assert b"".join(run.inner.rows) == samples.tobytes()
    run.sink.close()
    assert run.inner.closed


def test_pauses_double_up_to_a_minute() -> None:
    run, (samples, ticks) = Run(), course(100)
    run.inner.broken = True
    for _ in range(600):  # a minute
        run.write(samples, ticks)
    assert run.inner.tries == 1 + 5  # after 1, 2, 4, 8 and 16 s
    for _ in range(6000):
        run.write(samples, ticks)
    assert run.inner.tries == 6 + 10  # after 32 s, and then each minute


def test_what_does_not_fit_into_memory_is_told_as_lost() -> None:
    run, (samples, ticks) = Run(), course(KEPT_ROWS + 20_000)
    run.inner.broken = True
    run.write(samples, ticks)
    run.inner.broken = False
    run.clock.now += 100.0
    run.write(samples[:100], ticks[:100])
    *_, back = run.told()
    kept = sum(map(len, run.inner.rows)) // samples.itemsize
    assert kept <= KEPT_ROWS
    assert back.data["rows_lost"] + kept == len(samples) + 100
    assert f"{back.data['rows_lost']} rows are missing" in back.text


def test_rows_after_lost_ones_are_marked_also_where_none_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("twin.supervised.KEPT_ROWS", 50)
    run, (samples, ticks) = Run(), course(200)
    run.inner.broken = True
    run.sink.write(samples[:100], ticks[:100], [])
    run.sink.write(samples[:0], ticks[:0], [Event(0, Kind.CYCLE, "a cycle")])
    run.inner.broken, run.clock.now = False, 2.0
    run.sink.write(samples[100:140], ticks[100:140], [])
    rows = np.frombuffer(b"".join(run.inner.rows), samples.dtype)
    assert np.flatnonzero(rows["quality"] & Quality.GAP).tolist() == [0]
    assert rows["sequence"].tolist() == samples["sequence"][100:140].tolist()


def test_an_output_of_events_alone_keeps_no_rows_and_counts_events(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("twin.supervised.KEPT_BLOCKS", 5)
    monkeypatch.setattr("twin.supervised.KEPT_EVENTS", 3)
    clock, notices, seen = Clock(), Notices(), list[str]()

    class Console(Fragile):
        def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
            super().write(samples, ticks, events)
            seen.extend(event.text for event in events)

    inner = Console()
    sink = SupervisedSink("console", inner, lambda: inner, Outages(notices), clock, rows=False)
    samples, ticks = course(100)
    inner.broken = True
    for number in range(12):
        sink.write(samples, ticks, [Event(0, Kind.CYCLE, str(number))])
    inner.broken, clock.now = False, 5.0
    sink.write(samples, ticks, [])
    assert set(inner.rows) == {b""}
    assert seen == [str(number) for number in range(5, 12)]
    back = notices.taken(0)[-1]
    assert (back.data["rows_lost"], back.data["events_lost"]) == (0, 5)
    assert back.text.endswith("; 5 events are missing in it")


def test_a_sink_that_is_down_at_the_end_says_so() -> None:
    run, (samples, ticks) = Run(), course(500)
    run.inner.broken = True
    run.write(samples, ticks)
    with pytest.raises(SourceError, match="log: the disk is full; 500 rows are missing") as caught:
        run.sink.close()
    assert caught.value.hint == "make space"


def test_an_alarm_stands_while_any_output_is_down() -> None:
    outages = Outages(notices := Notices())
    for name in ("log", "console"):
        outages.begin(name, OSError("no"), 0.0)
    outages.end("log", 5.0)
    outages.end("console", 6.0)
    told = notices.taken(0)
    assert [values(event) for event in told] == [{"output_down": up} for up in (1.0, 1.0, 1.0, 0.0)]
    assert evidence(told[0]) == {"output_down": {"words": told[0].text}}


class Advises:
    """An adviser that fails while it is ``broken``, and at events that say ``poison``."""

    def __init__(self) -> None:
        self.broken, self.closed, self.tries = False, False, 0
        self.heard: list[str] = []
        self.rows: list[Samples] = []

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        self.tries += 1
        if self.broken or any(event.text == "poison" for event in events):
            raise ZeroDivisionError("a mistake")
        self.rows.append(samples)
        self.heard += [event.text for event in events]
        return [Event(0, Kind.DIAGNOSIS, f"heard {event.text}") for event in events]

    def finish(self) -> list[Event]:
        if self.broken:
            raise ZeroDivisionError("a mistake at the end")
        return [Event(0, Kind.DIAGNOSIS, "the end")]

    def close(self) -> None:
        self.closed = True


class Advised:
    """A supervised adviser that is given a block each 0.1 s, with what is told of it."""

    def __init__(self) -> None:
        self.clock, self.notices, self.inner = Clock(), Notices(), Advises()
        self.adviser = SupervisedEnricher(
            "diagnosis", self.inner, Outages(self.notices), self.clock
        )
        self.samples, _ = course(100)

    def follow(self, *texts: str) -> list[str]:
        self.clock.now += 0.1
        events = [Event(0, Kind.CYCLE, text) for text in texts]
        return [event.text for event in self.adviser.follow(self.samples, events)]

    def told(self) -> list[tuple[Kind, int, int]]:
        return [
            (event.kind, event.data.get("rows_lost", 0), event.data.get("events_lost", 0))
            for event in self.notices.taken(0)
        ]


def test_an_adviser_that_fails_hears_later_what_it_missed() -> None:
    run = Advised()
    assert run.follow("a") == ["heard a"]
    run.inner.broken = True
    assert [run.follow(text) for text in "bcd"] == [[], [], []]
    assert run.told() == [(Kind.OUTPUT_DOWN, 0, 0)]
    run.inner.broken, run.clock.now = False, 10.0
    assert run.follow("e") == [f"heard {text}" for text in "bcde"]
    assert run.follow("f") == ["heard f"]
    assert run.told() == [(Kind.OUTPUT_BACK, 0, 0)]
    assert sum(map(len, run.inner.rows)) == 600
    assert [event.text for event in run.adviser.finish()] == ["the end"]
    run.adviser.close()
    assert run.inner.closed


def test_an_adviser_that_is_down_is_tried_with_pauses_that_double() -> None:
    run = Advised()
    run.inner.broken = True
    tries = []
    for _ in range(800):
        before = run.inner.tries
        run.follow()
        if run.inner.tries > before:
            tries.append(round(run.clock.now))
    assert tries == [0, 1, 3, 7, 15, 31, 63]


def test_what_an_adviser_fails_at_again_is_left_out_and_counted() -> None:
    run = Advised()
    assert run.follow("a", "poison") == []
    assert run.follow("b") == []
    run.clock.now = 5.0
    assert run.follow("c") == ["heard b", "heard c"]
    assert run.told() == [(Kind.OUTPUT_DOWN, 0, 0), (Kind.OUTPUT_BACK, 100, 2)]


def test_an_adviser_that_fails_at_each_cycle_is_told_of_more_and_more_seldom() -> None:
    run = Advised()
    for number in range(3000):  # five minutes
        run.follow(*["poison"] * (number % 10 == 0))
    told = run.told()
    assert len(told) <= 2 * 10
    assert told[-1][0] in (Kind.OUTPUT_DOWN, Kind.OUTPUT_BACK)
    run.clock.now += 70.0  # it takes what waits
    run.follow()
    for _ in range(700):  # and works for more than a minute
        run.follow()
    run.told()
    run.follow("poison")
    for _ in range(12):  # then the first pause is a second again
        run.follow()
    assert [kind for kind, *_ in run.told()] == [Kind.OUTPUT_DOWN, Kind.OUTPUT_BACK]


def test_an_adviser_that_is_down_for_long_loses_rows_and_no_events() -> None:
    run = Advised()
    run.inner.broken = True
    for number in range(KEPT_ROWS // 100 + 50):
        run.follow(f"{number}")
    run.inner.broken, run.clock.now = False, 1000.0
    run.follow("last")
    assert run.inner.heard == [*map(str, range(KEPT_ROWS // 100 + 50)), "last"]
    assert sum(map(len, run.inner.rows)) == KEPT_ROWS
    assert run.told()[-1] == (Kind.OUTPUT_BACK, 5100, 0)
    first = next(rows for rows in run.inner.rows if len(rows))
    assert first["quality"][0] & Quality.GAP


def test_an_adviser_that_is_down_at_the_end_says_so() -> None:
    run = Advised()
    run.inner.broken = True
    run.follow("a")
    assert run.adviser.finish() == []
    with pytest.raises(SourceError, match="a mistake; 100 rows and 1 events are missing in it"):
        run.adviser.close()
    assert run.inner.closed


def test_an_adviser_that_fails_at_its_last_words_says_so() -> None:
    run = Advised()
    run.follow("a")
    run.inner.broken = True
    assert run.adviser.finish() == []
    with pytest.raises(SourceError, match="a mistake at the end"):
        run.adviser.close()


def test_the_end_of_an_alarm_is_heard_though_its_adviser_was_down() -> None:
    class Faulty(Alarms):
        broken = False

        def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
            if self.broken:
                raise MemoryError
            return super().follow(samples, events)

    clock, alarms = Clock(), Faulty(board_rules(None), None)
    supervised = SupervisedEnricher("alarms", alarms, Outages(Notices()), clock)
    samples, _ = course(20_000)

    def said(kind: Kind, at_ns: int, rows: Samples) -> list[str]:
        events = [Event(at_ns, kind, "", {"effect": "leakage"})]
        return [event.data["deed"] for event in supervised.follow(rows, events)]

    assert said(Kind.DEVIATION, int(samples["time_ns"][0]), samples[:10]) == ["raised"]
    alarms.broken = True
    ended_ns = int(samples["time_ns"][100])
    assert said(Kind.DEVIATION_CLEARED, ended_ns, samples[10:200]) == []
    alarms.broken, clock.now = False, 2.0
    (cleared,) = supervised.follow(samples[200:], [])
    assert (cleared.data["deed"], cleared.time_ns) == ("cleared", ended_ns)
    assert not any(alarm.active for alarm in alarms.board.alarms.values())


# The log.


class Disk:
    """A disk that is full at times."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.full, free = False, ROOM

        def write(output: Any, data: bytes) -> None:
            if self.full:
                output._raw.write(data[: len(data) // 2])
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            output._raw.write(data)

        def usage(_folder: Path) -> Any:
            class Usage:
                pass

            found: Any = Usage()
            found.free = 0 if self.full else free
            return found

        monkeypatch.setattr("twin.log.disk_file.Output.write", write)
        monkeypatch.setattr("twin.log.recorder.shutil.disk_usage", usage)


def logged(path: Path, at: Callable[[float], None]) -> tuple[Samples, Ticks, list[Event]]:
    """Rows written through a supervised log, ``at`` each time (s), and what was told."""
    clock, notices = Clock(), Notices()
    samples, ticks = course(20_000)
    recorder = Recorder(path, HEADER, 200_000, clock)
    sink = SupervisedSink(
        "log", recorder, recorder.again, Outages(notices), clock, held=lambda: recorder.held
    )
    for start in range(0, len(samples), 50):
        clock.now = (start + 50) / 1000
        at(clock.now)
        happened = [Event(int(samples["time_ns"][start]), Kind.GAP, f"{start}")]
        sink.write(samples[start : start + 50], ticks[start : start + 50], happened)
    sink.close()
    return samples, ticks, notices.taken(0)


@pytest.mark.parametrize("begin", [0.0, 0.3, 4.02, 4.9])
def test_a_disk_that_is_full_for_a_while_costs_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begin: float
) -> None:
    disk = Disk(monkeypatch)

    def at(now: float) -> None:
        disk.full = begin < now < begin + 6.0

    samples, ticks, told = logged(tmp_path / "a.mcap", at)
    assert [event.kind for event in told] == [Kind.OUTPUT_DOWN, Kind.OUTPUT_BACK]
    log = open_log(tmp_path / "a.mcap")
    assert len(log.parts) > 1
    assert rows_of(log) == (samples.tobytes(), ticks.tobytes())
    texts = [event.text for event in log.events()]
    assert texts == [str(start) for start in range(0, len(samples), 50)]


def test_after_rows_that_were_lost_the_log_has_a_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.supervised.KEPT_ROWS", 1000)
    disk = Disk(monkeypatch)

    def at(now: float) -> None:
        disk.full = 4.0 < now < 10.0

    samples, _, told = logged(tmp_path / "a.mcap", at)
    log = open_log(tmp_path / "a.mcap")
    rows = np.concatenate([rows for rows, _ in log.blocks()])
    lost = np.flatnonzero(np.diff(rows["sequence"]) != 1) + 1
    assert len(lost) == 1
    assert np.flatnonzero(rows["quality"] & Quality.GAP).tolist() == lost.tolist()
    assert told[-1].data["rows_lost"] == len(samples) - len(rows)
    texts = [event.text for event in log.events()]
    assert texts == [str(start) for start in range(0, len(samples), 50)]  # events wait on


def test_a_folder_that_somebody_deletes_is_made_again(tmp_path: Path) -> None:
    path = tmp_path / "logs" / "a.mcap"
    path.parent.mkdir()
    gone: list[float] = []

    def at(now: float) -> None:
        if now > 5.0 and not gone:
            gone.append(now)
            for file in path.parent.iterdir():
                file.unlink()
            path.parent.rmdir()

    samples, _, told = logged(path, at)
    assert [event.kind for event in told] == [Kind.OUTPUT_DOWN, Kind.OUTPUT_BACK]
    assert "deleted" in told[0].text
    parts = sorted(path.parent.iterdir())
    after = np.concatenate([rows for rows, _ in open_log(parts[0]).blocks()])
    # What was in the deleted file is lost, of what came after it at most a second and a half.
    assert after["sequence"][0] - samples["sequence"][0] < 6500


def test_another_log_of_that_name_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, recorder = Disk(monkeypatch), Recorder(tmp_path / "a.mcap", HEADER, clock=Clock())
    (tmp_path / "a.0001.mcap").write_bytes(b"somebody's")
    disk.full = True
    with pytest.raises(SourceError, match="No space left"):
        recorder.close()
    disk.full = False
    with pytest.raises(SourceError, match=r"a\.0001\.mcap: there is already a log"):
        recorder.again()
    assert (tmp_path / "a.0001.mcap").read_bytes() == b"somebody's"
