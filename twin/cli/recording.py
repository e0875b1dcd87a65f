"""Cycles of a commissioning, recorded from the PLC into a log before anything is fitted."""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from twin.cli.console import complain, status
from twin.cli.stopping import closed, leave, stop_on_signal, until

if TYPE_CHECKING:
    from twin.config import Config
    from twin.signals import Samples

FEWEST_CYCLES = 5  # that a commissioning needs (twin.calibration.calibrate.FEWEST)
PATIENCE_S = 60.0  # without suction, after which the tag is worth a look. Chosen
NO_SUCTION = (
    f"no suction for {PATIENCE_S:.0f} s: let the machine work, or check [driver.tags.suction]"
    " (twin probe CONFIG shows its value)"
)


def log_beside(config: Path, unit: str) -> Path:
    """A new log beside a configuration, named by the unit and the present time."""
    name = re.sub(r"[^\w.-]", "_", unit)
    return config.parent / time.strftime(f"{name}_%Y%m%dT%H%M%SZ.mcap", time.gmtime())


def record_cycles(settings: "Config", cycles: int, log: Path) -> None:
    """Record so many cycles of a unit from its PLC into a new log, which stays in every case.

    SourceError if the PLC does not answer, or if the log cannot be written. The command ends if it
    is interrupted.
    """
    from drivers.sources import open_source
    from twin.live import dispatch_unmodelled
    from twin.log.recorder import Recorder

    source = open_source(settings.document)
    with closed(source), stop_on_signal(None) as stopped, status() as say:
        blocks = enough(until(stopped, source), cycles, say)
        first = next(blocks, None)
        if first is not None:  # a PLC that does not answer leaves no empty log
            complain(f"recording in {log}, which is kept")
            with Recorder(log, settings.log_header()) as recorder:
                dispatch_unmodelled([recorder], [first], "")
                dispatch_unmodelled([recorder], blocks, "")
    leave(interrupted=stopped() == "interrupted")


def enough(
    source: "Iterator[Samples]",
    cycles: int,
    say: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
) -> "Iterator[Samples]":
    """The blocks until so many cycles have ended after the first, which may be partial.

    Once the ``clock`` (s) has seen no suction for PATIENCE_S, the command says what to check.
    """
    from twin.signals import Command

    begun, before, seen, told = 0, True, clock(), False
    for block in source:
        on = (block["commands"] & Command.SUCTION) != 0
        for row in on.tolist():
            begun, before = begun + (row and not before), row
        if on.any():
            seen, told = clock(), False
        elif not told and clock() - seen > PATIENCE_S:
            told = True
            complain(NO_SUCTION)
        say(f"recording: suction {min(begun, cycles + 2)} of {cycles + 2}")
        yield block
        if begun > cycles + 1:
            return
