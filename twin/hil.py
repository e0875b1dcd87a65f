"""Hardware in the loop: the model is the plant that a real PLC commands.

The model runs free: its own air saving switches the nozzle, and no measurement synchronises it. It
runs in step with PLC time, row by row with the PLC's commands.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from twin.model import kernel
from twin.model import theta as c
from twin.model.term import Term, Terms
from twin.model.theta import Theta
from twin.monitor.rows import elapsed
from twin.quality import BREAK
from twin.signals import Samples, Signal

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

PRESENT, SAVING = Signal.PART_PRESENT, Signal.AIR_SAVING
LONGEST_GAP_S = 0.1  # without commands; after a longer gap the model restarts at ambient

Outputs = Callable[[float, bool, bool], None]  # pressure (Pa), part present (H2), air saving (H1)


@dataclass
class Plant:
    """The model in place of the ejector and its system."""

    theta: Theta
    terms: Sequence[Term] = ()
    _last_ns: int | None = None
    _state: kernel.State = field(init=False)

    def __post_init__(self) -> None:
        self._terms = Terms(self.terms, float(self.theta[c.AMBIENT]))
        self._begin()

    def _begin(self) -> None:
        """Start at ambient without commands."""
        self._state, self._control = kernel.at_rest(self.theta), kernel.Control.anew()

    def run(self, block: Samples) -> tuple[Floats, Bytes]:
        """Pressures (Pa, absolute, as the PLC's sensor reads them) and ``Signal`` bits, per row."""
        dt = elapsed(block, self._last_ns)
        broken = (block["quality"] & BREAK) != 0
        is_restart = broken & ((dt < 0.0) | (dt > LONGEST_GAP_S))
        dt[is_restart] = 0.0
        expected, signals = np.empty(len(block)), np.empty(len(block), np.uint8)
        for rows in np.split(np.arange(len(block)), np.flatnonzero(is_restart)):
            if len(rows) and is_restart[rows[0]]:
                self._begin()
            expected[rows], signals[rows] = self._advance(dt[rows], block["commands"][rows])
        self._last_ns = int(block["time_ns"][-1]) if len(block) else self._last_ns
        return expected, signals

    def _advance(self, dt: Floats, commands: Bytes) -> tuple[Floats, Bytes]:
        """Advance over rows that continue from the last ones."""
        expected, phase = np.empty(len(dt)), np.empty(len(dt), np.uint8)
        signals = np.empty(len(dt), np.uint8)
        out = phase, expected, signals
        kernel.run_on(self._state, self._control, self.theta, dt, commands, out)
        self._terms.add(phase, expected)
        return expected, signals


def in_place(source: Iterable[Samples], plant: Plant, outputs: Outputs) -> Iterator[Samples]:
    """The blocks of ``source`` with the model's pressure in place of the PLC's reading.

    The newest row of each block goes to ``outputs`` before the block is yielded. Closes the source.
    """
    blocks = iter(source)
    try:
        for block in blocks:
            yield _with_model_pressure(block, plant, outputs) if len(block) else block
    finally:
        if hasattr(blocks, "close"):
            blocks.close()  # pyright: ignore[reportAttributeAccessIssue] - a generator has it


def _with_model_pressure(block: Samples, plant: Plant, outputs: Outputs) -> Samples:
    """The rows of a block with the model's pressure."""
    pressure, signals = plant.run(block)
    newest = Signal(int(signals[-1]))
    outputs(float(pressure[-1]), PRESENT in newest, SAVING in newest)
    rows = block.copy()
    rows["pressure"] = pressure
    rows["quality"] &= np.uint8(BREAK)  # the other bits are about the PLC's reading
    return rows
