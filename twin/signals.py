"""The data types of the loop: samples, ticks, and units at the edges.

Data flows in blocks: structured arrays of ``SAMPLE`` (the measurement) with row-aligned ``TICK``
(the twin's results). A live block has 10 to 100 rows, a replayed one thousands.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Literal

import numpy as np
import numpy.typing as npt

from twin.quality import NEW_TIME, UNUSABLE, Quality

# Units at the edges. Inside everything is SI and pressures are absolute.
MBAR = 100.0  # Pa
BAR = 1e5  # Pa
MS = 1e-3  # s
NS = 1e-9  # s
ZERO_C = 273.15  # K
ML = 1e-6  # m³
STANDARD_DENSITY = 1.185  # kg/m³ at 100 kPa, 20 °C, 65 % relative humidity (ISO 8778)
SL_MIN = STANDARD_DENSITY * 1e-3 / 60.0  # kg/s in one standard litre per minute

Unit = Literal["mbar", "hPa", "bar", "kPa", "Pa", "psi", "inHg", "torr"]
Reference = Literal["absolute", "gauge", "vacuum"]  # vacuum: positive below ambient
PASCAL: dict[Unit, float] = {  # in one unit of pressure
    "mbar": MBAR,
    "hPa": 100.0,
    "bar": BAR,
    "kPa": 1000.0,
    "Pa": 1.0,
    "psi": 6894.757293168,
    "inHg": 3386.388640341,  # at 0 °C, NIST SP 811, B.9
    "torr": 101_325.0 / 760.0,
}


def counted_from(
    pascal: npt.NDArray[np.float64],
    reference: Reference,
    onto: Reference,
    ambient: float | npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Convert pressures from one reference to another; ambient cancels exactly."""
    zero: dict[Reference, float | npt.NDArray[np.float64]]
    zero = {"absolute": 0.0, "gauge": ambient, "vacuum": ambient}
    sign = {"absolute": 1.0, "gauge": 1.0, "vacuum": -1.0}
    return sign[onto] * (sign[reference] * pascal + (zero[reference] - zero[onto]))


SAMPLE = np.dtype(
    [
        ("sequence", "<i8"),  # the PLC's scan counter; a missing number is a missing sample
        ("time_ns", "<i8"),  # PLC time; if the PLC has none, host time of the poll
        ("host_ns", "<i8"),  # host time of receipt
        ("pressure", "<f4"),  # Pa, absolute, as read; NaN if unreadable
        ("supply", "<f4"),  # Pa, gauge, as read; NaN if not measured
        ("commands", "u1"),  # Command bits
        ("quality", "u1"),  # Quality bits
        # Optional measurements of the ejector and its surroundings; all zero without them. No real
        # pressure or temperature here is 0; a flow is measured if Reported says so.
        ("reported", "u1"),  # Reported bits
        ("ambient", "<f4"),  # Pa, absolute, of a barometer
        ("temperature", "<f4"),  # K, of the gas or the surroundings
        ("pressure_2", "<f4"),  # Pa, absolute, of a second sensor
        ("flow", "<f4"),  # kg/s, suction flow
    ]
)
EXTRA = ("reported", "ambient", "temperature", "pressure_2", "flow")  # optional fields of these

TICK = np.dtype(
    [
        ("expected", "<f4"),  # Pa, absolute, what the sensor should read; NaN before the first sync
        ("level", "<f4"),  # Pa, the pressure that synchronised the model at this row; mostly NaN
        ("phase", "u1"),  # Phase
        ("signals", "u1"),  # Signal bits of the model
    ]
)

Samples = npt.NDArray[np.void]  # of SAMPLE
Ticks = npt.NDArray[np.void]  # of TICK


