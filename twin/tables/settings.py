"""Names of a table's columns, and settings of its import."""

import json
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Literal, NamedTuple, Self
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from twin.settings import Settings
from twin.signals import Reference, Unit


def toml_string(text: str) -> str:
    """A text as TOML wants it, without escapes where that is possible."""
    if '"' in text and "'" not in text:
        return f"'{text}'"
    return json.dumps(text, ensure_ascii=False)


class Unsaid(NamedTuple):
    """Something that neither file nor settings say, with the line of a configuration that would."""

    text: str
    line: str


class Column(StrEnum):
    """The known columns; docs/csv.md describes them."""

    TIME_S = "time_s"
    TIME_MS = "time_ms"
    TIME_US = "time_us"
    TIME_NS = "time_ns"
    TIME = "time"
    DATE = "date"
    SEQUENCE = "sequence"
    SUCTION = "suction"
    BLOW_OFF = "blow_off"
    VACUUM_MBAR = "vacuum_mbar"
    PRESSURE_MBAR = "pressure_mbar"
    VACUUM_BAR = "vacuum_bar"
    PRESSURE_BAR = "pressure_bar"
    VACUUM_PA = "vacuum_pa"
    PRESSURE_PA = "pressure_pa"
    VACUUM = "vacuum"
    PRESSURE = "pressure"
    SUPPLY_BAR = "supply_bar"
    SUPPLY = "supply"
    REPORTED_NOZZLE = "reported_nozzle"
    REPORTED_AIR_SAVING = "reported_air_saving"
    REPORTED_PART_PRESENT = "reported_part_present"
    AMBIENT_MBAR = "ambient_mbar"
    TEMPERATURE_C = "temperature_c"
    PRESSURE_2_MBAR = "pressure_2_mbar"
    FLOW_SL_MIN = "flow_sl_min"
    QUALITY = "quality"
    HOST_NS = "host_ns"


DIGITS = {Column.TIME_S: 9, Column.TIME_MS: 6, Column.TIME_US: 3, Column.TIME_NS: 0}  # down to ns
TIMES = (*DIGITS, Column.TIME)


class Bad(StrEnum):
    """What becomes of bad input."""

    REFUSE = "refuse"
    MARK = "mark"  # keep the row and set its quality


class ColumnSource(Settings):
    """Which column of the file it is, and what its numbers mean: number · scale + offset.

    A transmitter is said by what it gives and what that means: ``signal = [4, 20]`` (mA) and
    ``range = [0, -1000]`` (in ``unit``).
    """

    name: str  # name of the column in the file
    unit: Unit | None = None  # unit of a pressure, vacuum or supply
    # Zero of a pressure (default absolute) or supply (default gauge).
    reference: Reference | None = None
    scale: float = 1.0  # -1 turns the sign
    offset: float = 0.0  # offset in unit
    signal: tuple[float, float] | None = None  # two numbers of the file: mA, V or counts
    range: tuple[float, float] | None = None  # what these two are, in unit

    @model_validator(mode="after")
    def _is_one_line(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale must not be 0")
        if (self.signal is None) != (self.range is None):
            raise ValueError("signal and range go together: signal = [4, 20], range = [0, -1000]")
        if self.signal is not None and self.signal[0] == self.signal[1]:
            raise ValueError("the two numbers of signal must differ")
        if self.signal is not None and (self.scale, self.offset) != (1.0, 0.0):
            raise ValueError("say either scale and offset, or signal and range")
        return self

    @property
    def line(self) -> tuple[float, float]:
        """Scale and offset."""
        if self.signal is None or self.range is None:
            return self.scale, self.offset
        slope = (self.range[1] - self.range[0]) / (self.signal[1] - self.signal[0])
        return slope, self.range[0] - slope * self.signal[0]

    @property
    def quoted(self) -> str:
        """The name as it stands in a configuration."""
        return toml_string(self.name)

    @property
    def is_name_only(self) -> bool:
        """Whether only the name is given."""
        return self == ColumnSource(name=self.name)


def _named(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


def known_zone(name: str) -> str:
    """The name of a time zone; ValueError if there is none of that name."""
    try:
        ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ValueError(f"{name!r} is no time zone: write Europe/Berlin or UTC") from error
    return name


Zone = Annotated[str, AfterValidator(known_zone)]
Source = Annotated[ColumnSource, BeforeValidator(_named, json_schema_input_type=str | ColumnSource)]
Encoding = Literal["utf-8", "cp1252", "utf-16", "utf-16-le", "utf-16-be"]


class ImportSettings(Settings):
    """How a table of another program is taken in.

    ``columns`` says under which name the file has a known column: ``vacuum_mbar = "Vakuum"``.
    """

    # The file's name of a known column (docs/csv.md lists them), or a table as below.
    columns: Mapping[Column, Source] = Field(default_factory=dict)
    values: Bad = Bad.REFUSE  # text in a number, NaN, an empty cell, too many or too few cells
    jumps: Bad = Bad.REFUSE  # time or sequence that does not go forward
    gaps: Bad = Bad.REFUSE  # samples that are missing
    pressure_unit: Unit | None = None  # says that the unit of the pressure's column is right
    period_ms: float | None = Field(None, gt=0.0, le=60_000.0)  # else the median of the file's
    time_zone: Zone | None = None  # zone of times without one, such as Europe/Berlin
    date_order: Literal["day", "month"] | None = None  # first number in 03/04/2026
    # Encoding of a CSV file; by default guessed from its bytes, with a note.
    encoding: Encoding | None = None
    sheet: str = ""  # sheet of an Excel file; by default the first one
    no_blow_off: bool = False  # the ejector has none: suction ends by itself
