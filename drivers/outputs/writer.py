"""Hardware in the loop: what the model answers, written into the PLC; nothing else ever writes.

Only tags that stand under ``[hil.tags]`` are written, each within its range, no more often than
``min_interval_ms`` allows, and from a thread of its own: the loop waits for no PLC.
"""

import logging
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol, Self

from drivers.reconnect import RETRY_S, LostError
from drivers.tags import Quantity
from twin.errors import SourceError
from twin.signals import MBAR

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outputs:
    """What an ejector answers to its PLC."""

    pressure: float  # Pa, absolute, as the PLC's sensor reads it
    part_present: bool  # H2
    air_saving: bool  # H1


class Outlet(Protocol):
    """Where outputs go; ``watchdog`` counts them."""

    def open(self) -> None:
        """Connect, unless it is connected; LostError if that fails."""

    def close(self) -> None:
        """Hang up."""

    def write(self, outputs: Outputs, watchdog: int) -> None:
        """Write every tag that is listed; LostError if no answer comes, or SourceError."""


class Writer:
    """Writes the newest outputs, and is lost and back again by itself."""

    def __init__(self, outlet: Outlet, where: str, interval_ms: float) -> None:
        self._outlet, self._where, self._interval_s = outlet, where, interval_ms * 1e-3
        self._newest: tuple[Outputs, int] | None = None
        self._blocks = 0
        self._news = threading.Condition()
        self._failure: SourceError | None = None
        self._closed = False
        self._taken = False  # outputs were: what is refused later may pass
        outlet.open()
        self._thread = threading.Thread(target=self._run, name="hil writer")
        self._thread.start()

    def put(self, outputs: Outputs) -> None:
        """Have them written as soon as may be; SourceError if the PLC refuses the first ones."""
        with self._news:
            if self._failure is not None:
                raise self._failure
            self._blocks += 1
            self._newest = outputs, self._blocks
            self._news.notify()

    def close(self) -> None:
        """Write nothing more and hang up; the PLC sees its watchdog stand still."""
        with self._news:
            self._closed = True
            self._news.notify()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        try:
            while (newest := self._take()) is not None:
                started = time.monotonic()
                self._write(*newest)
                self._pause(started + self._interval_s - time.monotonic())
        except SourceError as error:
            with self._news:
                self._failure = error
        finally:
            self._outlet.close()

    def _take(self) -> tuple[Outputs, int] | None:
        """The newest, once there is one that is not written yet; None at the end."""
        with self._news:
            self._news.wait_for(lambda: self._closed or self._newest is not None)
            newest, self._newest = self._newest, None
            return None if self._closed else newest

    def _pause(self, seconds: float) -> None:
        with self._news:
            self._news.wait_for(lambda: self._closed, max(seconds, 0.0))

    def _write(self, outputs: Outputs, watchdog: int) -> None:
        try:
            self._outlet.write(outputs, watchdog)
            self._taken = True
        except SourceError as error:
            if not self._taken and not isinstance(error, LostError):
                raise
            log.warning("%s: nothing is written until it is back: %s", self._where, error)
            self._outlet.close()
            self._reconnect()

    def _reconnect(self) -> None:
        while not self._closed:
            self._pause(RETRY_S)
            with suppress(SourceError):
                self._outlet.open()
                return


class Ranged:
    """A pressure as the PLC has it, kept within its range; says so once."""

    def __init__(self, quantity: Quantity, ambient: float, where: str) -> None:
        self._quantity, self._ambient, self._where = quantity, ambient, where
        self._said = False

    def raw(self, pressure: float) -> float:
        """What is to be written for ``pressure`` (Pa, absolute)."""
        raw, within = self._quantity.raw_of(pressure, self._ambient)
        if not within and not self._said:
            self._said = True
            text = "%s: the model's pressure (%.1f mbar absolute) is beyond the range of"
            text += " [hil.tags.pressure]; the end of the range is written"
            log.warning(text, self._where, pressure / MBAR)
        return raw


def counted(blocks: int, limits: tuple[int, int]) -> int:
    """What a watchdog that counts from the low to the high end shows after so many blocks."""
    low, high = limits
    return low + (blocks - 1) % (high - low + 1)


def refuse_no_range(limits: tuple[float, float] | None) -> None:
    """ValueError where what is written has no bounds."""
    if limits is None:
        raise ValueError("a pressure that is written needs its range = [low, high]")


def refuse_empty(limits: tuple[int, int]) -> None:
    """ValueError where there is nothing to count."""
    if not limits[0] < limits[1]:
        raise ValueError("range must be [low, high] with low < high")
