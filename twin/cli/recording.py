"""Cycles of a commissioning, recorded from the PLC into a log before anything is fitted."""

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from twin.cli.console import complain, status
from twin.cli.stopping import closed, leave, stop_on_signal, until
from twin.errors import SourceError
from twin.files import refuse_existing, require_writable

if TYPE_CHECKING:
    from twin.config import Config
    from twin.signals import Samples

FEWEST_CYCLES = 5  # that a commissioning needs (twin.calibration.record_checks.FEWEST)
PATIENCE_S = 60.0  # without suction, after which the tag is worth a look. Chosen
LONGEST_SUCTION_S = 300.0  # likewise for one that does not end; cycles may take minutes. Chosen
SILENCE_S = 10.0  # without a row: a driver connects again within 2 s if the PLC answers. Chosen
NO_SUCTION = (
    f"no suction for {PATIENCE_S:.0f} s: let the machine work, or check [driver.tags.suction]"
    " (twin probe CONFIG shows its value)"
)
NO_END = (
    f"suction is on for {LONGEST_SUCTION_S:.0f} s without an end: let the machine work, or check"
    " [driver.tags.suction] (twin probe CONFIG shows its value)"
)
NO_ROWS = (
    f"no rows from the PLC for {SILENCE_S:.0f} s: check that it runs, and its network; the"
    " recording goes on as soon as rows come"
)


@dataclass
class _Wait:
    """A wait with a ``complaint``, made once when it becomes longer than ``patience_s``."""

    patience_s: float
    complaint: str
    waited_s: float = 0.0
    told: bool = False

    def go_on(self, seconds: float) -> None:
        """Wait so much longer."""
        self.waited_s += seconds
        if self.waited_s > self.patience_s and not self.told:
            self.told = True
            complain(self.complaint)

    def end(self) -> None:
        """End the wait: the next one begins."""
        self.waited_s, self.told = 0.0, False


class _Waits:
    """The waits of a recording: for rows, for suction, and for the end of suction."""

    def __init__(self) -> None:
        self._rows = _Wait(SILENCE_S, NO_ROWS)
        self._suction = _Wait(PATIENCE_S, NO_SUCTION)
        self._end = _Wait(LONGEST_SUCTION_S, NO_END)

    def over(self, rows: int, *, on: bool, begins: bool, seconds: float) -> None:
        """Take a number of rows, which came after ``seconds``.

        ``on``: suction is on in some of them; ``begins``: it begins in them. The time in which a
        PLC is away counts for neither: nothing is known of its suction.
        """
        if not rows:
            self._rows.go_on(seconds)
            return
        seconds = 0.0 if self._rows.told else seconds + self._rows.waited_s
        self._rows.end()
        if on:
            self._suction.end()
        else:
            self._suction.go_on(seconds)
        if begins:
            self._end.end()
        elif on:
            self._end.go_on(seconds)


def log_beside(config: Path, unit: str) -> Path:
    """A new log beside a configuration, named by the unit and the present time."""
    name = re.sub(r"[^\w.-]", "_", unit)
    return config.parent / time.strftime(f"{name}_%Y%m%dT%H%M%SZ.mcap", time.gmtime())


def new_log(chosen: Path | None, config: Path, unit: str) -> Path:
    """The ``chosen`` log, or else one beside the configuration.

    SourceError if it exists, or cannot be written.
    """
    log = chosen or log_beside(config, unit)
    try:
        require_writable(log)
    except SourceError as error:
        if chosen is None:
            raise SourceError(str(error), "give the log another folder with --log FILE") from error
        raise
    refuse_existing(log, hint="a log is never overwritten: choose another name with --log FILE")
    return log


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

    The command says what to check if by the ``clock`` (s) no rows or no suction come, or if suction
    does not end.
    """
    import numpy as np

    from twin.signals import Command

    begun, before, seen, waits = 0, True, clock(), _Waits()
    for block in source:
        on = (block["commands"] & Command.SUCTION) != 0
        course = np.concatenate(([before], on))
        begins = int(np.count_nonzero(course[1:] & ~course[:-1]))
        begun, before = begun + begins, bool(course[-1])
        now = clock()
        waits.over(len(on), on=bool(on.any()), begins=begins > 0, seconds=now - seen)
        seen = now
        say(f"recording: suction {min(begun, cycles + 2)} of {cycles + 2}")
        yield block
        if begun > cycles + 1:
            return
