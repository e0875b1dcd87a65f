"""Tags: address, coding and meaning of a value in a Modbus PLC.

Registers arrive as ``uint16`` arrays of shape (rows, registers of one value) and leave as columns
of ``SAMPLE``: values in Pa and ``Quality`` bits. Everything is vectorised over the rows.
"""

import re
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BeforeValidator, Field, PlainSerializer, model_validator

from twin.quality import UNUSABLE, Flags, Quality, mark
from twin.settings import Settings
from twin.signals import PASCAL, SL_MIN, ZERO_C, Reference, Unit, counted_from

Words = npt.NDArray[np.uint16]
Floats = npt.NDArray[np.float64]

Area = Literal["coil", "discrete", "input", "holding"]
Type = Literal["bit", "int16", "uint16", "int32", "uint32", "float32"]
NumberType = Literal["int16", "uint16", "int32", "uint32", "float32"]
WordOrder = Literal["big", "little"]

REFERENCE_DIGIT: dict[Area, str] = {"coil": "0", "discrete": "1", "input": "3", "holding": "4"}
CODE: dict[Type, str] = {  # as NumPy reads it once the high word stands first
    "bit": ">u2",
    "int16": ">i2",
    "uint16": ">u2",
    "int32": ">i4",
    "uint32": ">u4",
    "float32": ">f4",
}
# kg/s in one litre a minute of air: standard as ISO 8778 has it, normal as DIN 1343 (0 °C, 1013.25
# mbar, 1.2928 kg/m³).
MASS_FLOW = {"sl/min": SL_MIN, "Nl/min": 1.2928e-3 / 60.0}


@dataclass(frozen=True)
class Address:
    """An address in a PLC: 0-based in the protocol, 1-based with the area's digit in manuals."""

    area: Area
    offset: int

    @classmethod
    def parse(cls, text: object) -> "Address":
        """Take ``"holding:100"`` (0-based) or ``"40101"`` (manual, 1-based); else ValueError."""
        if isinstance(text, cls):
            return text
        text = str(text)
        for area, digit in REFERENCE_DIGIT.items():
            if match := re.fullmatch(rf"{area}:(\d+)", text):
                return cls._checked(area, int(match[1]), text)
            if match := re.fullmatch(rf"{digit}(\d{{4,5}})", text):
                return cls._checked(area, int(match[1]) - 1, text)
        raise ValueError(
            f'"{text}" is no address: write "holding:0" (also input, discrete, coil; counted '
            'from 0) or, in quotes, the manual\'s "40001" (3…, 1…, 0…; counted from 1)'
        )

    @classmethod
    def _checked(cls, area: Area, offset: int, text: str) -> "Address":
        if not 0 <= offset <= 0xFFFF:
            raise ValueError(
                f'"{text}" is no address: offsets are 0…65535 (manual: …00001 to …65536)'
            )
        return cls(area, offset)

    def __add__(self, count: int) -> "Address":
        return Address(self.area, self.offset + count)

    def __str__(self) -> str:
        return f"{self.area}:{self.offset} [{self.manual}]"

    @property
    def manual(self) -> str:
        """The address in the notation of manuals: five digits if they suffice, else six."""
        width = 4 if self.offset < 9999 else 5
        return f"{REFERENCE_DIGIT[self.area]}{self.offset + 1:0{width}}"

    @property
    def of_words(self) -> bool:
        """Whether the area holds registers, not single bits."""
        return self.area in ("input", "holding")


Place = Annotated[
    Address,
    BeforeValidator(Address.parse, json_schema_input_type=str),
    PlainSerializer(lambda address: f"{address.area}:{address.offset}", return_type=str),
]


def numbers(words: Words, code: str, order: WordOrder) -> npt.NDArray[np.generic]:
    """Numbers of NumPy type ``code`` (big-endian) from words (..., registers of one number)."""
    ordered = words if order == "big" else words[..., ::-1]
    view = np.ascontiguousarray(ordered, dtype=">u2").view(code)
    return view[..., 0]


class Tag(Settings):
    """A bit or a number in the PLC."""

    address: Place  # "40101" as in manuals, or "holding:100" counted from 0
    type: Type = "bit"  # coding of the number
    bit: int | None = Field(default=None, ge=0, le=15)  # bit of a word, 0 the lowest

    @model_validator(mode="after")
    def _fits(self) -> Self:
        word_bit = self.address.of_words and self.type == "bit"
        if word_bit and self.bit is None:
            raise ValueError(
                f"{self.address} is a 16-bit word: say which bit = 0…15 is meant, or its type"
            )
        if self.bit is not None and not word_bit:
            raise ValueError(f'bit belongs to type "bit" in a word, not to {self.address}')
        if not self.address.of_words and self.type != "bit":
            raise ValueError(f'{self.address} holds one bit: type must be "bit"')
        return self

    @property
    def size(self) -> int:
        """Number of registers (or coils) of the value."""
        return np.dtype(CODE[self.type]).itemsize // 2

    def raw(self, words: Words, order: WordOrder) -> npt.NDArray[np.generic]:
        """Numbers as they stand in the PLC (bits as 0 or 1) from words (rows, size)."""
        values = numbers(words, CODE[self.type], order)
        return values if self.bit is None else (values.astype(np.uint16) >> self.bit) & 1

    def floats(self, words: Words, order: WordOrder) -> Floats:
        """The same numbers as float64."""
        with np.errstate(invalid="ignore"):  # signalling NaNs too
            return self.raw(words, order).astype(np.float64)


