"""The key figures of a recorded log, as its own twin saw the rows."""

from collections.abc import Iterator, Mapping
from typing import Any

from twin.figures.cycle import CycleFigures, KeyFigures
from twin.figures.writer import Alarms
from twin.log.reader import Log
from twin.monitor.cycles import cut
from twin.signals import unbroken


def of_log(log: Log, key_figures: KeyFigures) -> Iterator[tuple[CycleFigures, Mapping[str, Any]]]:
    """Every cycle of a log with its key figures, and as a database keeps them, alarms included."""
    alarms = Alarms()
    alarms.see(log.events())
    for piece in cut(unbroken(log.blocks())):
        if (told := key_figures.take(piece)) is not None:
            yield told, {**told.plain(), "alarms": alarms.until(told.end_ns)}
