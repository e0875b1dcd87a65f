"""Hardware in the loop: the model's outputs are written into the PLC; nothing else ever writes.

Only tags under ``[hil.tags]`` are written, each within its range, and no more often than
``min_interval_ms`` allows. A thread of its own writes: the loop never waits for a PLC.
"""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Protocol, Self

from drivers.reconnect import Clock, Connection, LostError, retrying
from drivers.tags import Quantity
from twin.errors import SourceError, TwinError
from twin.signals import MBAR

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outputs:
    """Signals of an ejector to its PLC."""

    pressure: float  # Pa, absolute, as the PLC's sensor reads it
    part_present: bool  # H2
    air_saving: bool  # H1


class Outlet(Connection, Protocol):
    """Destination of outputs; ``watchdog`` counts them."""

    def write(self, outputs: Outputs, watchdog: int) -> None:
        """Write every tag that is listed; LostError if no answer comes, or SourceError."""


class Writer:
    """Writes the newest outputs; it reconnects by itself after a loss."""

    def __init__(self, outlet: Outlet, target: str, interval_ms: float) -> None:
        self._outlet, self._target, self._interval_s = outlet, target, interval_ms * 1e-3
        self._newest: tuple[Outputs, int] | None = None
        self._blocks = 0
        self._changed = threading.Condition()
        self._failure: SourceError | None = None
        self._closed = False
        self._away = False  # the PLC, which was reported
        outlet.open()
        self._thread = threading.Thread(target=self._run, name="hil writer")
        self._thread.start()

    def put(self, outputs: Outputs) -> None:
        """Have ``outputs`` written soon; SourceError if the PLC refuses the first ones."""
        with self._changed:
            if self._failure is not None:
                raise self._failure
            self._blocks += 1
            self._newest = outputs, self._blocks
            self._changed.notify()

    def close(self) -> None:
        """Write nothing more and hang up; the PLC sees its watchdog stand still."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        """Write until it is closed; a PLC that took outputs once is retried for ever."""
        clock = Clock(sleep=self._pause)
        writing = retrying(
            self._written, self._outlet, b"", clock, self._warn, may_pass=(LostError,)
        )
        try:
            with closing(writing):
                for _ in writing:
                    if self._closed:
                        return
        except SourceError as error:
            with self._changed:
                self._failure = error

    def _written(self, outlet: Outlet) -> Iterator[bytes]:
        """The watchdog's count of each outputs once they are written."""
        while (newest := self._take()) is not None:
            started = time.monotonic()
            outlet.write(*newest)
            self._away = False
            yield newest[1].to_bytes(8)
            self._pause(started + self._interval_s - time.monotonic())

    def _warn(self, error: TwinError) -> None:
        """Log the first reason of each loss."""
        if not self._away:
            self._away = True
            log.warning("%s: nothing is written until it is back: %s", self._target, error)

    def _take(self) -> tuple[Outputs, int] | None:
        """The newest outputs once some are not yet written; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._newest is not None)
            newest, self._newest = self._newest, None
            return None if self._closed else newest

    def _pause(self, seconds: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._closed, max(seconds, 0.0))


class Ranged:
    """A pressure as the PLC's number, limited to its range; the first limiting is logged."""

    def __init__(self, quantity: Quantity, ambient: float, target: str) -> None:
        self._quantity, self._ambient, self._target = quantity, ambient, target
        self._warned = False

    def raw(self, pressure: float) -> float:
        """The number to write for ``pressure`` (Pa, absolute)."""
        raw, within = self._quantity.raw_of(pressure, self._ambient)
        if not within and not self._warned:
            self._warned = True
            text = "%s: the model's pressure (%.1f mbar absolute) is beyond the range of"
            text += " [hil.tags.pressure]; the end of the range is written"
            log.warning(text, self._target, pressure / MBAR)
        return raw


def counted(blocks: int, limits: tuple[int, int]) -> int:
    """Count of a watchdog after so many blocks; it wraps from the high end to the low end."""
    low, high = limits
    return low + (blocks - 1) % (high - low + 1)


def refuse_no_range(limits: tuple[float, float] | None) -> None:
    """ValueError if a pressure to be written has no range."""
    if limits is None:
        raise ValueError("a pressure that is written needs its range = [low, high]")


def refuse_empty(limits: tuple[int, int]) -> None:
    """ValueError if the range holds nothing to count."""
    if not limits[0] < limits[1]:
        raise ValueError("range must be [low, high] with low < high")
