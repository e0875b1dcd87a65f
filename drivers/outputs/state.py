"""Results of a twin for readers: the newest row, the last cycle, and the ejector's health.

The loop leaves its newest results here and never waits; the server takes them from here.
"""

import math
import queue
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, IntEnum
from typing import Any

import numpy as np

from twin.events import Event, Kind
from twin.quality import UNUSABLE, Quality
from twin.signals import MBAR, Phase, Samples, Ticks, deviation

STALE_S = 1.0  # after that time without a row the newest is stale, whatever the reason
KEPT = 16  # events
MEANS = tuple(f"{phase.name.lower()}_mean" for phase in Phase)  # of the deviation in a cycle, mbar
SIDES = ("measured", "expected")


class Standing(IntEnum):
    """State of the ejector; the highest that applies is shown."""

    STARTING = 0  # nothing has come yet
    OK = 1
    DEVIATION = 2  # measurement and model have parted
    SIGNAL_BAD = 3  # the PLC's pressure is unusable
    PLC_STALE = 4
    STOPPED = 5  # the twin beside it has ended


class Status(Enum):
    """How far a value can be trusted."""

    GOOD = "good"
    NONE_YET = "none yet"
    LAST = "the last one, no longer fresh"
    BAD = "bad"
    BEYOND = "beyond what can be measured"
    MISSING = "this cycle does not tell"
    ENDED = "nobody is there to tell"


@dataclass(frozen=True)
class Reading:
    """A value, its PLC time (ns since 1970; 0 before the first), and its status."""

    value: Any
    time_ns: int
    status: Status = Status.GOOD


@dataclass(frozen=True)
class Health:
    """State of the ejector according to its events."""

    standing: Standing = Standing.STARTING
    since_ns: int = 0
    text: str = ""
    cause: str = ""
    size: float = math.nan
    unit: str = ""


@dataclass(frozen=True)
class Newest:
    """The newest row, and when it arrived."""

    sample: np.void
    tick: np.void
    deviation: float  # Pa
    came_s: float


