"""A Parquet file as batches of columns."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa
from pyarrow import parquet

from twin.errors import SourceError
from twin.tables.first_cells import MOST_COLUMNS, MOST_ROWS
from twin.tables.numbers import is_readable
from twin.tables.parquet_pages import require_small_pages
from twin.tables.settings import Column, ImportSettings
from twin.tables.table_to_samples import Batch

_ROWS = 10_000
_BUFFER = 1 << 20  # bytes read ahead of each column, instead of a whole row group


class ParquetFile:
    """A Parquet file whose schema has been read; SourceError if there is none."""

    def __init__(self, path: Path, _settings: ImportSettings) -> None:
        self._path, self._is_checked = path, False
        self.notes: list[str] = []
        with self._opened() as file:
            self._schema = file.schema_arrow
            self.names: list[str] = self._schema.names

    @property
    def location(self) -> str:
        """The file, for messages on its columns."""
        return str(self._path)

    def first_rows(self) -> list[list[str]]:
        """Some rows after the header as text, for what is not known of the columns."""
        with self._opened() as file:  # column by column: one page is in memory
            columns = [
                self._first_cells(file, at) for at in range(min(MOST_COLUMNS, len(self.names)))
            ]
        columns += [[""] * MOST_ROWS] * (len(self.names) - len(columns))
        return [list(row) for row in zip(*columns, strict=False)]

    def _first_cells(self, file: parquet.ParquetFile, at: int) -> list[str]:
        kind = self._schema.field(at).type
        is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
        if not (is_text or pa.types.is_timestamp(kind)):
            return [""] * MOST_ROWS
        batch = next(file.iter_batches(MOST_ROWS, columns=[self.names[at]]), None)
        cells = [] if batch is None else batch.column(0).cast(pa.string()).to_pylist()
        return ["" if cell is None else cell.strip() for cell in cells]

    def batches(self, file_names: Mapping[Column, str]) -> Iterator[Batch]:
        """Give the rows in order, with the columns that ``file_names`` lists."""
        for name, header in file_names.items():
            kind = self._schema.field(header).type
            is_instant = name is Column.TIME and pa.types.is_timestamp(kind)
            if not (is_instant or is_readable(kind)):
                message = f"{self._path}: column {header!r} holds {kind}, which is no number"
                raise SourceError(message, "write it as integers or floating point numbers")
        first = 1
        with self._opened() as file:
            for table in file.iter_batches(_ROWS, columns=list(dict.fromkeys(file_names.values()))):
                table.validate(full=True)  # text must be UTF-8
                if table.num_rows:
                    yield self._batch(first, table, file_names)
                first += table.num_rows
            if first - 1 != file.metadata.num_rows:
                raise pa.ArrowInvalid(f"{first - 1} rows instead of {file.metadata.num_rows}")

    def _batch(self, first: int, table: pa.RecordBatch, file_names: Mapping[Column, str]) -> Batch:
        def location(row: int) -> str:
            return f"{self._path}: row {first + row}"

        def cell(row: int, name: Column) -> str:
            value = columns[name][row].as_py()
            return "" if value is None else str(value)

        columns = {name: table.column(header) for name, header in file_names.items()}
        return Batch(columns, table.num_rows, {}, location, cell)

    def _checked(self) -> BinaryIO:
        raw = self._path.open("rb")
        try:
            if not self._is_checked:  # once: it reads the head of each page
                require_small_pages(raw)
            raw.seek(0)
        except BaseException:
            raw.close()
            raise
        self._is_checked = True
        return raw

    @contextmanager
    def _opened(self) -> Iterator[parquet.ParquetFile]:
        try:
            with (
                self._checked() as raw,
                parquet.ParquetFile(
                    raw, buffer_size=_BUFFER, pre_buffer=False, page_checksum_verification=True
                ) as file,
            ):
                yield file
        except (pa.ArrowException, OSError, ValueError) as error:
            detail = getattr(error, "strerror", None) or str(error).strip().splitlines()[0]
            message = f"{self._path}: cannot be read as Parquet: {detail}"
            raise SourceError(message, "check the path, or export the file anew") from error
