"""The PLC as a partner of hardware in the loop: no rig behind it, the twin answers its commands.

Its program waits for part present as a real one would, and supervises the twin. If the watchdog
stands still for too long, it drops its commands and reports that until the watchdog counts again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from drivers.plc.faults import Fault
from drivers.plc.plant import TRUTH, Record
from drivers.plc.scan import SCAN, Scans, Task
from drivers.plc.settings import PlcSettings, Program
from twin.signals import BAR, MBAR, Command

TRIPPED = 0x200  # bit of the status word: the watchdog stood still, all commands are dropped
NO_PART = 0x400  # part present did not come in time: the program gave up this pick
PATIENCE = 500  # scans without the watchdog counting
LONGEST_PICK = 5000  # scans until part present


@dataclass
class Written:
    """Values that the twin writes."""

    pressure: float  # mbar, absolute
    part_present: int = 0
    air_saving: int = 0
    watchdog: int = 0


class PartnerTask(Task):
    """A task whose pressure is written by a client."""

    def __init__(self, settings: PlcSettings, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        super().__init__(settings, faults, seed)
        self.written = Written(settings.rig.ambient_mbar)
        self._supply = round(settings.ejector.supply_bar * BAR / MBAR)
        self._steps = Steps(settings.program, self.written)

    def compute(self, n: int) -> tuple[Scans, Record]:
        """Scans with the values written so far; no rig and no truth are behind them."""
        scans = np.zeros(n, SCAN)
        scans["sequence"] = self.newest + 1 + np.arange(n)
        scans["ambient"] = np.rint(self.settings.rig.ambient_mbar * 10)
        scans["pressure"], scans["supply"] = self.written.pressure, self._supply
        scans["status"] = [next(self._steps) for _ in range(n)]
        self.newest += n
        self.commands = Command(int(scans["status"][-1]) & 3)
        return scans, np.zeros(n, TRUTH)


@dataclass
class Steps:
    """The program, scan by scan: an iterator over status words."""

    program: Program
    written: Written
    _last_watchdog: int = 0  # of the watchdog
    _still_scans: int = PATIENCE  # scans since it counted
    _step: Iterator[int] = field(init=False)

    def __post_init__(self) -> None:
        self._step = self._cycles()

    def __iter__(self) -> Iterator[int]:
        return self

    def __next__(self) -> int:
        self._still_scans = (
            0 if self.written.watchdog != self._last_watchdog else self._still_scans + 1
        )
        self._last_watchdog = self.written.watchdog
        if self._still_scans >= PATIENCE:
            self._step = self._cycles()
            return TRIPPED
        return next(self._step)

    def _cycles(self) -> Iterator[int]:
        """One pick after the other, from idle on."""
        program, flags = self.program, 0
        yield from [0] * round(program.start_ms)
        while True:
            waited = 0
            while not self.written.part_present and waited < LONGEST_PICK:
                waited += 1
                yield Command.SUCTION | flags
            flags = 0 if self.written.part_present else NO_PART
            yield from [Command.SUCTION | flags] * round(program.suction_ms)
            yield from [Command.BLOW_OFF | flags] * round(program.blow_off_ms)
            yield from [flags] * max(round(program.idle_ms), 1)