def joined(*blocks: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """All rows in one array, like ``np.concatenate`` of arrays of one dtype.

    A single block is returned uncopied. Rows are copied whole; NumPy copies them field by field,
    which takes ten times as long.
    """
    if len(blocks) == 1:
        return blocks[0]
    dtype = blocks[0].dtype
    row_type = np.dtype((np.void, dtype.itemsize))
    return np.concatenate([np.ascontiguousarray(block).view(row_type) for block in blocks]).view(
        dtype
    )


class Command(IntFlag):
    """The PLC's commands."""

    SUCTION = 1
    BLOW_OFF = 2


class Signal(IntFlag):
    """The switching signals of a compact ejector; the model has them too."""

    PART_PRESENT = 1  # H2
    AIR_SAVING = 2  # H1


class Reported(IntFlag):
    """States that an ejector reports, and which of them a row has."""

    NOZZLE_KNOWN = 1
    NOZZLE = 2  # it is on
    PART_KNOWN = 4
    PART = 8  # part present: H2 is reached
    FLOW_KNOWN = 16


MOST_BRIDGED = 3  # consecutive missing rows that the model steps over


def unseen_ns(before: Samples | np.void, after: Samples | np.void) -> npt.NDArray[np.int64]:
    """Time (ns) that passed unseen between rows before and after a gap.

    PLC time counts if it runs on; after a restart or a clock jump, the times of receipt count.
    """
    runs_on = (after["quality"] & NEW_TIME) == 0
    by_plc, by_receipt = (after[name] - before[name] for name in ("time_ns", "host_ns"))
    passed: npt.NDArray[np.int64] = np.maximum(np.where(runs_on, by_plc, by_receipt), 0)
    return passed


@dataclass
class LastRow:
    """The newest row of a stream, kept over its blocks."""

    row: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))  # none before the first

    def keep(self, samples: Samples) -> Samples:
        """Keep a copy of the newest of ``samples``, if any; returns the row before them."""
        before = self.row
        if len(samples):
            self.row = samples[-1:].copy()
        return before


@dataclass
class Bridge:
    """Removes the marks of gaps of a few rows from blocks: the model steps over them.

    A command that changes in such a gap counts as changing at its end. Longer gaps keep their mark,
    since nobody knows what happened; so do gaps whose length the sequence numbers do not tell.
    """

    _last: LastRow = field(default_factory=LastRow)

    def over(self, block: Samples) -> Samples:
        """The block unchanged, or a copy without these marks."""
        previous = self._last.keep(block)
        if not (block["quality"] & np.uint8(Quality.GAP)).any():
            return block
        rows = np.concatenate([previous, block])
        missing = np.diff(rows["sequence"]) - 1
        short = (missing > 0) & (missing <= MOST_BRIDGED) & (rows["quality"][1:] & NEW_TIME == 0)
        rows["quality"][1:][short] &= np.uint8(~np.uint8(Quality.GAP))
        return rows[len(previous) :]


def sampling_ms(samples: Samples) -> float:
    """The median time between rows in whole milliseconds; at least one, as for the model."""
    if len(samples) < 2:
        return 1.0
    return max(round(float(np.median(np.diff(samples["time_ns"]))) * NS / MS), 1.0)


def bridged(blocks: Iterable[Samples]) -> Iterator[Samples]:
    """All blocks of a stream, passed through a ``Bridge``."""
    bridge = Bridge()
    return (bridge.over(block) for block in blocks)


def unbroken(blocks: Iterable[tuple[Samples, Ticks]]) -> Iterator[tuple[Samples, Ticks]]:
    """All blocks with their ticks, passed through a ``Bridge``."""
    bridge = Bridge()
    return ((bridge.over(samples), ticks) for samples, ticks in blocks)


class Phase(IntEnum):
    """The phase of the ejector's cycle."""

    IDLE = 0  # no command
    SUCTION = 1  # commanded, nozzle on
    HOLD = 2  # suction commanded, nozzle switched off by the air saving
    BLOW_OFF = 3


def deviation(samples: Samples, ticks: Ticks) -> npt.NDArray[np.float64]:
    """Measured minus expected pressure in Pa, row by row; NaN if either is unusable."""
    difference: npt.NDArray[np.float64] = samples["pressure"] - ticks["expected"].astype(np.float64)
    difference[(samples["quality"] & UNUSABLE) != 0] = np.nan
    return difference
