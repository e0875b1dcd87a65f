"""Costs as text, and for JSON."""

import math
from collections.abc import Sequence
from typing import Any

from twin.figures.costs import (
    NL_PER_M3,
    NO_PRICE,
    Consumption,
    Tariff,
    YearlyConsumption,
)
from twin.figures.money import amount, significant


def days_table(days: Sequence[Consumption], yearly: YearlyConsumption, tariff: Tariff) -> str:
    """A table with a line for each day, then a year and remarks on what is missing."""
    head = ["day", "cycles", "air (Nl)", "energy (kWh)", f"cost ({tariff.currency})"]
    rows = [_cells(day.name, day.cycles, day.air, tariff) for day in days]
    if tariff.per_m3 is None:
        head, rows = head[:-1], [row[:-1] for row in rows]
    lines = [aligned([head, *rows]), _year_line(yearly, tariff)]
    return "\n".join([*lines, *_remarks(days, tariff)])


def days_plain(
    days: Sequence[Consumption], yearly: YearlyConsumption, tariff: Tariff
) -> dict[str, Any]:
    """The same for JSON; null if unknown."""
    return {
        "currency": tariff.currency,
        "operating_hours": tariff.hours,
        "price_per_m3": tariff.per_m3,
        "days": [
            {
                "day": day.name,
                "cycles": day.cycles,
                "cycles_with_air": day.known,
                **_plain(day.air, tariff),
            }
            for day in days
        ],
        "year": {"cycles": finite(yearly.cycles), **_plain(yearly.air, tariff)},
    }


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as a table; all columns but the first are flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            [row[0].ljust(widths[0])]
            + [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        ).rstrip()
        for row in rows
    )


def _cells(name: str, cycles: int, air: float, tariff: Tariff) -> list[str]:
    money = tariff.money(air)
    cost = "-" if money is None else amount(money)
    return [name, str(cycles), significant(air, 4), significant(tariff.energy(air)), cost]


def _year_line(yearly: YearlyConsumption, tariff: Tariff) -> str:
    """A year in a sentence, or why it is unknown."""
    if not math.isfinite(yearly.cycles):
        return "a year: unknown, the log has fewer than two cycles"
    if not math.isfinite(yearly.air):
        return (
            "a year: unknown, no cycle's air is known; record pressure and commands at least"
            " every 10 ms"
        )
    texts = [
        f"{significant(yearly.cycles)} cycles",
        f"{significant(yearly.air / NL_PER_M3)} m³ of air",
        f"{significant(tariff.energy(yearly.air))} kWh",
    ]
    if (money := tariff.money(yearly.air)) is not None:
        texts.append(f"{amount(money)} {tariff.currency}")
    return f"a year of {tariff.hours:g} h at this rate: {', '.join(texts)}"


def _remarks(days: Sequence[Consumption], tariff: Tariff) -> list[str]:
    unknown = sum(day.cycles - day.known for day in days)
    remarks = []
    if unknown:
        count = sum(day.cycles for day in days)
        remarks.append(
            f"the air of {unknown} of {count} cycles is unknown (cut off, or with a hole):"
            " no day counts it"
        )
    if tariff.per_m3 is None:
        remarks.append(NO_PRICE)
    return remarks


def _plain(air: float, tariff: Tariff) -> dict[str, float | None]:
    money = tariff.money(air)
    return {
        "air_nl": finite(air),
        "energy_kwh": finite(tariff.energy(air)),
        "cost": None if money is None else finite(money),
    }


def finite(value: float) -> float | None:
    """A value to six significant digits; None if it is not finite."""
    return float(f"{value:.6g}") if math.isfinite(value) else None
