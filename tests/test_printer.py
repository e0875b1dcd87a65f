"""Lines for who reads slowly, or not at all: whoever prints them never waits."""

import errno
import io
import os
import threading
import time
from collections.abc import Callable, Iterator
from typing import TextIO

import pytest

from twin import printer as module
from twin.errors import SourceError
from twin.printer import MOST_WAITING, Printer

LINE = f"{'x' * 98}\n"


class Pipe:
    """A pipe that nobody reads unless the test does."""

    def __init__(self) -> None:
        self.reads, writes = os.pipe()
        self.stream: TextIO = os.fdopen(writes, "w", encoding="utf-8")

    def read(self, length: int) -> str:
        data = b""
        while len(data) < length:
            data += os.read(self.reads, length - len(data))
        return data.decode()


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    made = Pipe()
    yield made
    made.stream.close()


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PATIENCE_S", 0.05)
    monkeypatch.setattr(module, "RETRY_S", 0.001)


def ended(printer: Printer) -> bool:
    printer._thread.join(20.0)
    return not printer._thread.is_alive()


def full(printer: Printer) -> int:
    """Print until the pipe and the room before it are full; gives how many lines there were."""
    printed = refused = 0
    while refused < 20:
        try:
            printer.print(LINE)
            printed, refused = printed + 1, 0
        except SourceError:
            refused += 1
            time.sleep(0.005)
    return printed


def test_nobody_waits_for_a_reader_and_it_gets_all_in_order(pipe: Pipe) -> None:
    printer = Printer(pipe.stream)
    printed = full(printer)
    assert printed > MOST_WAITING
    with pytest.raises(SourceError, match="nobody takes what it says") as caught:
        printer.print(LINE)
    assert "pager" in caught.value.hint
    took = threading.Event()

    def read() -> None:
        assert pipe.read(printed * len(LINE)) == LINE * printed
        took.set()
        assert pipe.read(4) == "end\n"

    reader = threading.Thread(target=read)
    reader.start()
    assert took.wait(20.0)
    printer.print("end\n")
    assert printer.close() == 0
    reader.join()
    os.close(pipe.reads)


def test_lines_that_may_be_left_out_are_counted(pipe: Pipe) -> None:
    printer = Printer(pipe.stream)
    printed = full(printer)
    for _ in range(3):
        printer.say("lost\n")
    assert pipe.read(printed * len(LINE)) == LINE * printed
    printer.say("found\n")
    said = "twin: 3 lines are missing here\nfound\n"
    assert pipe.read(len(said)) == said
    assert printer.close() == 0
    os.close(pipe.reads)


def test_the_end_does_not_wait_for_a_reader_that_takes_nothing(pipe: Pipe) -> None:
    printer = Printer(pipe.stream)
    full(printer)
    assert printer.close() == MOST_WAITING
    os.close(pipe.reads)
    assert ended(printer)


def test_a_reader_that_goes_ends_it(pipe: Pipe) -> None:
    printer = Printer(pipe.stream)
    full(printer)
    os.close(pipe.reads)
    assert ended(printer)
    printer.print(LINE)  # for nobody
    assert printer.close() == 0


def test_a_full_disk_is_tried_again(pipe: Pipe, monkeypatch: pytest.MonkeyPatch) -> None:
    write, tries = os.write, threading.Semaphore(0)
    failures = iter([errno.ENOSPC, errno.EFBIG, errno.EAGAIN])

    def flaky(handle: int, data: bytes) -> int:
        for number in failures:
            tries.release()
            raise OSError(number, os.strerror(number))
        return write(handle, data[:3])  # it may take less than all

    monkeypatch.setattr(os, "write", flaky)
    printer = Printer(pipe.stream)
    printer.print("first\n")
    printer.print("second\n")
    assert pipe.read(13) == "first\nsecond\n"
    assert printer.close() == 0
    os.close(pipe.reads)


def test_why_it_cannot_be_written_is_said(pipe: Pipe, monkeypatch: pytest.MonkeyPatch) -> None:
    full_disk = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def refuse(_handle: int, _data: bytes) -> int:
        raise full_disk

    monkeypatch.setattr(os, "write", refuse)
    printer = Printer(pipe.stream)
    with pytest.raises(SourceError, match="it cannot be written: No space left on device"):  # noqa: PT012
        for _ in range(MOST_WAITING + 1):
            printer.print(LINE)
            until(lambda: printer._why != "nobody takes what it says")
    assert printer.close() == MOST_WAITING
    assert ended(printer)
    os.close(pipe.reads)


def until(done: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not done():
        assert time.monotonic() < end
        time.sleep(0.001)


def test_a_stream_in_memory_is_printed_to() -> None:
    stream = io.StringIO()
    printer = Printer(stream)
    printer.print("ä\n")
    assert printer.close() == 0
    assert stream.getvalue() == "ä\n"


def test_letters_that_a_terminal_does_not_have_are_no_error(pipe: Pipe) -> None:
    stream = os.fdopen(os.dup(pipe.stream.fileno()), "w", encoding="ascii")
    printer = Printer(stream)
    printer.print("−3 ms\n")
    assert pipe.read(11) == "\\u22123 ms\n"
    assert printer.close() == 0
    stream.close()
    os.close(pipe.reads)
