"""Cost of compressed air: of cycles, a day and a year."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Self

import numpy as np

from twin.figures.cycle import CycleFigures
from twin.figures.settings import FigureSettings
from twin.figures.simulated import mean_cycle_time
from twin.instants import CALENDAR_NS, DAY_NS, dated
from twin.signals import NS

HOUR_S = 3600.0
NL_PER_M3 = 1e3
NO_PRICE = "no price is configured: set price_per_kwh or price_per_m3 under [figures]"


@dataclass(frozen=True)
class Tariff:
    """The price of compressed air, and how long a year it is used."""

    energy_kwh_m3: float  # to compress a standard m³
    per_m3: float | None  # money for a standard m³; None without a price
    currency: str
    hours: float  # operating hours a year

    @classmethod
    def of(cls, settings: FigureSettings) -> Self:
        """The tariff of ``[figures]``; a price per kWh becomes one per m³."""
        per_m3 = settings.price_per_m3
        if settings.price_per_kwh is not None:
            per_m3 = settings.price_per_kwh * settings.energy_kwh_m3
        return cls(settings.energy_kwh_m3, per_m3, settings.currency, settings.operating_hours)

    def energy(self, air: float) -> float:
        """Electric energy (kWh) to compress ``air`` (Nl)."""
        return air / NL_PER_M3 * self.energy_kwh_m3

    def money(self, air: float) -> float | None:
        """Cost of ``air`` (Nl) in the currency; None without a price."""
        return None if self.per_m3 is None else air / NL_PER_M3 * self.per_m3

    def cycles_a_year(self, cycle_s: float) -> float:
        """Number of cycles in a year, each ``cycle_s`` long."""
        return self.hours * HOUR_S / cycle_s


@dataclass(frozen=True)
class Consumption:
    """Air consumption of the cycles of a day."""

    name: str  # of the day
    cycles: int
    known: int  # cycles whose air is known
    air: float  # Nl, of the known cycles


@dataclass(frozen=True)
class YearlyConsumption:
    """Consumption of a year of cycles like those of a log; NaN if the log does not tell."""

    cycles: float
    air: float  # Nl


def days(cycles: Sequence[CycleFigures]) -> list[Consumption]:
    """Consumption of each day in order, by host time; without a set clock, days since the first."""
    first_ns = cycles[0].host_ns if cycles else 0
    return [
        _consumption(name, list(of_day))
        for name, of_day in groupby(cycles, lambda cycle: _day(cycle.host_ns, first_ns))
    ]


def year(cycles: Sequence[CycleFigures], tariff: Tariff) -> YearlyConsumption:
    """A year at the mean rate and air of these cycles; pauses between them are left out."""
    begins = np.array([cycle.begin_ns for cycle in cycles], np.int64)
    between = np.diff(begins) * NS
    rate = tariff.cycles_a_year(mean_cycle_time(between[between > 0.0]))
    air = [cycle.measured["air"] for cycle in cycles if math.isfinite(cycle.measured["air"])]
    return YearlyConsumption(rate, rate * float(np.mean(air)) if air else math.nan)


def _consumption(name: str, cycles: Sequence[CycleFigures]) -> Consumption:
    air = [cycle.measured["air"] for cycle in cycles if math.isfinite(cycle.measured["air"])]
    return Consumption(name, len(cycles), len(air), math.fsum(air))


def _day(host_ns: int, first_ns: int) -> str:
    """The date of an instant; if the clock was never set, the day since the first cycle."""
    if host_ns >= CALENDAR_NS:
        return dated(host_ns)[:10]
    return f"day {1 + (host_ns - first_ns) // DAY_NS}"
