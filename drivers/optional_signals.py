"""What an ejector or its surroundings tell besides: as columns of ``SAMPLE``, whatever carries it.

An ejector on IO-Link reports in its process data whether it saves air, or how its nozzle stands,
and whether it holds a part. In block mode these are bits of a record's status. A barometer, a
thermometer, a second pressure and a flow are read once a block: what stands still for that long
counts for all of its rows, what moves for the newest alone.
"""

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.tags import Flowmeter, Quantity, Thermometer
from twin.signals import UNUSABLE, Command, Reported, Samples

BITS = {"nozzle": 2, "air_saving": 3, "part_present": 4}  # in the status of a record
STANDING, MOVING = ("ambient", "temperature"), ("pressure_2", "flow")
VALUES = (*STANDING, *MOVING)
# Where an ejector works at all: another reading is none of a barometer, or of a thermometer.
AMBIENT, TEMPERATURE = (50_000.0, 120_000.0), (233.15, 373.15)  # Pa, K

KNOWN = {Reported.NOZZLE: Reported.NOZZLE_KNOWN, Reported.PART: Reported.PART_KNOWN}

Floats = npt.NDArray[np.float64]


class ReportTags(Protocol):
    """What tags of either transport say of the values."""

    @property
    def ambient(self) -> Quantity | None:
        """A barometer."""

    @property
    def temperature(self) -> Thermometer | None:
        """A thermometer."""

    @property
    def pressure_2(self) -> Quantity | None:
        """A second pressure."""

    @property
    def flow(self) -> Flowmeter | None:
        """The suction flow."""


def refuse_unclear(nozzle: object, air_saving: object, ambient: Quantity | None) -> None:
    """ValueError where two tags say the same, or a barometer would count from what it measures."""
    if nozzle is not None and air_saving is not None:
        raise ValueError("nozzle and air_saving say the same of the nozzle: leave one of them out")
    if ambient is not None and ambient.reference != "absolute":
        raise ValueError(
            'ambient is a barometer: its reference must be "absolute"; a fixed ambient pressure is'
            " ambient_mbar in [driver]"
        )


def put_bits(block: Samples, bits: Mapping[str, Floats]) -> None:
    """Put what the ejector says of nozzle and part into ``reported``, once the commands are there.

    ``bits`` are 0 or 1 row by row, NaN where nothing is known, by the tags' names. An ejector that
    saves air has its nozzle off.
    """
    asked = (block["commands"] & (Command.SUCTION | Command.BLOW_OFF)) == Command.SUCTION
    for name, value in bits.items():
        known = ~np.isnan(value)
        if name == "part_present":
            on, bit = value != 0.0, Reported.PART
        else:
            on = asked & (value == 0.0) if name == "air_saving" else value != 0.0
            bit = Reported.NOZZLE
        block["reported"] |= known * np.uint8(KNOWN[bit]) + (known & on) * np.uint8(bit)


def once(value: float, name: str, rows: int) -> Floats:
    """A value that was read once, as a column: NaN in the rows for which it does not count."""
    column = np.full(rows, value if name in STANDING else np.nan)
    column[-1:] = value
    return column


def ambient_of(block: Samples, tags: ReportTags, raw: Mapping[str, Floats], fixed: float) -> Floats:
    """Put the barometer's pressures into ``ambient``; gives what ambient pressure is, row by row.

    ``fixed`` (Pa) is it where no barometer tells. ``raw`` are columns as they stand in the PLC.
    """
    if tags.ambient is not None:
        pascal, quality = tags.ambient.pressure(raw["ambient"], fixed)
        good = ((quality & UNUSABLE) == 0) & (pascal > AMBIENT[0]) & (pascal < AMBIENT[1])
        block["ambient"] = np.where(good, pascal, 0.0)
    ambient: Floats = np.where(block["ambient"] > 0.0, block["ambient"], fixed).astype(np.float64)
    return ambient


def put_values(
    block: Samples, tags: ReportTags, raw: Mapping[str, Floats], ambient: Floats
) -> None:
    """Put the other values into their columns; ``raw`` and ``ambient`` as in ``ambient_of``."""
    if tags.temperature is not None:
        kelvin = tags.temperature.kelvin(raw["temperature"])
        good = (kelvin > TEMPERATURE[0]) & (kelvin < TEMPERATURE[1])
        block["temperature"] = np.where(good, kelvin, 0.0)
    if tags.pressure_2 is not None:
        pascal, quality = tags.pressure_2.pressure(raw["pressure_2"], ambient)
        good = ((quality & UNUSABLE) == 0) & (pascal > 0.0)
        block["pressure_2"] = np.where(good, pascal, 0.0)
    if tags.flow is not None:
        flow = tags.flow.mass_flow(raw["flow"])
        good = np.isfinite(flow)
        block["flow"] = np.where(good, flow, 0.0)
        block["reported"] |= np.where(good, np.uint8(Reported.FLOW_KNOWN), np.uint8(0))
