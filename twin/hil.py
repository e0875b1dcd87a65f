"""Hardware in the loop: the model is the plant of a real PLC, which commands it and is answered.

The model runs free: its own air saving switches the nozzle, nothing is synchronised on a
measurement. It runs in step with PLC time, row for row of what the PLC commanded.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model import theta as c
from twin.model.term import Term, Terms
from twin.model.theta import Theta
from twin.signals import BREAK, NS, Samples, Signal

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

PRESENT, SAVING = Signal.PART_PRESENT, Signal.AIR_SAVING
LONGEST_GAP_S = 0.1  # without commands; after a longer one the model begins anew at ambient

Outputs = Callable[[float, bool, bool], None]  # pressure (Pa), part present (H2), air saving (H1)


@dataclass
class Plant:
    """The model in place of the ejector and all that hangs on it."""

    theta: Theta
    terms: Sequence[Term] = ()
    _last_ns: int | None = None
    _state: kernel.State = field(init=False)

    def __post_init__(self) -> None:
        self._terms = Terms(self.terms, float(self.theta[c.AMBIENT]))
        self._begin()

    def _begin(self) -> None:
        """Stand at ambient, nothing commanded."""
        self._state, self._control = kernel.at_rest(self.theta), kernel.Control.anew()

    def run(self, block: Samples) -> tuple[Floats, Bytes]:
        """Pressures (Pa, absolute, as the PLC's sensor reads them) and ``Signal`` bits, per row."""
        before = block["time_ns"][:1] if self._last_ns is None else self._last_ns
        dt = np.diff(block["time_ns"], prepend=before) * NS
        broken = (block["quality"] & BREAK) != 0
        anew = broken & ((dt < 0.0) | (dt > LONGEST_GAP_S))
        dt[anew] = 0.0
        expected, signals = np.empty(len(block)), np.empty(len(block), np.uint8)
        for rows in np.split(np.arange(len(block)), np.flatnonzero(anew)):
            if len(rows) and anew[rows[0]]:
                self._begin()
            expected[rows], signals[rows] = self._stretch(dt[rows], block["commands"][rows])
        self._last_ns = int(block["time_ns"][-1]) if len(block) else self._last_ns
        return expected, signals

    def _stretch(self, dt: Floats, commands: Bytes) -> tuple[Floats, Bytes]:
        """Rows that go on from the last ones."""
        expected, phase = np.empty(len(dt)), np.empty(len(dt), np.uint8)
        signals = np.empty(len(dt), np.uint8)
        out = phase, expected, signals
        kernel.run_on(self._state, self._control, self.theta, dt, commands, out)
        self._terms.add(phase, expected)
        return expected, signals


def in_place(source: Iterable[Samples], plant: Plant, outputs: Outputs) -> Iterator[Samples]:
    """The blocks of ``source`` with the model's pressure in place of what the PLC read.

    The newest of each goes to ``outputs`` before the block goes on. Closes the source.
    """
    blocks = iter(source)
    try:
        for block in blocks:
            yield _answered(block, plant, outputs) if len(block) else block
    finally:
        if hasattr(blocks, "close"):
            blocks.close()


def _answered(block: Samples, plant: Plant, outputs: Outputs) -> Samples:
    """Its rows as they are with the model's pressure."""
    pressure, signals = plant.run(block)
    newest = Signal(int(signals[-1]))
    outputs(float(pressure[-1]), PRESENT in newest, SAVING in newest)
    rows = block.copy()
    rows["pressure"] = pressure
    rows["quality"] &= np.uint8(BREAK)  # the rest is about what the PLC has read
    return rows
