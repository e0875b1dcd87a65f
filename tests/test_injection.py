"""Every call of the log and every write of the other outputs fails in turn, and no row is lost.

In the manner of SQLite's tests. A first run without faults counts the calls, so that new ones are
covered by themselves. Time is the test's own, so that the test does not sleep.
"""

import errno
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from functools import cache, partial
from itertools import count
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import psutil
import pytest
import rigs

import twin.log
from twin.alarms.loop import Alarms
from twin.alarms.settings import board_rules
from twin.assets.unit import Unit
from twin.cli.console import Console
from twin.cli.sinks import supervised
from twin.errors import SourceError
from twin.events import Event, Kind
from twin.figures.database import open_store
from twin.figures.writer import FigureWriter
from twin.live import Twin, run
from twin.log.disk_file import Output
from twin.log.part import SUFFIX
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.monitor.staleness import Listening, Notices
from twin.page.ring import LiveRows
from twin.quality import Quality
from twin.signals import SAMPLE, TICK, Samples, Ticks
from twin.supervised import Outages, SupervisedSink

ROWS, BLOCK = 600, 30
GAP = 200, 207  # rows that the source lacks
BLOCK_S = 0.2  # by the test's clock, so that a log is flushed, synced and tried again often
ROTATE_BYTES = 9_000
LOG = str(Path(twin.log.__file__).parent)
OVERLOOKED = {"npy_ctypes_check", "EnumType.__getattr__"}  # what libraries go on without

Site = tuple[str, int, str]  # file, line and what is called there


UNIT = Unit("compact-ejector-35", "rig-01")
OUTAGE = Kind.OUTPUT_DOWN, Kind.OUTPUT_BACK


class Clock:
    """Time as the test wants it, in s and in ns."""

    now = 0.0

    @classmethod
    def s(cls) -> float:
        return cls.now

    @classmethod
    def ns(cls) -> int:
        return round(cls.now * 1e9)


class Calls:
    """Sees each call that code of the log makes; the one numbered ``fails`` raises ``error``."""

    def __init__(
        self, fails: int | None = None, error: Callable[[], Exception] = MemoryError
    ) -> None:
        self.sites: list[Site] = []
        self._fails, self._error = fails, error

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        if event == "c_call":
            caller, callee = frame, str(getattr(argument, "__qualname__", argument))
        elif event == "call" and frame.f_back is not None:
            caller, callee = frame.f_back, frame.f_code.co_qualname
        else:
            return
        file = caller.f_code.co_filename
        if callee.endswith("gc_callback"):  # of hypothesis, whenever memory is tidied up
            return
        if file.startswith(LOG) or caller.f_code is Inline.submit.__code__:
            self.sites.append((file, caller.f_lineno, callee))
            if self._fails == len(self.sites) - 1:
                raise self._error()  # this also ends the profile


