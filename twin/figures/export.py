"""Key figures as a table for other programs: a row for each cycle."""

import pyarrow as pa

from twin.assets.unit import Unit
from twin.figures.database import SIDES, History
from twin.figures.table import FIGURES

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
