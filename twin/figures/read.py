"""The key figures of a recorded log, by the twin that recorded it."""

from collections.abc import Iterator, Mapping
from typing import Any

from twin.figures.cycle import CycleFigures, KeyFigures
from twin.figures.writer import Alarms
from twin.log.reader import Log
from twin.monitor.cycles import cut
from twin.signals import unbroken


def of_log(log: Log, key_figures: KeyFigures) -> Iterator[tuple[CycleFigures, Mapping[str, Any]]]:
    """Every cycle of a log with its key figures, and in the database's form with its alarms."""
    alarms = Alarms()
    alarms.see(log.events())
    for piece in cut(unbroken(log.blocks())):
        if (cycle := key_figures.take(piece)) is not None:
            yield cycle, {**cycle.plain(), "alarms": alarms.until(cycle.end_ns)}
