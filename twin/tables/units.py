"""Meaning of the numbers in a pressure's column: unit, reference, scale and offset."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np
import numpy.typing as npt

from twin.errors import ConfigError, SourceError
from twin.signals import PASCAL, Reference, Unit, counted_from
from twin.tables.settings import Column, ColumnSource, ImportSettings, Unsaid, toml_string

Floats = npt.NDArray[np.float64]

# Unit and reference that a column's name implies; None: it implies none.
PRESSURES: Mapping[Column, tuple[Unit | None, Reference]] = {
    Column.PRESSURE_MBAR: ("mbar", "absolute"),
    Column.PRESSURE_PA: ("Pa", "absolute"),
    Column.PRESSURE_BAR: ("bar", "absolute"),
    Column.PRESSURE: (None, "absolute"),
    Column.VACUUM_MBAR: ("mbar", "vacuum"),
    Column.VACUUM_PA: ("Pa", "vacuum"),
    Column.VACUUM_BAR: ("bar", "vacuum"),
    Column.VACUUM: (None, "vacuum"),
}
SUPPLIES: Mapping[Column, tuple[Unit | None, Reference]] = {
    Column.SUPPLY_BAR: ("bar", "gauge"),
    Column.SUPPLY: (None, "gauge"),
}
_UNITS = {unit.lower(): unit for unit in get_args(Unit)}
_ELECTRICAL = {"v": ("V", "[0, 10]"), "ma": ("mA", "[4, 20]")}
_BRACKET = re.compile(r"[\[(]\s*([^\])]+?)\s*(?:abs\.?|rel\.?)?\s*[\])]\s*$")


class UnsaidError(SourceError):
    """Nothing says what the numbers of a column mean; the line is of ``[import.columns]``."""

    def __init__(self, location: str, unsaid: Unsaid) -> None:
        super().__init__(f"{location}: {unsaid.text}", f"under [import.columns]: {unsaid.line}")
        self.unsaid = unsaid


@dataclass(frozen=True)
class Meaning:
    """Pressure in ``unit``, counted from ``reference``, is number · scale + offset."""

    unit: Unit
    reference: Reference
    scale: float = 1.0
    offset: float = 0.0
    from_header: bool = False  # whether the unit stands in the file's header alone

    def pascal(self, numbers: Floats, ambient: float, onto: Reference) -> Floats:
        """Pressures in Pa counted from ``onto``; ``ambient`` in Pa."""
        values = numbers
        if (self.scale, self.offset) != (1.0, 0.0):  # −0 + 0 is another zero
            values = numbers * self.scale + self.offset
        pascal = values * PASCAL[self.unit]
        if self.reference == onto:
            return pascal
        return counted_from(pascal, self.reference, onto, ambient)

    def number(self, pascal: float, ambient: float) -> float:
        """The number that stands for an absolute pressure (Pa)."""
        value = counted_from(np.array([pascal]), "absolute", self.reference, ambient)[0]
        return float((value / PASCAL[self.unit] - self.offset) / self.scale)

    def __str__(self) -> str:
        counted = {
            "absolute": "absolute",
            "gauge": "gauge, negative below ambient",
            "vacuum": "below ambient, positive",
        }
        text = f"{self.unit} {counted[self.reference]}"
        if (self.scale, self.offset) != (1.0, 0.0):
            text += f", number · {self.scale:g} + {self.offset:g}"
        return text + (" (unit of the header)" if self.from_header else "")


def find_meaning(
    column: Column, source: ColumnSource, settings: ImportSettings, location: str
) -> Meaning:
    """The meaning of a column of pressure or supply, from its name, the settings and the header.

    UnsaidError if none of them gives the unit, SourceError if two contradict each other.
    """
    named, reference = {**PRESSURES, **SUPPLIES}[column]
    if source.reference is not None:
        if reference == "vacuum" and source.reference != "vacuum":
            kind = f'pressure = {{ name = {source.quoted}, reference = "{source.reference}", ... }}'
            raise ConfigError(
                f"{location}: {column} counts from ambient, positive below", f"use {kind}"
            )
        reference = source.reference
    header = _unit_of(source.name)
    stated = source.unit or (settings.pressure_unit if column in PRESSURES else None)
    if named and stated and stated != named:
        raise _other_unit(column, source, stated, location)
    unit = named or stated
    if header in _ELECTRICAL and source.signal is None and source.is_name_only:
        raise _electrical(source, location)
    if unit is None and header in _UNITS:
        return Meaning(_UNITS[header], reference, *source.line, from_header=True)
    if unit is None:
        text = f"nothing says in which unit column {source.name!r} is"
        raise UnsaidError(location, Unsaid(text, _line(column, source, reference)))
    if (
        source.is_name_only
        and not stated
        and header in _UNITS
        and PASCAL[unit] != PASCAL[_UNITS[header]]
    ):
        raise SourceError(
            f"{location}: column {source.name!r} is taken as {column}, and its name says"
            f" {_UNITS[header]}: in which unit is it?",
            f"if its name is right, say under [import.columns]: {_generic(column)} ="
            f' {{ name = {source.quoted}, unit = "{_UNITS[header]}" }}; if not: {column} ='
            f' {{ name = {source.quoted}, unit = "{unit}" }}',
        )
    return Meaning(unit, reference, *source.line)


def _unit_of(name: str) -> str:
    """The unit in brackets at the end of a column's name, in lower case; empty without one."""
    match = _BRACKET.search(name)
    return match[1].lower() if match else ""


def _generic(column: Column) -> str:
    return column.partition("_")[0]


def _other_unit(column: Column, source: ColumnSource, stated: Unit, location: str) -> ConfigError:
    column_name = f"{_generic(column)}_{stated.lower()}"
    line = f"{column_name} = {source.quoted}"
    if column_name not in tuple(Column):
        line = f'{_generic(column)} = {{ name = {source.quoted}, unit = "{stated}" }}'
    key = "unit" if source.unit else "pressure_unit"
    return ConfigError(
        f'{location}: {key} = "{stated}" under [import], but column {source.name!r} is'
        f" taken as {column}",
        f"say under [import.columns]: {line}, or leave {key} out",
    )


def _line(column: Column, source: ColumnSource, reference: Reference) -> str:
    """The line that gives a column its unit, with what is said of it already."""
    attributes = [f"name = {source.quoted}", 'unit = "..."']
    comment = f"unit is one of {', '.join(get_args(Unit))}"
    if source.reference is not None or column is Column.PRESSURE:
        attributes.append(f'reference = "{reference}"')
    if column is Column.PRESSURE and source.reference is None:
        comment += '; reference is "gauge" if the column is 0 at ambient'
    if source.signal is not None and source.range is not None:
        attributes.append(f"signal = {[*source.signal]}, range = {[*source.range]}")
    elif source.line != (1.0, 0.0):
        attributes.append(f"scale = {source.scale}, offset = {source.offset}")
    return f"{column} = {{ {', '.join(attributes)} }}   # {comment}"


def _electrical(source: ColumnSource, location: str) -> UnsaidError:
    unit, usual = _ELECTRICAL[_unit_of(source.name)]
    text = f"column {source.name!r} is in {unit}, and nothing says which pressures its ends mean"
    return UnsaidError(location, Unsaid(text, transmitter_line(source.name, usual)))


def transmitter_line(name: str, signal: str) -> str:
    """An example of a line of ``[import.columns]`` for a transmitter that gives ``signal``."""
    return (
        f"pressure = {{ name = {toml_string(name)}, signal = {signal}, range = [0, -1000],"
        ' unit = "mbar", reference = "gauge" }'
        "   # put in the pressures that these two numbers mean"
    )
