"""A sheet of an Excel file as batches of text."""

import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import date, datetime, time
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
from openpyxl import load_workbook

from twin.errors import SourceError, known_names
from twin.files import unzipped_within_budget
from twin.tables import first_cells
from twin.tables.layout import wanted_names
from twin.tables.settings import Column, ImportSettings
from twin.tables.table_to_samples import Batch

_ROWS = 10_000
_DECIMAL_COMMA = re.compile(r"[+-]?[0-9]+,[0-9]+")  # of a number that was pasted as text
_PREAMBLE = 200  # rows that may stand before the header

Cells = tuple[Any, ...]


class ExcelFile:
    """One sheet of an Excel file whose header has been read; SourceError if there is none."""

    def __init__(self, path: Path, settings: ImportSettings) -> None:
        self._path, self._settings = path, settings
        self.notes: list[str] = []
        known_names = wanted_names(settings)
        with self._rows(self.notes) as rows:
            first = [(number, cells) for number, cells in islice(rows, _PREAMBLE) if any(cells)]
        self._first = first
        if not first:
            raise SourceError(f"{path}: there is no header row", "name the columns in a first row")
        fits = (row for row in first if known_names & {_text(cell) for cell in row[1]})
        self._head, header = next(fits, max(first, key=lambda row: _words(row[1])))
        self.names = [_text(cell) for cell in header]

    @property
    def location(self) -> str:
        """File and row of the header."""
        return f"{self._path}: row {self._head}"

    def first_rows(self) -> list[list[str]]:
        """Some rows after the header as text, for what is not known of the columns."""
        below = (cells for number, cells in self._first if number > self._head)
        return [
            [_text(cell) for cell in [*cells, *[None] * len(self.names)][: len(self.names)]]
            for cells in islice(below, first_cells.MOST_ROWS)
        ]

    def batches(self, file_names: Mapping[Column, str]) -> Iterator[Batch]:
        """Give the rows in order, with the columns that ``file_names`` lists."""
        index = {name: self.names.index(header) for name, header in file_names.items()}
        with self._rows([]) as rows:
            filled = ((n, cells) for n, cells in rows if n > self._head and _has_value(cells))
            while chunk := list(islice(filled, _ROWS)):
                yield self._batch(chunk, index)

    def _batch(self, rows: list[tuple[int, Cells]], index: Mapping[Column, int]) -> Batch:
        def location(row: int) -> str:
            return f"{self._path}: row {rows[row][0]}"

        def cell(row: int, name: Column) -> str:
            return columns[name][row].as_py() or ""

        columns = {  # a row may end before its last columns
            name: pa.array([_text(cells[at]) if at < len(cells) else "" for _, cells in rows])
            for name, at in index.items()
        }
        return Batch(columns, len(rows), {}, location, cell)

    @contextmanager
    def _rows(self, notes: list[str]) -> Iterator[Iterator[tuple[int, Cells]]]:
        """Rows with their numbers; ``notes`` receives a remark on the choice of a sheet."""
        with self._source_errors(), self._path.open("rb") as file:
            with zipfile.ZipFile(file) as archive:
                try:
                    unzipped_within_budget(archive)
                except ValueError as error:
                    message = f"{self._path}: {error}"
                    raise SourceError(message, "save the sheet as CSV: it has no bound") from error
            with warnings.catch_warnings(action="ignore"):  # about styles, which are not needed
                book = load_workbook(file, read_only=True, data_only=True)
            try:
                names = book.sheetnames
                sheet = self._settings.sheet or names[0]
                if sheet not in names:
                    text = f"{self._path}: no sheet is called {sheet!r}"
                    raise SourceError(text, known_names(sheet, names))
                if len(names) > 1 and not self._settings.sheet:
                    others = " or ".join(repr(name) for name in names if name != sheet)
                    notes.append(f"sheet {sheet!r} is read; sheet of [import] chooses {others}")
                yield enumerate(book[sheet].iter_rows(values_only=True), 1)
            finally:
                book.close()

    @contextmanager
    def _source_errors(self) -> Iterator[None]:
        """Turn errors into SourceError if the file cannot be opened or is no Excel file."""
        try:
            yield
        except SourceError:
            raise
        except OSError as error:
            message = f"{self._path}: cannot be read: {error.strerror or error}"
            raise SourceError(message, "check the path") from error
        except Exception as error:  # the library passes on errors of zip, zlib and XML
            detail = str(error).partition("\n")[0] or type(error).__name__
            message = f"{self._path}: cannot be read as an Excel file (.xlsx): {detail}"
            raise SourceError(message, "save it anew as .xlsx, or as CSV") from error


def _has_value(cells: Cells) -> bool:
    return any(cell is not None and cell != "" for cell in cells)


def _words(cells: Cells) -> int:
    return sum(any(map(str.isalpha, _text(cell))) for cell in cells)


def _text(cell: Any) -> str:
    """A cell as text, as in CSV with decimal points; dates as ISO 8601."""
    if cell is None:
        return ""
    if isinstance(cell, datetime):
        return cell.isoformat(" ")
    if isinstance(cell, date | time):
        return cell.isoformat()
    if isinstance(cell, float):
        return repr(cell)
    text = str(cell).strip()
    return text.replace(",", ".") if _DECIMAL_COMMA.fullmatch(text) else text
