"""Connections of any protocol, for reading or writing, that are retried for ever."""

import errno
import queue
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sized
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from twin.backoff import Backoff
from twin.errors import SourceError, TwinError
from twin.signals import SAMPLE, Samples

RETRY_S = 0.4  # s between two attempts to connect
LONGEST_RETRY_S = 1.6  # s, for a PLC that connects without rows; a ring of 4 s outlasts it
WAITING = 256  # longest queue of blocks from a thread
LONGEST_SILENCE_S = 0.25

EMPTY: Samples = np.empty(0, SAMPLE)


class LostError(SourceError):
    """No connection, no answer, or a broken one: the PLC may come back."""


class AbsentError(SourceError):
    """The PLC answers, but lacks an address or node: it does not exist, or the PLC is starting."""


def unreachable(address: str, error: OSError | UnicodeError, server: str) -> LostError:
    """The error for a failed connection to ``address``, where a ``server`` should listen.

    An unknown name, a closed port and silence need different remedies.
    """
    if isinstance(error, socket.gaierror | UnicodeError):
        cause, hint = "no such host", "is the name right, and known here? An IP address always is"
    elif f"[Errno {errno.ECONNREFUSED}]" in str(error):  # asyncio's may be of several addresses
        cause = "the machine refuses this port"
        hint = f"is the {server} started there, and is the port right?"
    elif isinstance(error, TimeoutError):
        cause = "no answer"
        hint = (
            "is the PLC on and its cable in, is the address right, does a firewall stand between? "
            f"Does a {server} listen there?"
        )
    else:
        cause = (error.strerror or str(error)).lower() or type(error).__name__
        hint = "is this machine in the PLC's network, and is the address right?"
    return LostError(f"{address}: no connection: {cause}", hint)


@dataclass(frozen=True)
class Clock:
    """Time and sleeping; tests pass their own."""

    wall_ns: Callable[[], int] = time.time_ns
    now_ns: Callable[[], int] = time.perf_counter_ns  # runs on evenly
    sleep: Callable[[float], None] = time.sleep


REAL = Clock()


class Connection(Protocol):
    """Something to read from that can be lost and opened again."""

    def open(self) -> None:
        """Connect, unless it is connected; LostError if that fails."""

    def close(self) -> None:
        """Close the connection."""


Away = Callable[[TwinError], None]  # receives each reason why a PLC gives no rows once

B = TypeVar("B", bound=Sized)
C = TypeVar("C", bound=Connection)
C_contra = TypeVar("C_contra", bound=Connection, contravariant=True)


class Source(Protocol[C_contra]):
    """The reading position in the samples of one PLC; it outlives connections."""

    def samples(self, link: C_contra) -> Iterator[Samples]:
        """Blocks as they come; ends only by an exception."""
        ...


def reconnecting(
    source: Source[C_contra],
    link: C_contra,
    clock: Clock,
    away: Away | None = None,
    *,
    known: bool = False,
) -> Generator[Samples, None, None]:
    """Samples of ``source`` over successive connections; empty blocks in between.

    Retries are those of ``retrying``. With ``away``, a PLC that cannot be reached or lacks an
    address is also retried before its first rows.
    """
    may_pass = () if away is None else (LostError, AbsentError)
    return retrying(source.samples, link, EMPTY, clock, away, known=known, may_pass=may_pass)


def retrying(
    work: Callable[[C], Iterator[B]],
    link: C,
    nothing: B,
    clock: Clock,
    away: Away | None,
    *,
    known: bool = False,
    may_pass: tuple[type[SourceError], ...] = (),
) -> Generator[B, None, None]:
    """Results of ``work`` over successive connections, until it ends; ``nothing`` in between.

    A PLC that is ``known``, or has given results that are not empty, is retried for ever: any error
    counts as a lost connection. Before that, only errors that ``may_pass`` are retried; others are
    raised. ``away`` receives each reason once until results come. Closing hangs up.
    """
    reasons = set[str]()  # already reported
    backoff = Backoff(RETRY_S, LONGEST_RETRY_S)
    try:
        while True:
            connected = False
            try:
                link.open()
                connected = True
                if known or reasons:
                    yield nothing  # a connection is no answer yet
                for result in work(link):
                    if len(result):
                        known = True
                        backoff.reset()
                        reasons.clear()
                    yield result
                return
            except TwinError as error:
                if not known and not isinstance(error, may_pass):
                    raise
                if away is not None and str(error) not in reasons:
                    reasons.add(str(error))
                    away(error)
                link.close()  # its knowledge of the PLC may be out of date
                # An absent PLC is retried at the shortest interval, so that no row is missed.
                yield from _pause(clock, backoff.next_s() if connected else RETRY_S, nothing)
    finally:
        link.close()


def _pause(clock: Clock, seconds: float, nothing: B) -> Iterator[B]:
    """``nothing`` until the next attempt; the first before any wait."""
    yield nothing
    for _ in range(round(2 * seconds / RETRY_S)):
        clock.sleep(RETRY_S / 2)
        yield nothing


def in_thread(source: Generator[Samples, None, None]) -> Generator[Samples, None, None]:
    """Run ``source`` in its own thread; after its first block, empty ones while it has nothing.

    Its exception is raised here; closing this generator closes it.
    """
    blocks: queue.Queue[Samples | Exception] = queue.Queue(WAITING)
    stop = threading.Event()
    thread = threading.Thread(target=_pump, args=(source, blocks, stop), name="driver")
    thread.start()
    try:
        block = blocks.get()
        while True:
            if isinstance(block, Exception):
                raise block
            yield block
            try:
                block = blocks.get(timeout=LONGEST_SILENCE_S)
            except queue.Empty:
                block = EMPTY
    finally:
        stop.set()
        if threading.current_thread() is not thread:  # unless it is garbage-collected there
            thread.join()


def _pump(
    source: Generator[Samples, None, None],
    blocks: "queue.Queue[Samples | Exception]",
    stop: threading.Event,
) -> None:
    with closing(source):
        try:
            for block in source:
                if not _put(block, blocks, stop):
                    return
        except Exception as error:  # in_thread raises it again
            _put(error, blocks, stop)


def _put(
    item: Samples | Exception, blocks: "queue.Queue[Samples | Exception]", stop: threading.Event
) -> bool:
    """Queue ``item``, however long it takes; False once the consumer has stopped."""
    while not stop.is_set():
        try:
            blocks.put(item, timeout=LONGEST_SILENCE_S)
            return True
        except queue.Full:
            continue
    return False