class Disk:
    """Counts what is asked of the disk; refuses it, half written, while ``fails`` says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, error: Callable[[], Exception]) -> None:
        self._error, write = error, Output.write
        self.begin()

        def half_written(output: Output, data: bytes) -> None:
            if self._is_refused():
                write(output, data[: len(data) // 2])
                raise self._error()
            write(output, data)

        monkeypatch.setattr(Output, "write", half_written)
        for place, name in ((os, "fdatasync"), (os, "fstat"), (Path, "mkdir"), (Path, "open")):
            monkeypatch.setattr(place, name, self._refusing(getattr(place, name)))
        usage = "twin.log.recorder.shutil.disk_usage"
        monkeypatch.setattr(usage, self._refusing(shutil.disk_usage))

    def begin(self, fails: Callable[[int], bool] = lambda _number: False) -> None:
        """Count from 0."""
        self.asked, self._fails = 0, fails

    def _refusing(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            is_ours = sys._getframe(1).f_code.co_filename.startswith(LOG)
            if (is_ours or function is fdatasync) and self._is_refused():
                raise self._error()
            return function(*arguments, **named)

        return call

    def _is_refused(self) -> bool:
        self.asked += 1
        return self._fails(self.asked - 1)


class Inline:
    """What syncs a log, at once: so each run makes the same calls."""

    def __init__(self, _threads: int, _name: str) -> None:
        pass

    def submit(self, function: Callable[..., None], *arguments: Any) -> "Future[None]":
        future: Future[None] = Future()
        try:
            function(*arguments)
            future.set_result(None)
        except Exception as error:
            future.set_exception(error)
        return future

    def shutdown(self) -> None:
        pass


@cache
def rows() -> Samples:
    """A stretch of the simulated rig, with a hole that the driver has marked."""
    whole = rigs.recorded("test_rig", ROWS / 1000)[0]
    samples = np.delete(whole, np.s_[GAP[0] : GAP[1]])
    samples["quality"][GAP[0]] |= Quality.GAP
    return samples


@cache
def known() -> Twin:
    return rigs.twin("test_rig")


def twin_beside() -> Twin:
    return Twin(known().theta, known().detector, known().terms)


class Run:
    """The loop over these rows, with a supervised log as its one sink."""

    def __init__(
        self, folder: Path, calls: Calls | None = None, begun: Callable[[], None] | None = None
    ) -> None:
        self.path = folder / "a.mcap"
        self.error: SourceError | None = None
        self.calls: list[int] = []  # before each block
        Clock.now, notices = 0.0, Notices()
        header = rigs.config("test_rig").log_header()
        recorder = Recorder(self.path, header, ROTATE_BYTES, Clock.s)
        sink = SupervisedSink(
            "log", recorder, recorder.again, Outages(notices), Clock.s, held=lambda: recorder.held
        )

        def source() -> Iterator[Samples]:
            for block in rigs.cut(rows(), BLOCK):
                self.calls.append(len(calls.sites) if calls else 0)
                Clock.now += BLOCK_S
                yield block

        beside, monitor = twin_beside(), rigs.monitor("test_rig")
        if begun:
            begun()
        sys.setprofile(calls)
        try:
            run(source(), beside, monitor, [sink], Listening(Clock.ns, notices))
        except SourceError as error:
            self.error = error
        finally:
            sys.setprofile(None)

    def logged(self) -> tuple[Samples, Ticks, list[Event]]:
        """All that can be read, which is in one log."""
        log = open_log(self.path)
        assert sorted(log.parts) == sorted(self.path.parent.glob(f"*{SUFFIX}"))
        pairs = [(np.empty(0, SAMPLE), np.empty(0, TICK)), *log.blocks()]
        samples, ticks = (np.concatenate(column) for column in zip(*pairs, strict=True))
        return samples, ticks, list(log.events())


def fdatasync(_handle: int) -> None:
    """No disk is waited for."""


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin.log.disk_file.ThreadPoolExecutor", Inline)
    monkeypatch.setattr("os.fdatasync", fdatasync)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Callable[[], Path]]:
    """Gives an empty folder each time; at the end all files are closed."""
    process, numbers = psutil.Process(), count()

    def new() -> Path:
        path = tmp_path / str(next(numbers))
        path.mkdir()
        return path

    before = process.num_fds()
    yield new
    assert process.num_fds() == before


def full_disk() -> Exception:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def broken_disk() -> Exception:
    return OSError(errno.EIO, os.strerror(errno.EIO))


def first_and_last(sites: Sequence[Site]) -> list[tuple[int, Callable[[], Exception]]]:
    """Of each place the first call, which meets a full disk, and the last, which has no memory."""
    first = {site: number for number, site in reversed([*enumerate(sites)])}
    last = {site: number for number, site in enumerate(sites)}
    return [(call, full_disk) for call in first.values()] + [
        (call, MemoryError) for call in last.values()
    ]


@pytest.mark.slow
def test_whatever_call_of_the_log_fails_no_row_is_lost(folder: Callable[[], Path]) -> None:
    without = Run(folder(), calls := Calls())
    samples, ticks, events = without.logged()
    assert np.array_equal(samples["sequence"], rows()["sequence"])
    assert len(open_log(without.path).parts) > 2
    assert Kind.GAP in {event.kind for event in events}
    points = first_and_last(calls.sites)
    assert len(points) > 400
    for number, error in points:
        failed = Run(folder(), Calls(number, error))
        assert failed.error is None
        other_samples, other_ticks, other_events = failed.logged()
        at = calls.sites[number], number, error
        assert other_samples.tobytes() == samples.tobytes(), at
        assert other_ticks.tobytes() == ticks.tobytes(), at
        assert [event for event in other_events if event.kind not in OUTAGE] == events, at
        told = [event.kind for event in other_events if event.kind in OUTAGE]
        # What goes wrong at the very end is mended without an event.
        if number < without.calls[-12] and calls.sites[number][2] not in OVERLOOKED:
            assert told == list(OUTAGE), at


def test_a_disk_that_stays_full_is_told_with_how_many_rows_are_missing(
    folder: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(monkeypatch, full_disk)
    Run(folder(), begun=disk.begin)
    for number in range(0, disk.asked, 3):
        failed = Run(folder(), begun=partial(disk.begin, lambda asked, at=number: asked >= at))
        disk.begin()
        samples, _, _ = failed.logged()
        missing = len(rows()) - len(samples)
        assert np.array_equal(samples["sequence"], rows()["sequence"][: len(samples)])
        assert f"No space left on device; {missing} rows " in str(failed.error)


def test_a_disk_that_breaks_for_long_costs_rows_that_are_a_marked_gap(
    folder: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.supervised.KEPT_ROWS", 2 * BLOCK)
    disk = Disk(monkeypatch, broken_disk)
    Run(folder(), begun=disk.begin)
    lost = 0
    for number in range(0, disk.asked, 3):
        done = Run(folder(), begun=partial(disk.begin, broken_for(0.9, number)))
        disk.begin()
        samples, _, events = done.logged()
        steps = np.diff(samples["sequence"])
        assert (steps > 0).all()
        marked = samples["quality"] & Quality.GAP != 0
        assert np.flatnonzero(marked).tolist() == (np.flatnonzero(steps > 1) + 1).tolist()
        back = [event.data["rows_lost"] for event in events if event.kind is Kind.OUTPUT_BACK]
        if back:  # else the run has ended before
            assert sum(back) == len(rows()) - len(samples)
            lost += sum(back)
    assert lost


def broken_for(seconds: float, number: int) -> Callable[[int], bool]:
    """From what is asked then on, for so long."""
    until: list[float] = []

    def fails(asked: int) -> bool:
        if asked == number:
            until.append(Clock.now + seconds)
        return bool(until) and Clock.now < until[0]

    return fails


# --- the other outputs ----------------------------------------------------------------------------

OUTPUTS = ("console", "key figures", "live page", "log", "alarms")


class Beside:
    """The loop with outputs as ``twin run`` has them; one call of one of them fails."""

    def __init__(
        self, folder: Path, output: str, fails: int, error: Callable[[], Exception]
    ) -> None:
        Clock.now, notices = 0.0, Notices()
        self.lines: list[str] = []
        self.path = folder / "a.mcap"
        header = rigs.config("test_rig").log_header()
        outputs: dict[str, Any] = {
            "console": Console("", self.lines.append),
            "key figures": FigureWriter(
                lambda: open_store(folder / "f.sqlite"), UNIT, "a", pytest.fail
            ),
            "live page": LiveRows(folder / "live.ring", 101_300.0, pytest.fail, Clock.ns),
            "log": Recorder(self.path, header, ROTATE_BYTES, Clock.s),
            "alarms": Alarms(board_rules(None), None),
        }
        self.calls = 0
        name = "follow" if output == "alarms" else "write"
        function = getattr(outputs[output], name)

        def failing(*given: Any) -> Any:
            self.calls += 1
            if self.calls - 1 == fails:
                raise error()
            return function(*given)

        setattr(outputs[output], name, failing)
        alarms = outputs.pop("alarms")
        sinks, advisers = supervised(outputs, {"alarms": alarms}, notices)

        def source() -> Iterator[Samples]:
            for block in rigs.cut(rows(), BLOCK):
                time.sleep(0)  # the threads beside the loop
                Clock.now += BLOCK_S
                yield block

        run(
            source(),
            twin_beside(),
            rigs.monitor("test_rig"),
            sinks,
            Listening(Clock.ns, notices),
            advisers,
        )


@pytest.mark.slow
@pytest.mark.parametrize("output", OUTPUTS)
def test_whatever_call_of_an_output_fails_the_run_goes_on_and_tells(
    output: str, folder: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.supervised.FIRST_PAUSE_S", 0.0)
    threads = threading.active_count()
    calls = Beside(folder(), output, -1, MemoryError).calls
    assert calls > len(rows()) // BLOCK
    for number in range(0, calls - 4, 2):
        for error in (MemoryError, full_disk):
            done = Beside(folder(), output, number, error)
            log = open_log(done.path)
            logged = np.concatenate([samples for samples, _ in log.blocks()])
            assert np.array_equal(logged["sequence"], rows()["sequence"]), number
            told = [event for event in log.events() if event.kind in OUTAGE]
            assert [event.kind for event in told] == list(OUTAGE), number
            assert {event.data["output"] for event in told} == {output}
            assert any("output_down" in line for line in done.lines), number
    assert threading.active_count() == threads
