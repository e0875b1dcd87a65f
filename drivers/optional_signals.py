"""Optional signals of an ejector and its surroundings, as columns of ``SAMPLE``, for any protocol.

An ejector on IO-Link reports in its process data whether it saves air or its nozzle is on, and
whether it holds a part. In block mode these are bits of a record's status. A barometer, a
thermometer, a second pressure and a flow are read once a block. A slow value counts for all rows of
the block, a fast one for the newest row alone.
"""

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.tags import Flowmeter, Quantity, Thermometer
from twin.quality import UNUSABLE
from twin.signals import Command, Reported, Samples

BITS = {"nozzle": 2, "air_saving": 3, "part_present": 4}  # in the status of a record
SLOW, FAST = ("ambient", "temperature"), ("pressure_2", "flow")
VALUES = (*SLOW, *FAST)
# Plausible readings: no ejector works beyond these limits.
AMBIENT, TEMPERATURE = (50_000.0, 120_000.0), (233.15, 373.15)  # Pa, K

KNOWN = {Reported.NOZZLE: Reported.NOZZLE_KNOWN, Reported.PART: Reported.PART_KNOWN}

Floats = npt.NDArray[np.float64]


class ReportTags(Protocol):
    """Tags of optional values, of either protocol."""

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
    """Raise ValueError if two tags report the nozzle, or if the barometer is not absolute."""
    if nozzle is not None and air_saving is not None:
        raise ValueError("nozzle and air_saving say the same of the nozzle: leave one of them out")
    if ambient is not None and ambient.reference != "absolute":
        raise ValueError(
            'ambient is a barometer: its reference must be "absolute"; a fixed ambient pressure is'
            " ambient_mbar in [driver]"
        )


def put_bits(block: Samples, bits: Mapping[str, Floats]) -> None:
    """Set ``reported`` from the bits for nozzle and part; ``commands`` must be set before.

    ``bits`` holds a column by tag name: 0 or 1, NaN where unknown. While the ejector saves air its
    nozzle is off.
    """
    suction_on = (block["commands"] & (Command.SUCTION | Command.BLOW_OFF)) == Command.SUCTION
    for name, value in bits.items():
        is_reported = ~np.isnan(value)
        if name == "part_present":
            on, bit = value != 0.0, Reported.PART
        else:
            on = suction_on & (value == 0.0) if name == "air_saving" else value != 0.0
            bit = Reported.NOZZLE
        block["reported"] |= is_reported * np.uint8(KNOWN[bit]) + (is_reported & on) * np.uint8(bit)


def once(value: float, name: str, rows: int) -> Floats:
    """A value read once a block, as a column: NaN in rows for which it does not count."""
    column = np.full(rows, value if name in SLOW else np.nan)
    column[-1:] = value
    return column


def ambient_of(block: Samples, tags: ReportTags, raw: Mapping[str, Floats], fixed: float) -> Floats:
    """Set ``ambient`` from the barometer; return the ambient pressure of each row (Pa).

    ``fixed`` (Pa) applies where no barometer reads. ``raw`` holds columns as they stand in the PLC.
    """
    if tags.ambient is not None:
        pascal, quality = tags.ambient.pressure(raw["ambient"], fixed)
        plausible = ((quality & UNUSABLE) == 0) & (pascal > AMBIENT[0]) & (pascal < AMBIENT[1])
        block["ambient"] = np.where(plausible, pascal, 0.0)
    ambient: Floats = np.where(block["ambient"] > 0.0, block["ambient"], fixed).astype(np.float64)
    return ambient


def put_values(
    block: Samples, tags: ReportTags, raw: Mapping[str, Floats], ambient: Floats
) -> None:
    """Set the columns of the other values; ``raw`` and ``ambient`` as in ``ambient_of``."""
    if tags.temperature is not None:
        kelvin = tags.temperature.kelvin(raw["temperature"])
        plausible = (kelvin > TEMPERATURE[0]) & (kelvin < TEMPERATURE[1])
        block["temperature"] = np.where(plausible, kelvin, 0.0)
    if tags.pressure_2 is not None:
        pascal, quality = tags.pressure_2.pressure(raw["pressure_2"], ambient)
        plausible = ((quality & UNUSABLE) == 0) & (pascal > 0.0)
        block["pressure_2"] = np.where(plausible, pascal, 0.0)
    if tags.flow is not None:
        flow = tags.flow.mass_flow(raw["flow"])
        plausible = np.isfinite(flow)
        block["flow"] = np.where(plausible, flow, 0.0)
        block["reported"] |= np.where(plausible, np.uint8(Reported.FLOW_KNOWN), np.uint8(0))
