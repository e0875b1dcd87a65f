"""Check that a column of pressure has plausible values; if not, ask a person for its unit.

A pressure in bar that is read as mbar is a thousandth of what it should be. A vacuum that is
written as gauge pressure is negative. Nothing is guessed: the hint lists lines to write.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np

from twin.errors import SourceError
from twin.quality import UNUSABLE
from twin.signals import MBAR, PASCAL, Command, Reference, Samples, Unit, counted_from
from twin.tables.layout import Layout
from twin.tables.settings import Column, ImportSettings, toml_string
from twin.tables.units import Meaning

# Ambient is about 1 bar: read as mbar, no absolute pressure or vacuum in bar comes to 2 mbar.
# No ejector evacuates to as little, and only a dead one leaves as little after a second of suction.
LEAST = 2.0 * MBAR
LEAST_ABSOLUTE = -20.0 * MBAR  # Pa; a sensor's zero may be off by less
MOST_AMBIENT = 1100.0 * MBAR  # Pa; the highest air pressure measured at sea level is 1085 mbar
LEAST_AMBIENT = 500.0 * MBAR  # Pa, at 5.5 km; the highest towns lie at 5.1 km
LEAST_VACUUM = 50.0 * MBAR  # Pa, that a record with suction shows
MOST_RELEASED = 1.5  # of ambient, the highest pressure of a blow-off
LONG_NS = 1_000_000_000
MOST_ANSWERS = 4  # lines of a hint: nobody reads more


@dataclass
class UnitCheck:
    """Statistics of one file's pressure, block by block; ``ambient`` in Pa."""

    layout: Layout
    settings: ImportSettings
    ambient: float
    _lowest: float = np.inf  # Pa, absolute, as it is taken
    _highest: float = -np.inf
    _most_vacuum: float = -np.inf  # Pa, while suction is commanded
    _above: int = 0  # rows above any ambient pressure
    _rows: int = 0
    _suction_ns: int = 0  # commanded so far
    _run_ns: int = 0

    def see(self, block: Samples) -> None:
        """Add a block of rows."""
        suction = (block["commands"] & Command.SUCTION.value) != 0
        steps = np.diff(block["time_ns"]).clip(0, LONG_NS)
        self._suction_ns += int(steps[suction[1:]].sum())
        self._run_ns += int(steps.sum())
        usable = np.isfinite(block["pressure"]) & ((block["quality"] & UNUSABLE) == 0)
        pressure = block["pressure"][usable].astype(np.float64)
        self._rows += len(pressure)
        self._above += int((pressure > MOST_AMBIENT).sum())
        self._lowest = min(self._lowest, pressure.min(initial=np.inf))
        self._highest = max(self._highest, pressure.max(initial=-np.inf))
        vacuum = self.ambient - pressure[suction[usable]]
        self._most_vacuum = max(self._most_vacuum, vacuum.max(initial=-np.inf))

    def refuse(self, location: str) -> None:
        """SourceError after the last block if the column's values are implausible.

        Its hint asks for the unit. Nothing is checked if ``pressure_unit`` is set.
        """
        if self.settings.pressure_unit is not None or self._run_ns < LONG_NS or not self._rows:
            return
        contradiction = self._contradiction()
        if contradiction:
            name = self.layout.file_names[self.layout.pressure]
            raise SourceError(
                f"{location}: column {name!r} is taken as {self._meaning}: {contradiction}."
                " In which unit is it, and what does it count from?",
                "\n  ".join(self._answers(name)),
            )

    @property
    def _meaning(self) -> Meaning:
        return self.layout.meanings[self.layout.pressure]

    def _contradiction(self) -> str:
        lowest, highest = self._lowest / MBAR, self._highest / MBAR
        if self._meaning.reference == "absolute":
            if self._suction_ns >= LONG_NS and self._highest < LEAST:
                return f"it is never above {highest:.3g} mbar"
        elif self._suction_ns >= LONG_NS and self._most_vacuum < LEAST:
            if self._highest - self.ambient > LEAST_VACUUM:
                return f"it goes {(self._highest - self.ambient) / MBAR:.0f} mbar above ambient"
            most = max(self._most_vacuum, 0.0) / MBAR
            return f"it is never more than {most:.3g} mbar of vacuum while suction is commanded"
        if self._lowest < LEAST_ABSOLUTE:
            return f"it comes down to {lowest:.0f} mbar absolute, which nothing can"
        if 2 * self._above > self._rows:
            return f"it is mostly above {MOST_AMBIENT / MBAR:.0f} mbar absolute, as no air is"
        return ""

    def _answers(self, name: str) -> Iterator[str]:
        """Lines to write, first those that make the column plausible for an ejector."""
        yield "write under [import.columns] the one line that is right:"
        ends = [self._meaning.number(end, self.ambient) for end in (self._lowest, self._highest)]
        lines = _lines(name, min(ends), max(ends), self.ambient, self._meaning)
        yield from lines[:MOST_ANSWERS] or _any_line(name)
        unit = self._meaning.unit
        yield f'or, if {unit} is right, say so under [import]: pressure_unit = "{unit}"'


def _lines(name: str, low: float, high: float, ambient: float, assumed: Meaning) -> list[str]:
    """Settings that make numbers from ``low`` to ``high`` a vacuum and its release.

    They differ from ``assumed`` in unit or reference. The same unit comes first, then the deepest
    vacuum.
    """
    references: tuple[Reference, ...] = ("absolute", "vacuum", "gauge")
    candidates: list[tuple[bool, float, str]] = []
    for unit in get_args(Unit):
        for reference in references:
            if unit == "hPa" or (unit, reference) == (assumed.unit, assumed.reference):
                continue  # hPa is mbar
            numbers = np.array([low, high]) * PASCAL[unit]
            least, most = sorted(counted_from(numbers, reference, "absolute", ambient).tolist())
            is_vacuum = LEAST_ABSOLUTE < least < ambient - LEAST_VACUUM
            if is_vacuum and LEAST_AMBIENT < most <= MOST_RELEASED * ambient:
                means = f"   # {least / MBAR:.0f} to {most / MBAR:.0f} mbar absolute"
                candidates.append(
                    (unit != assumed.unit, least, _line(name, unit, reference) + means)
                )
    return [line for *_, line in sorted(candidates)]


def _any_line(name: str) -> list[str]:
    units = ", ".join(get_args(Unit))
    return [
        f'pressure = {{ name = {toml_string(name)}, unit = "...", reference = "..." }}, of {units}'
    ]


def _line(name: str, unit: Unit, reference: Reference) -> str:
    column = {
        ("bar", "vacuum"): Column.VACUUM_BAR,
        ("mbar", "vacuum"): Column.VACUUM_MBAR,
        ("Pa", "vacuum"): Column.VACUUM_PA,
        ("bar", "absolute"): Column.PRESSURE_BAR,
        ("mbar", "absolute"): Column.PRESSURE_MBAR,
        ("Pa", "absolute"): Column.PRESSURE_PA,
    }.get((unit, reference))
    if column is not None:
        return f"{column} = {toml_string(name)}"
    return (
        f'pressure = {{ name = {toml_string(name)}, unit = "{unit}", reference = "{reference}" }}'
    )
