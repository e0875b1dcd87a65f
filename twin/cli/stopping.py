"""How a command ends: by a signal, after a time, with an exit code, and nothing left open."""

import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from twin.signals import Samples

INTERRUPTED = 130
ALARMED = 1


@contextmanager
def stop_on_signal(duration: float | None) -> Iterator[Callable[..., str]]:
    """Give a function that says why to stop: "" (go on), "duration" or "interrupted".

    The first Ctrl-C lets the loop finish its block and close the log; the second one is Python's.
    """
    end: float | None = None  # from the first question on: what comes before takes its time
    reason = ""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal reason
        if reason == "interrupted":
            raise KeyboardInterrupt
        reason = "interrupted"

    def why(*, begun: bool = True) -> str:
        nonlocal reason, end
        if begun and end is None and duration is not None:
            end = time.monotonic() + duration
        if not reason and end is not None and time.monotonic() >= end:
            reason = "duration"
        return reason

    wanted = {signal.SIGINT, signal.SIGTERM}
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup
        wanted.add(signal.SIGHUP)  # the terminal was closed
    before = {number: signal.signal(number, interrupt) for number in wanted}
    try:
        yield why
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def until(stopped: Callable[[], str], source: "Iterable[Samples]") -> "Iterator[Samples]":
    """The blocks of ``source`` until ``stopped`` gives a reason; the source is closed."""
    blocks = iter(source)
    try:
        while not stopped() and (block := next(blocks, None)) is not None:
            yield block
    finally:
        if hasattr(blocks, "close"):
            blocks.close()


@contextmanager
def heeded() -> Iterator[None]:
    """Have a Ctrl-C end what is done here: a compiler's callbacks swallow Python's exception."""
    interrupted = False

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupted:
        raise KeyboardInterrupt


@contextmanager
def closed(source: object) -> Iterator[None]:
    """Close it at the end, begun or not: drivers have threads and connections."""
    try:
        yield
    finally:
        if hasattr(source, "close"):
            source.close()


def leave(alarmed: bool = False, *, interrupted: bool) -> None:
    """Exit as the contract of the command line has it."""
    if interrupted:
        raise typer.Exit(INTERRUPTED)
    if alarmed:
        raise typer.Exit(ALARMED)
