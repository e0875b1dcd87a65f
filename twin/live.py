"""The loop: blocks in, twin, monitor, sinks out. All of the path is on this page."""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from twin.events import Event
from twin.model import kernel
from twin.model.theta import Theta
from twin.monitor.detect import Monitor
from twin.monitor.phases import Found, Knees, PhaseFinder
from twin.monitor.signatures import steps
from twin.signals import SAMPLE, TICK, Samples, Ticks


class Sink(Protocol):
    """Whatever takes the result: a log, a view, an alarm output."""

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Take rows, their ticks, and what happened."""

    def close(self) -> None:
        """Finish; nothing comes after it."""


@dataclass
class Twin:
    """The model beside the rig: what the sensor should read, a fixed lag behind the measurement."""

    theta: Theta
    knees: Knees
    _state: kernel.State = field(default_factory=kernel.new_state)
    _last_ns: int | None = None

    def __post_init__(self) -> None:
        self._finder = PhaseFinder(self.knees)

    def advance(self, block: Samples) -> tuple[Samples, Ticks]:
        """Take a block; give the rows that are settled with what the twin says to them."""
        return self._expect(self._finder.push(block))

    def flush(self) -> tuple[Samples, Ticks]:
        """Give the rows still held back at the end of the stream."""
        return self._expect(self._finder.flush())

    def _expect(self, found: Found) -> tuple[Samples, Ticks]:
        samples, phase, level = found
        ticks = np.empty(len(samples), TICK)
        ticks["phase"], ticks["level"] = phase, level
        expected = np.empty(len(samples))
        dt = steps(samples, self._last_ns)
        level, signals = ticks["level"].astype("f8"), np.empty(len(samples), "u1")
        kernel.advance(self._state, self.theta, dt, phase, level, expected, signals)
        ticks["expected"], ticks["signals"] = expected, signals
        if len(samples):
            self._last_ns = int(samples["time_ns"][-1])
        return samples, ticks


def compiled(theta: Theta, knees: Knees) -> Twin:
    """A twin whose path is compiled: seconds where nothing is cached, not to fall into a block."""
    Twin(theta, knees).advance(np.zeros(3 * knees.lag, SAMPLE))
    return Twin(theta, knees)


def run(
    source: Iterable[Samples],
    twin: Twin,
    monitor: Monitor,
    sinks: Sequence[Sink],
    clock: Callable[[], int] = time.time_ns,
) -> None:
    """Take every block of ``source`` through twin and monitor to the sinks; close them at the end.

    ``clock`` (ns, as the driver stamps receipts) is asked only while nothing arrives.
    """
    last = None
    with ExitStack() as closing:
        for sink in sinks:
            closing.callback(sink.close)
        for block in source:
            silent: list[Event] = []
            if len(block):
                last = block[-1].copy()
            elif last is not None:
                silent = monitor.silent(last, clock())
            samples, ticks = twin.advance(block)
            hand_out(sinks, samples, ticks, silent + monitor.update(samples, ticks))
        samples, ticks = twin.flush()
        hand_out(sinks, samples, ticks, monitor.update(samples, ticks) + monitor.close())


def hand_out(
    sinks: Sequence[Sink], samples: Samples, ticks: Ticks, events: Sequence[Event]
) -> None:
    """Give every sink the same."""
    for sink in sinks:
        sink.write(samples, ticks, events)
