"""The loop: blocks in, twin, monitor, sinks out. All of the path is on this page."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from twin.events import Event
from twin.model import dense_solver as strides
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.dense_solver import DenseSolver
from twin.model.term import Term, Terms
from twin.model.theta import Theta
from twin.monitor.detector_window import knees_of
from twin.monitor.gaps import ShortGaps
from twin.monitor.monitor import Monitor, in_order
from twin.monitor.phase_detector import Found, Knees, PhaseFinder
from twin.monitor.rows import time_steps
from twin.monitor.staleness import Listening
from twin.monitor.surroundings import are_told, following, stretches
from twin.signals import SAMPLE, TICK, Phase, Samples, Ticks

REPLAYED = 60_000  # rows that a replay takes at once: what is done to many cycles stays in caches


class Sink(Protocol):
    """Whatever takes the result: a log, a view, an alarm output."""

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Take rows, their ticks, and what happened."""

    def close(self) -> None:
        """Finish; nothing comes after it."""


class EventEnricher(Protocol):
    """Whoever has more to say to what happens, once it has found out."""

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and what happened, without delay; give what has been found out by now.

        What it raised at may come once more.
        """

    def finish(self) -> list[Event]:
        """Give what is still to be said when the rows have ended; this may take a while."""

    def close(self) -> None:
        """Let go of everything; called in every case."""


@dataclass
class Twin:
    """The model beside the rig: what the sensor should read, a little behind the measurement."""

    theta: Theta
    knees: Knees
    terms: Sequence[Term] = ()
    _strides: DenseSolver = field(default_factory=DenseSolver)
    _last_ns: int | None = None
    _phase: int = Phase.IDLE  # of the newest row

    def __post_init__(self) -> None:
        self._finder = PhaseFinder(self.knees)
        self._around = self.theta  # with the surroundings as they are told
        self._terms = Terms(self.terms, float(self.theta[c.AMBIENT]))

    @classmethod
    def of(cls, data: DataSet) -> "Twin":
        """The twin of a data set."""
        return cls(coefficients(data), knees_of(data), data.terms)

    def advance(self, block: Samples) -> tuple[Samples, Ticks]:
        """Take a block; give the rows that are settled with what the twin says to them."""
        return self._expect(self._finder.push(block))

    def flush(self) -> tuple[Samples, Ticks]:
        """Give the rows still held back at the end of the stream."""
        return self._expect(self._finder.flush())

    def over(self, blocks: Iterable[Samples]) -> Iterator[tuple[Samples, Ticks]]:
        """Advance over a stream to its end, and over gaps of a few rows, which stay marked."""
        gaps = ShortGaps()
        for block in blocks:
            samples, ticks = self.advance(gaps.off(block))
            yield gaps.on(samples), ticks
        samples, ticks = self.flush()
        yield gaps.on(samples), ticks

    def _expect(self, found: Found) -> tuple[Samples, Ticks]:
        samples, phase, level = found
        ticks = np.empty(len(samples), TICK)
        ticks["phase"], ticks["level"] = phase, level
        expected = np.empty(len(samples))
        dt = time_steps(samples, self._last_ns)
        level, signals = ticks["level"].astype("f8"), np.empty(len(samples), "u1")
        for rows, telling in self._surrounded(samples, ticks):
            self._around = following(self._around, telling)
            driven, out = (dt[rows], phase[rows], level[rows]), (expected[rows], signals[rows])
            strides.advance(self._strides, self._around, *driven, *out)
        self._terms.add(phase, expected)
        ticks["expected"], ticks["signals"] = expected, signals
        if len(samples):
            self._last_ns, self._phase = int(samples["time_ns"][-1]), int(phase[-1])
        return samples, ticks

    def _surrounded(self, samples: Samples, ticks: Ticks) -> Iterable[tuple[slice, Samples]]:
        """Rows in one stretch of surroundings; nearly always nobody tells any."""
        if are_told(samples):
            return stretches(samples, ticks, self._phase)
        return [(slice(None), samples[:0])]


def compiled(data: DataSet) -> Twin:
    """A twin whose path is compiled: seconds where nothing is cached, not to fall into a block."""
    twin = Twin.of(data)
    twin.advance(np.zeros(3 * twin.knees.lag, SAMPLE))
    return Twin(twin.theta, twin.knees, twin.terms)


def run(
    source: Iterable[Samples],
    twin: Twin,
    monitor: Monitor,
    sinks: Sequence[Sink],
    listening: Listening | None = None,
    advisers: Sequence[EventEnricher] = (),
) -> None:
    """Take every block of ``source`` through twin and monitor to the sinks; close them at the end.

    A live source is timed by ``listening``. What ``advisers`` say goes to the sinks with what it
    follows.
    """
    timed = listening.over(source, monitor) if listening else ((block, []) for block in source)
    with ExitStack() as closing:
        for close in [sink.close for sink in sinks] + [adviser.close for adviser in advisers]:
            closing.callback(close)
        for samples, ticks, events in _watched(timed, twin, monitor):
            hand_out(sinks, samples, ticks, _advised(advisers, samples, events))
        none = np.empty(0, SAMPLE), np.empty(0, TICK)
        if last_words := _last_words(advisers, none[0]):
            hand_out(sinks, *none, last_words)


def _watched(
    timed: Iterable[tuple[Samples, Sequence[Event]]], twin: Twin, monitor: Monitor
) -> Iterator[tuple[Samples, Ticks, list[Event]]]:
    """All rows with what they make happen, in the order of time within each PLC time."""
    gaps = ShortGaps()
    for block, happened in timed:
        yield from _marked(gaps, monitor.over(*twin.advance(gaps.off(block)), happened))
    *parts, (samples, ticks, events) = _marked(gaps, monitor.over(*twin.flush()))
    yield from parts
    yield samples, ticks, in_order([*events, *monitor.close()])


def _marked(
    gaps: ShortGaps, parts: Iterable[tuple[Samples, Ticks, list[Event]]]
) -> Iterator[tuple[Samples, Ticks, list[Event]]]:
    """Rows with the marks of short gaps again, and with what there is to say of these."""
    for samples, ticks, events in parts:
        yield gaps.on(samples), ticks, in_order([*events, *gaps.told()])


def _advised(
    advisers: Sequence[EventEnricher], samples: Samples, events: list[Event]
) -> list[Event]:
    """What happened with what advisers say to it, in the order of time; each hears those before it.

    Rows and events are of one PLC time.
    """
    for adviser in advisers:
        events = in_order([*events, *adviser.follow(samples, events)])
    return events


def _last_words(advisers: Sequence[EventEnricher], none: Samples) -> list[Event]:
    """The same when the rows have ended."""
    said: list[Event] = []
    for adviser in advisers:
        said += (adviser.follow(none, said) if said else []) + adviser.finish()
    return said


def hand_out(
    sinks: Sequence[Sink], samples: Samples, ticks: Ticks, events: Sequence[Event]
) -> None:
    """Give every sink the same."""
    for sink in sinks:
        sink.write(samples, ticks, events)
