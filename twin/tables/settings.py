"""The names a table's columns go by, and how it is taken in."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Literal

from pydantic import Field

from twin.settings import Settings


class Column(StrEnum):
    """The known columns; docs/csv.md describes them."""

    TIME_S = "time_s"
    TIME_MS = "time_ms"
    TIME_US = "time_us"
    TIME_NS = "time_ns"
    SEQUENCE = "sequence"
    SUCTION = "suction"
    BLOW_OFF = "blow_off"
    VACUUM_MBAR = "vacuum_mbar"
    PRESSURE_MBAR = "pressure_mbar"
    VACUUM_BAR = "vacuum_bar"
    PRESSURE_BAR = "pressure_bar"
    VACUUM_PA = "vacuum_pa"
    PRESSURE_PA = "pressure_pa"
    SUPPLY_BAR = "supply_bar"
    REPORTED_NOZZLE = "reported_nozzle"
    REPORTED_AIR_SAVING = "reported_air_saving"
    REPORTED_PART_PRESENT = "reported_part_present"
    AMBIENT_MBAR = "ambient_mbar"
    TEMPERATURE_C = "temperature_c"
    PRESSURE_2_MBAR = "pressure_2_mbar"
    FLOW_SL_MIN = "flow_sl_min"
    QUALITY = "quality"
    HOST_NS = "host_ns"


class Bad(StrEnum):
    """What becomes of bad input."""

    REFUSE = "refuse"
    MARK = "mark"  # keep the row and set its quality


class ImportSettings(Settings):
    """The table ``[import]``: how a table of another program is taken in.

    ``columns`` says under which name the file has a known column: ``vacuum_mbar = "Vakuum"``.
    """

    columns: Mapping[Column, str] = Field(default_factory=dict)
    values: Bad = Bad.REFUSE  # text in a number, NaN, an empty cell, too many or too few cells
    jumps: Bad = Bad.REFUSE  # time or sequence that does not go forward
    gaps: Bad = Bad.REFUSE  # samples that are missing
    pressure_unit: Literal["mbar", "bar", "Pa"] | None = None  # says that the column's is right
    period_ms: float | None = Field(None, gt=0.0, le=60_000.0)  # else the median of the file's
