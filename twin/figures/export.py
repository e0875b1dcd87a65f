"""Key figures and costs as tables for other programs: a row for each cycle, or each day."""

from collections.abc import Sequence

import pyarrow as pa

from twin.assets.unit import Unit
from twin.figures.costs import Consumption, Tariff
from twin.figures.database import SIDES, History
from twin.figures.key_figures import FIGURES

UNITS = {f"{figure.name}_{side}": figure.unit for figure in FIGURES.values() for side in SIDES}


def to_table(history: History, unit: Unit) -> pa.Table:
    """The cycles as a table; unknown figures are null."""
    columns = {
        "asset_type": pa.array([unit.type] * len(history.host_ns), pa.string()),
        "asset_id": pa.array([unit.id] * len(history.host_ns), pa.string()),
        "time": pa.array(history.host_ns, pa.timestamp("ns", "UTC")),
        "plc_time_ns": pa.array(history.begin_ns, pa.int64()),
        "cycle": pa.array(history.cycle, pa.int64()),
        "alarms": pa.array(history.alarms, pa.int64()),
        "warnings": pa.array(history.warnings, pa.string()),
    }
    columns |= {name: pa.array(values, from_pandas=True) for name, values in history.values.items()}
    fields = [
        pa.field(name, column.type, metadata={"unit": UNITS[name]} if name in UNITS else None)
        for name, column in columns.items()
    ]
    return pa.table(list(columns.values()), pa.schema(fields))


def days_columns(days: Sequence[Consumption], tariff: Tariff) -> pa.Table:
    """The days as a table for other programs; without a price the column of costs is null."""
    costs = [tariff.money(day.air) for day in days]
    columns = {
        ("day", ""): pa.array([day.name for day in days], pa.string()),
        ("cycles", ""): pa.array([day.cycles for day in days], pa.int64()),
        ("cycles_with_air", ""): pa.array([day.known for day in days], pa.int64()),
        ("air", "Nl"): pa.array([day.air for day in days], pa.float64()),
        ("energy", "kWh"): pa.array([tariff.energy(day.air) for day in days], pa.float64()),
        ("cost", tariff.currency): pa.array(costs, pa.float64()),
    }
    fields = [
        pa.field(name, column.type, metadata={"unit": unit} if unit else None)
        for (name, unit), column in columns.items()
    ]
    return pa.table(list(columns.values()), pa.schema(fields))
