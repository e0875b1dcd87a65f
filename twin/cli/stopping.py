"""The end of a command: by a signal or after a time, with an exit code, and everything closed."""

import signal
import threading
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
    """Give a function that returns why to stop: "" (go on), "duration" or "interrupted".

    The first Ctrl-C lets the loop finish its block and close the log; the second one is Python's.
    """
    end: float | None = None  # counts from the first call: the start takes its time
    reason = ""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal reason
        if reason == "interrupted":
            raise KeyboardInterrupt
        reason = "interrupted"

    def stop_reason(*, begun: bool = True) -> str:
        nonlocal reason, end
        if begun and end is None and duration is not None:
            end = time.monotonic() + duration
        if not reason and end is not None and time.monotonic() >= end:
            reason = "duration"
        return reason

    signals = {signal.SIGINT, signal.SIGTERM}
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup
        signals.add(signal.SIGHUP)  # the terminal was closed
    previous = {number: signal.signal(number, interrupt) for number in signals}
    try:
        yield stop_reason
    finally:
        for number, handler in previous.items():
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
    """Let Ctrl-C end this block: a compiler's callbacks swallow Python's exception.

    In a thread beside the main one nothing changes: signals are the main one's.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    interrupted = False

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
    if interrupted:
        raise KeyboardInterrupt


@contextmanager
def closed(source: object) -> Iterator[None]:
    """Close ``source`` at the end, started or not: drivers have threads and connections."""
    try:
        yield
    finally:
        if hasattr(source, "close"):
            source.close()


def leave(alarmed: bool = False, *, interrupted: bool) -> None:
    """Exit with the code that the command line documents."""
    if interrupted:
        raise typer.Exit(INTERRUPTED)
    if alarmed:
        raise typer.Exit(ALARMED)
