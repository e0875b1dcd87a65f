"""Rows that are read ahead of the loop: all of them, in order, judged by when they came."""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import count

import numpy as np
import pytest
import rigs
from rigs import Collect

from twin import acquisition
from twin.acquisition import Acquisition
from twin.events import Kind
from twin.live import run
from twin.monitor.staleness import Listening
from twin.signals import SAMPLE, Samples

S, MS = 1_000_000_000, 1_000_000


def rows(count: int, first: int = 0) -> Samples:
    """Good rows, one each millisecond."""
    samples = np.zeros(count, SAMPLE)
    samples["sequence"] = first + np.arange(count)
    samples["time_ns"] = samples["host_ns"] = samples["sequence"] * MS
    return samples


class Source:
    """Blocks of a source that waits before one of them until it is let go on."""

    def __init__(self, blocks: Sequence[Samples], waits_before: int) -> None:
        self.blocks, self.waits_before = blocks, waits_before
        self.ns, self.threads = 0, list[threading.Thread]()
        self.reached, self.go_on = threading.Event(), threading.Event()

    def __iter__(self) -> Iterator[Samples]:
        for number, block in enumerate(self.blocks):
            if number == self.waits_before:
                self.reached.set()
                assert self.go_on.wait(10.0)
            self.ns += 100 * MS
            self.threads.append(threading.current_thread())
            yield block


def test_the_loop_reads_on_by_itself_once_it_has_caught_up() -> None:
    parts = [rows(10, first) for first in range(0, 80, 10)]
    source = Source(parts, 5)
    with closing(Acquisition(iter(source), lambda: source.ns, ahead=True)) as ahead:
        assert source.reached.wait(10.0)
        threading.Timer(0.05, source.go_on.set).start()  # the loop then waits for the thread
        came, blocks = list[int](), list[Samples]()
        for block in ahead.blocks():
            came.append(ahead.clock())
            blocks.append(block)
    assert [block.tobytes() for block in blocks] == [block.tobytes() for block in parts]
    assert came == [100 * MS * number for number in range(1, 9)]
    assert source.threads[4] is not threading.current_thread()
    assert source.threads[7] is threading.current_thread()


def test_a_source_faster_than_the_loop_is_read_ahead_no_longer() -> None:
    """Such as a file: all of it would wait in memory."""
    readers = list[threading.Thread]()

    def fast() -> Iterator[Samples]:
        for first in count(0, 10):
            readers.append(threading.current_thread())
            yield rows(10, first)

    came = list[int]()
    with closing(Acquisition(fast(), ahead=True)) as ahead:
        assert ahead._thread is not None
        for block in ahead.blocks():
            came.append(int(block["sequence"][0]))
            assert len(came) < 1_000_000
            if readers[-1] is threading.current_thread():
                break
            while len(readers) < 2 * len(came) and ahead._thread.is_alive():
                time.sleep(0.001)
    assert came == list(range(0, 10 * len(came), 10))


def test_without_reading_ahead_no_thread_is_there() -> None:
    source = Source([rows(10), rows(10, 10)], 9)
    with closing(Acquisition(iter(source), lambda: source.ns, ahead=False)) as direct:
        assert [direct.clock() for _ in direct.blocks()] == [100 * MS, 200 * MS]
    assert set(source.threads) == {threading.current_thread()}


def test_the_oldest_rows_find_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acquisition, "MOST_ROWS", 25)
    source = Source([rows(10), rows(10, 10), rows(0), rows(10, 20), rows(10, 30)], 9)
    with closing(Acquisition(iter(source), ahead=True)) as ahead:
        ahead._thread.join()  # type: ignore[union-attr]
        assert [block["sequence"][0] for block in ahead.surplus()] == [0, 10]
        assert [len(block) for block in ahead.blocks()] == [0, 10, 10]


def test_a_source_that_breaks_does_so_after_the_rows_before() -> None:
    def breaks() -> Iterator[Samples]:
        yield rows(10)
        raise OSError("cable")

    with closing(Acquisition(breaks(), ahead=True)) as ahead:
        blocks = ahead.blocks()
        assert len(next(blocks)) == 10
        with pytest.raises(OSError, match="cable"):
            next(blocks)


def test_what_waited_is_judged_by_when_it_came() -> None:
    """A silence in it is the PLC's, and a loop that catches up has not been late."""
    samples = rigs.recorded("gripper", 6.0)[0].copy()
    for field in ("time_ns", "host_ns"):
        samples[field][3000:] += 2 * S
    samples["sequence"][3000:] += 2000
    parts = rigs.cut(samples, 100)
    parts[30:30] = [rows(0)] * 20
    direct, waited = (seen_by_a_run(parts, ahead=ahead) for ahead in (False, True))
    assert Kind.PLC_STALE in [event.kind for event in direct.events]
    assert waited.events == direct.events
    assert np.concatenate(waited.samples).tobytes() == np.concatenate(direct.samples).tobytes()
    assert np.concatenate(waited.ticks).tobytes() == np.concatenate(direct.ticks).tobytes()


def seen_by_a_run(parts: Sequence[Samples], *, ahead: bool) -> Collect:
    """What a loop makes of blocks that come each 0.1 s, maybe all before it begins."""
    seen, source = Collect(), Source(parts, len(parts))
    with closing(Acquisition(iter(source), lambda: source.ns, ahead=ahead)) as acquired:
        if acquired._thread is not None:
            acquired._thread.join()
        pair = rigs.twin("gripper"), rigs.monitor("gripper")
        run(acquired.blocks(), *pair, [seen], Listening(acquired.clock))
    return seen