class Results:
    """A sink that keeps the newest results of one ejector; ``figures`` names its key figures."""

    def __init__(
        self, asset: str, figures: Sequence[str], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.asset = asset
        self._figures = figures
        self._clock = clock
        # Each of these is replaced as a whole, since another thread reads them.
        self._newest: Newest | None = None
        self._cycle: Event | None = None
        self._events: tuple[Event, ...] = ()  # newest first
        self._standing: Mapping[Standing, Health] = {}
        self._healthy_since_ns = 0
        self._ended = False
        self._changes: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()

    # --- from the loop --------------------------------------------------------------------------

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Keep the last row, and the events."""
        for event in events:
            self._handle(event)
        if len(samples):
            deviation_pa = float(deviation(samples[-1:], ticks[-1:])[0])
            sample, tick = samples[-1].copy(), ticks[-1].copy()
            self._healthy_since_ns = self._healthy_since_ns or int(samples["time_ns"][0])
            self._newest = Newest(sample, tick, deviation_pa, self._clock())

    def resume(self, standing: Iterable[Mapping[str, Any]], now_ns: int) -> None:
        """Take over the alarms that stand when a run begins."""
        for alarm in standing:
            text = f"{alarm['alarm']}: {alarm['state'].replace('_', ' ')}"
            self._changes.put({**alarm, "host_ns": now_ns, "who": "", "text": text})

    def close(self) -> None:
        """End: no further rows come."""
        self._ended = True

    def _handle(self, event: Event) -> None:
        if event.kind in (Kind.ALARM, Kind.ALARM_CHANGED):
            self._handle_alarm(event)
        self._events = (event, *self._events)[:KEPT]
        if event.kind is Kind.CYCLE:
            self._cycle = event
        elif event.kind in RAISED:
            raised = _raised(RAISED[event.kind], event)
            self._standing = {**self._standing, raised.standing: raised}
        elif event.kind in CLEARED:
            cleared, self._healthy_since_ns = CLEARED[event.kind], event.time_ns
            self._standing = {
                standing: health
                for standing, health in self._standing.items()
                if standing is not cleared
            }
        elif event.kind is Kind.DIAGNOSIS and Standing.DEVIATION in self._standing:
            explained = _explained(self._standing[Standing.DEVIATION], event)
            self._standing = {**self._standing, Standing.DEVIATION: explained}

    def _handle_alarm(self, event: Event) -> None:
        """Queue an alarm's change; where it replaces another alarm, that one's too."""
        details = {"text": event.text, "who": event.data["who"], "host_ns": event.data["host_ns"]}
        if previous := event.data.get("left"):
            self._changes.put({**previous, **details})
        self._changes.put({**event.data, **details})

    # --- for the server -------------------------------------------------------------------------

    def changes(self) -> list[Mapping[str, Any]]:
        """Changes of alarms since the last call, in order: their new state, with text."""
        return [self._changes.get() for _ in range(self._changes.qsize())]

    @property
    def health(self) -> Health:
        """The gravest state that applies."""
        newest, standing = self._newest, self._standing
        if self._ended:
            at_ns = int(newest.sample["time_ns"]) if newest else 0
            return Health(Standing.STOPPED, at_ns, "the twin has stopped")
        if standing:
            return standing[max(standing)]
        if newest is None:
            return Health()
        return Health(Standing.OK, self._healthy_since_ns, "measurement and model agree")

    def readings(self) -> dict[str, Reading]:
        """Everything, by the name of its node; pressures in mbar."""
        return dict([*self._values(), *self._of_cycle(), *self._of_health(), *self._of_events()])

    def _values(self) -> Iterator[tuple[str, Reading]]:
        newest = self._newest
        if newest is None:
            names = ("Pressure", "Supply", "Expected", "Deviation")
            yield from ((name, Reading(math.nan, 0, Status.NONE_YET)) for name in names)
            yield "Phase", Reading(0, 0, Status.NONE_YET)
            return
        sample, tick, at_ns = newest.sample, newest.tick, int(newest.sample["time_ns"])
        freshness = self._freshness(newest)
        measured = _measured_status(freshness, int(sample["quality"]))
        expected = freshness if np.isfinite(tick["expected"]) else Status.NONE_YET
        deviation_status = measured if expected is freshness else expected
        supply = freshness if np.isfinite(sample["supply"]) else Status.BAD
        yield "Pressure", Reading(float(sample["pressure"]) / MBAR, at_ns, measured)
        yield "Supply", Reading(float(sample["supply"]) / MBAR, at_ns, supply)
        yield "Expected", Reading(float(tick["expected"]) / MBAR, at_ns, expected)
        yield "Deviation", Reading(newest.deviation / MBAR, at_ns, deviation_status)
        yield "Phase", Reading(int(tick["phase"]), at_ns, freshness)

    def _freshness(self, newest: Newest) -> Status:
        if self._ended:
            return Status.ENDED
        stale = Standing.PLC_STALE in self._standing
        return Status.LAST if stale or self._clock() - newest.came_s > STALE_S else Status.GOOD

    def _of_cycle(self) -> Iterator[tuple[str, Reading]]:
        cycle = self._cycle
        names = [f"{name}_{side}" for name in self._figures for side in SIDES]
        for name in ("cycle", *MEANS, *names):
            if cycle is None:
                yield name, Reading(-1 if name == "cycle" else math.nan, 0, Status.NONE_YET)
                continue
            value = cycle.data.get(name, cycle.data.get(name.removesuffix("_measured")))
            is_number = isinstance(value, int | float) and math.isfinite(value)
            status = Status.GOOD if is_number else Status.MISSING
            yield name, Reading(value if is_number else math.nan, cycle.time_ns, status)

    def _of_health(self) -> Iterator[tuple[str, Reading]]:
        health = self.health
        values = {
            "State": int(health.standing),
            "Since": health.since_ns,
            "Text": health.text,
            "Cause": health.cause,
            "Size": health.size,
            "Unit": health.unit,
        }
        yield from ((name, Reading(value, health.since_ns)) for name, value in values.items())

    def _of_events(self) -> Iterator[tuple[str, Reading]]:
        events = self._events
        at_ns = events[0].time_ns if events else 0
        columns: dict[str, list[Any]] = {
            "Times": [event.time_ns for event in events],
            "Kinds": [str(event.kind) for event in events],
            "Severities": [str(event.severity) for event in events],
            "Texts": [event.text for event in events],
        }
        yield from ((name, Reading(column, at_ns)) for name, column in columns.items())


RAISED = {
    Kind.DEVIATION: Standing.DEVIATION,
    Kind.SIGNAL_BAD: Standing.SIGNAL_BAD,
    Kind.PLC_STALE: Standing.PLC_STALE,
}
CLEARED = {
    Kind.DEVIATION_CLEARED: Standing.DEVIATION,
    Kind.SIGNAL_GOOD: Standing.SIGNAL_BAD,
    Kind.PLC_BACK: Standing.PLC_STALE,
}


def _raised(standing: Standing, event: Event) -> Health:
    health = Health(standing, event.time_ns, event.text)
    if standing is not Standing.DEVIATION:
        return health
    data = event.data
    return replace(
        health,
        cause=str(data.get("effect", "")),
        size=float(data.get("size", math.nan)),
        unit=str(data.get("unit", "")),
    )


def _explained(health: Health, event: Event) -> Health:
    """The same with the first cause of a diagnosis, if it found one."""
    causes = event.data.get("answer", {}).get("causes", ())
    if not causes:
        return replace(health, text=event.text)
    first, begin_ns = causes[0], event.data["begin_ns"]
    size: Mapping[str, Any] = next(iter(first["parameters"].values()), {})
    onset_s = first.get("onset_s")
    return replace(
        health,
        text=event.text,
        cause=first["effect"],
        size=float(size.get("value", math.nan)),
        unit=str(size.get("unit", "")),
        since_ns=health.since_ns if onset_s is None else begin_ns + round(onset_s * 1e9),
    )


def _measured_status(freshness: Status, quality: int) -> Status:
    """Status of a measured value with these Quality bits."""
    if freshness is not Status.GOOD:
        return freshness
    if quality & Quality.OVERFLOW:
        return Status.BEYOND
    if quality & Quality.STALE:
        return Status.LAST
    return Status.BAD if quality & UNUSABLE else Status.GOOD
