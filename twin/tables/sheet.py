"""A table as a file for other programs and for people: CSV, Parquet, or a spreadsheet."""

import math
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv, parquet
from xlsxwriter import Workbook
from xlsxwriter.format import Format
from xlsxwriter.worksheet import Worksheet

from twin.errors import ConfigError
from twin.files import require_ending
from twin.tables.export import complete_file

MOST_ROWS = 1_048_575  # of a sheet, below its header
EXACT = 2**53  # whole numbers beyond it are not kept by a spreadsheet: they become text
TIME = "yyyy-mm-dd hh:mm:ss.000"
# Programs that open CSV take such text for a formula; an apostrophe before it keeps it text.
_FORMULA = r"^([=+\-@\t\r])"


def export(table: pa.Table, path: Path, *, force: bool = False) -> None:
    """Write a table in the format of the suffix, completely or not at all; times are UTC.

    The unit of a column is its field's metadata ``unit``. ConfigError for another suffix or too
    many rows. SourceError if there is a file of that name and no ``force``, or it cannot be
    written.
    """
    write = _KINDS[require_ending(path, *_KINDS)]
    if write is _write_sheet and table.num_rows > MOST_ROWS:
        raise ConfigError(
            f"{path}: {table.num_rows} rows are more than a sheet holds ({MOST_ROWS})",
            "take fewer days, or *.csv",
        )
    with complete_file(path, force=force) as file:
        write(table, file)


def _write_csv(table: pa.Table, file: BinaryIO) -> None:
    for at, field in enumerate(table.schema):
        if pa.types.is_string(field.type):
            harmless = pc.replace_substring_regex(table.column(at), _FORMULA, r"'\1")
            table = table.set_column(at, field, harmless)
    csv.write_csv(table, file, csv.WriteOptions(quoting_style="needed"))


def _write_parquet(table: pa.Table, file: BinaryIO) -> None:
    parquet.write_table(table, file, compression="zstd", write_page_checksum=True)


def _write_sheet(table: pa.Table, file: BinaryIO) -> None:
    """Write one sheet; its frozen header has the units."""
    with Workbook(file, {"constant_memory": True, "remove_timezone": True}) as book:
        sheet = book.add_worksheet()
        bold, time = book.add_format({"bold": True}), book.add_format({"num_format": TIME})
        for at, field in enumerate(table.schema):
            head = _head(field)
            sheet.set_column(at, at, max(len(head) + 2, 24 if _is_time(field) else 0))
            sheet.write_string(0, at, head, bold)
        sheet.freeze_panes(1, 0)
        sheet.autofilter(0, 0, table.num_rows, table.num_columns - 1)
        for row, values in enumerate(_rows(table), 1):
            for column, value in enumerate(values):
                _write(sheet, row, column, value, time)


def _head(field: pa.Field) -> str:
    unit = (field.metadata or {}).get(b"unit", b"").decode()
    if _is_time(field):
        unit = "UTC"
    return f"{field.name} ({unit})" if unit else str(field.name)


def _is_time(field: pa.Field) -> bool:
    return bool(pa.types.is_timestamp(field.type))


def _rows(table: pa.Table) -> Iterator[tuple[Any, ...]]:
    """Rows as Python values, one batch in memory; times to the microsecond."""
    fields = [
        pa.field(field.name, pa.timestamp("us", "UTC")) if _is_time(field) else field
        for field in table.schema
    ]
    columns = [
        pc.cast(column, field.type, safe=False) if _is_time(field) else column
        for column, field in zip(table.columns, fields, strict=True)
    ]
    for batch in pa.table(columns, pa.schema(fields)).to_batches(10_000):
        yield from zip(*(column.to_pylist() for column in batch.columns), strict=True)


def _write(sheet: Worksheet, row: int, column: int, value: Any, time: Format) -> None:
    """Write a value by its type: text never becomes a formula."""
    if isinstance(value, datetime):
        sheet.write_datetime(row, column, value, time)
    elif isinstance(value, str):
        sheet.write_string(row, column, value)
    elif isinstance(value, int) and abs(value) > EXACT:
        sheet.write_string(row, column, str(value))
    elif value is not None and math.isfinite(value):
        sheet.write_number(row, column, value)


_KINDS: dict[str, Callable[[pa.Table, BinaryIO], None]] = {
    ".csv": _write_csv,
    ".parquet": _write_parquet,
    ".xlsx": _write_sheet,
}
