"""The live loop: blocks pass through twin and monitor to the sinks. This module has all of it."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from twin.events import Event, Kind
from twin.model import dense_solver
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.dense_solver import DenseSolver
from twin.model.term import Term, Terms
from twin.model.theta import Theta
from twin.monitor.detector_window import detector_of
from twin.monitor.gaps import ShortGaps
from twin.monitor.monitor import Monitor, in_order
from twin.monitor.rows import TimeSteps
from twin.monitor.staleness import Listening
from twin.monitor.surroundings import Surroundings
from twin.monitor.switching_detector import DetectorSettings, Found, PhaseFinder
from twin.signals import SAMPLE, TICK, Command, Phase, Samples, Ticks

REPLAYED = 60_000  # rows that a replay takes at once: work on many cycles uses the caches well


class Sink(Protocol):
    """A consumer of the results: a log, a view, an alarm output."""

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Take rows, their ticks, and events."""

    def close(self) -> None:
        """Finish; it is the last call."""


class EventEnricher(Protocol):
    """A source of further events, such as a diagnosis, which may come later."""

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and events without delay; returns the new events by now.

        After an exception the same rows may come again.
        """
        ...

    def finish(self) -> list[Event]:
        """Return the remaining events after the last row; this may take a while."""
        ...

    def close(self) -> None:
        """Release all resources; always called."""


@dataclass
class Twin:
    """The model that runs beside the rig; it expects the sensor's reading with a short delay.

    ``nozzle`` is what a whole log shows of it, as for ``PhaseFinder``. ``idle``: it follows the
    weather by an opened idle, as ``Surroundings``.
    """

    theta: Theta
    detector: DetectorSettings
    terms: Sequence[Term] = ()
    nozzle: npt.NDArray[np.uint8] | None = None
    idle: bool = False
    _solver: DenseSolver = field(default_factory=DenseSolver)
    _steps: TimeSteps = field(default_factory=TimeSteps)

    def __post_init__(self) -> None:
        self._finder = PhaseFinder(self.detector, self.nozzle)
        self._surroundings = Surroundings(self.theta, idle=self.idle)
        self._terms = Terms(self.terms, float(self.theta[c.AMBIENT]))

    @classmethod
    def of(cls, data: DataSet) -> "Twin":
        """The twin of a data set."""
        return cls(coefficients(data), detector_of(data), data.terms, idle=True)

    def advance(self, block: Samples) -> tuple[Samples, Ticks]:
        """Take a block; returns the settled rows with their ticks."""
        return self._expect(self._finder.push(block))

    def flush(self) -> tuple[Samples, Ticks]:
        """Return the rows still held back at the end of the stream."""
        return self._expect(self._finder.flush())

    def over(self, blocks: Iterable[Samples]) -> Iterator[tuple[Samples, Ticks]]:
        """Advance over a stream to its end, and over gaps of a few rows, which stay marked."""
        gaps = ShortGaps()
        for block in blocks:
            samples, ticks = self.advance(gaps.off(block))
            yield gaps.on(samples), ticks
        samples, ticks = self.flush()
        yield gaps.on(samples), ticks

    def _expect(self, phases: Found) -> tuple[Samples, Ticks]:
        samples, phase, level = phases
        ticks = np.empty(len(samples), TICK)
        ticks["phase"], ticks["level"] = phase, level
        expected = np.empty(len(samples))
        dt = self._steps.over(samples)
        level, signals = ticks["level"].astype("f8"), np.empty(len(samples), "u1")
        for rows, theta in self._surroundings.over(samples, ticks):
            inputs, outputs = (dt[rows], phase[rows], level[rows]), (expected[rows], signals[rows])
            dense_solver.advance(self._solver, theta, *inputs, *outputs)
        self._terms.add(phase, expected)
        ticks["expected"], ticks["signals"] = expected, signals
        return samples, ticks


def compiled(data: DataSet) -> Twin:
    """A twin with compiled code: without a cache compiling takes seconds, so it is done first."""
    twin = Twin.of(data)
    twin.advance(np.zeros(3 * twin.detector.lag, SAMPLE))
    return Twin(twin.theta, twin.detector, twin.terms, idle=twin.idle)


def run(
    source: Iterable[Samples],
    twin: Twin,
    monitor: Monitor,
    sinks: Sequence[Sink],
    listening: Listening | None = None,
    advisers: Sequence[EventEnricher] = (),
) -> None:
    """Take every block of ``source`` through twin and monitor to the sinks; close them at the end.

    ``listening`` times a live source. Events of ``advisers`` go to the sinks with the rows that
    they follow.
    """
    stream = listening.over(source, monitor) if listening else ((block, []) for block in source)
    with closing_all(sinks, advisers):
        for samples, ticks, events in _monitored(stream, twin, monitor):
            dispatch(sinks, samples, ticks, _enriched(advisers, samples, events))
        no_rows = np.empty(0, SAMPLE), np.empty(0, TICK)
        if final_events := _final_events(advisers, no_rows[0]):
            dispatch(sinks, *no_rows, final_events)


@contextmanager
def closing_all(sinks: Sequence[Sink], advisers: Sequence[EventEnricher]) -> Iterator[None]:
    """Close all of them at the end, also where one fails."""
    with ExitStack() as closing:
        for close in [sink.close for sink in sinks] + [adviser.close for adviser in advisers]:
            closing.callback(close)
        yield


def dispatch_unmodelled(sinks: Sequence[Sink], blocks: Iterable[Samples], why: str) -> int:
    """Give the sinks rows that the model has not seen; returns how many.

    Their expected pressure is NaN, and with ``why`` an event goes with the first of them. Empty
    blocks go to the sinks too: a log writes what it holds while no rows come.
    """
    count = 0
    for samples in blocks:
        is_first = len(samples) > 0 and not count
        events = [Event(int(samples["time_ns"][0]), Kind.NO_MODEL, why)] if why and is_first else []
        dispatch(sinks, samples, _unmodelled(samples), events)
        count += len(samples)
    return count


def _unmodelled(samples: Samples) -> Ticks:
    """Ticks without a model: nothing is expected, and phases are as commanded."""
    ticks = np.zeros(len(samples), TICK)
    ticks["expected"] = ticks["level"] = np.nan
    blow_off, suction = (
        samples["commands"] & np.uint8(bit) != 0 for bit in (Command.BLOW_OFF, Command.SUCTION)
    )
    ticks["phase"] = np.where(
        blow_off, Phase.BLOW_OFF, np.where(suction, Phase.SUCTION, Phase.IDLE)
    )
    return ticks


def _monitored(
    stream: Iterable[tuple[Samples, Sequence[Event]]], twin: Twin, monitor: Monitor
) -> Iterator[tuple[Samples, Ticks, list[Event]]]:
    """All rows with their events, ordered by time within each PLC time."""
    gaps = ShortGaps()
    for block, source_events in stream:
        yield from _with_gap_marks(
            gaps, monitor.over(*twin.advance(gaps.off(block)), source_events)
        )
    *parts, (samples, ticks, events) = _with_gap_marks(gaps, monitor.over(*twin.flush()))
    yield from parts
    yield samples, ticks, in_order([*events, *monitor.close()])


def _with_gap_marks(
    gaps: ShortGaps, parts: Iterable[tuple[Samples, Ticks, list[Event]]]
) -> Iterator[tuple[Samples, Ticks, list[Event]]]:
    """Rows with the marks of short gaps restored, and with events about these gaps."""
    for samples, ticks, events in parts:
        yield gaps.on(samples), ticks, in_order([*events, *gaps.told()])


def _enriched(
    advisers: Sequence[EventEnricher], samples: Samples, events: list[Event]
) -> list[Event]:
    """Events with those of the advisers, ordered by time; each adviser gets those before it.

    Rows and events are of one PLC time.
    """
    for adviser in advisers:
        events = in_order([*events, *adviser.follow(samples, events)])
    return events


def _final_events(advisers: Sequence[EventEnricher], no_rows: Samples) -> list[Event]:
    """The advisers' events after the last row."""
    events: list[Event] = []
    for adviser in advisers:
        events += (adviser.follow(no_rows, events) if events else []) + adviser.finish()
    return events


def dispatch(
    sinks: Sequence[Sink], samples: Samples, ticks: Ticks, events: Sequence[Event]
) -> None:
    """Write rows and events to every sink."""
    for sink in sinks:
        sink.write(samples, ticks, events)