class Scaled(Settings):
    """Scaling of a number: value = raw · scale + offset in its unit."""

    scale: float = 1.0  # factor on the raw number
    offset: float = 0.0  # offset in the unit, added after scaling

    @model_validator(mode="after")
    def _has_a_scale(self) -> Self:
        if self.scale == 0:
            raise ValueError("scale must not be 0")
        return self

    def value(self, raw: Floats) -> Floats:
        """Scaled values in the unit of the tag."""
        with np.errstate(invalid="ignore", over="ignore"):  # callers flag what is not finite
            return raw * self.scale + self.offset


class Thermometer(Scaled):
    """A temperature, of the gas or of what surrounds the ejector."""

    unit: Literal["C", "K"]  # unit of the scaled value

    def kelvin(self, raw: Floats) -> Floats:
        """Temperatures in K."""
        return self.value(raw) + (ZERO_C if self.unit == "C" else 0.0)


class Flowmeter(Scaled):
    """A suction flow, positive into the ejector: standard or normal litres a minute."""

    unit: Literal["sl/min", "Nl/min"]  # unit of the scaled value

    def mass_flow(self, raw: Floats) -> Floats:
        """Flows in kg/s."""
        return self.value(raw) * MASS_FLOW[self.unit]


class Quantity(Scaled):
    """Scaling of a pressure: raw · scale + offset in ``unit``, counted from ``reference``."""

    unit: Unit  # unit of the scaled value
    reference: Reference  # vacuum: positive below ambient
    # Limits in unit; a value beyond them is flagged and kept.
    range: tuple[float, float] | None = None
    # Raw number above which, of either sign, the input overflows (Siemens: 32511).
    overflow_above: int | None = Field(default=None, ge=0)

    @model_validator(mode="after")
    def _can_be_used(self) -> Self:
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError("range must be [low, high] with low < high")
        return self

    def pressure(
        self, raw: Floats, ambient: float | Floats, onto: Reference = "absolute"
    ) -> tuple[npt.NDArray[np.float32], Flags]:
        """Pressures in Pa, counted from ``onto``, and quality bits.

        ``ambient`` (Pa) is a number or a column. NaN and infinite values become NaN and BAD.
        """
        with np.errstate(invalid="ignore", over="ignore"):  # flagged as BAD below
            value = self.value(raw)
            pascal = counted_from(value * PASCAL[self.unit], self.reference, onto, ambient)
            column = pascal.astype(np.float32)
            quality = self._judge(raw, value)
        unreadable = ~np.isfinite(column)
        column[unreadable] = np.nan
        mark(quality, unreadable, Quality.BAD)
        return column, quality

    def raw_of(self, pressure: float, ambient: float) -> tuple[float, bool]:
        """The PLC's number for ``pressure`` (Pa, absolute), and whether it is within range.

        A pressure beyond the range is clipped to its nearer end.
        """
        counted = counted_from(np.array([pressure]), "absolute", self.reference, ambient)
        value = float(counted[0]) / PASCAL[self.unit]
        low, high = self.range or (value, value)
        within = min(max(value, low), high)
        return (within - self.offset) / self.scale, within == value

    def _judge(self, raw: Floats, value: Floats) -> Flags:
        quality = np.zeros(len(raw), np.uint8)
        if self.range is not None:
            low, high = self.range
            mark(quality, (value < low) | (value > high), Quality.OUT_OF_RANGE)
        if self.overflow_above is not None:  # two's complement reaches one further down
            above = self.overflow_above
            mark(quality, (raw > above) | (raw < -above - 1), Quality.OVERFLOW)
        return quality

    def gauge(self, raw: Floats, ambient: float | Floats) -> npt.NDArray[np.float32]:
        """Pressures in Pa gauge; NaN where unusable."""
        pascal, quality = self.pressure(raw, ambient, onto="gauge")
        pascal[(quality & UNUSABLE) != 0] = np.nan
        return pascal


class Pressure(Quantity, Tag):
    """A pressure in the PLC's registers."""

    type: Type  # coding of the number

    @model_validator(mode="after")
    def _is_a_number(self) -> Self:
        if self.type == "bit":
            raise ValueError("a pressure is a number, not a bit")
        return self

    def decode(
        self, words: Words, order: WordOrder, ambient: float | Floats, onto: Reference = "absolute"
    ) -> tuple[npt.NDArray[np.float32], Flags]:
        """Pressures in Pa, counted from ``onto``, and quality bits, from words (rows, size)."""
        return self.pressure(self.floats(words, order), ambient, onto)

    def supply(
        self, words: Words, order: WordOrder, ambient: float | Floats
    ) -> npt.NDArray[np.float32]:
        """Supply pressures in Pa gauge from words (rows, size); NaN where unusable."""
        return self.gauge(self.floats(words, order), ambient)


class Temperature(Thermometer, Tag):
    """A temperature in the PLC's registers."""

    type: NumberType  # coding of the number


class Flow(Flowmeter, Tag):
    """A suction flow in the PLC's registers."""

    type: NumberType  # coding of the number


def words_of(number: float, code: str, order: WordOrder) -> tuple[int, ...]:
    """The words of a number of NumPy type ``code`` (big-endian), as ``numbers`` reads them."""
    words = np.array([number]).astype(code).view(">u2").tolist()
    return tuple(words if order == "big" else words[::-1])
