"""A CSV file as batches of text; every line of it is a row, a comment or empty.

Lines end where they end: a quoted cell does not go on in the next line, so that one stray quotation
mark cannot swallow rows.
"""

import csv
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv

from twin.errors import SourceError
from twin.tables.decode import Batch
from twin.tables.settings import Column

_PIECE = 1 << 19  # bytes, about 10 000 rows
_LONGEST_LINE = 1 << 20  # bytes
_UNIT = "\x1f"  # stands between cells that had quotation marks
_UNKNOWN = "\ufffd"
_NO_CSV = "export it from the PLC's tool as CSV in UTF-8, with commas or semicolons"


class CsvFile:
    """A CSV file of which the header is read; SourceError where it is none."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._head, header = next(self._header(), (1, ""))
        if not header:
            raise SourceError(f"{path}: there is no header row", "name the columns in a first row")
        self._separator = ";" if ";" in header else ","
        self.names = [name.strip() for name in self._cells(header)]

    @property
    def place(self) -> str:
        """Where the header stands."""
        return f"{self._path}:{self._head}"

    def batches(self, theirs: Mapping[Column, str]) -> Iterator[Batch]:
        """Give the rows in order, with the columns of these names in the file."""
        index = {name: self.names.index(there) for name, there in theirs.items()}
        for first, piece in _pieces(self._path):
            skipped = max(0, self._head + 1 - first)  # the header and what is before it
            lines = piece[skipped:]
            rows = [line for line in lines if _is_row(line)]
            if rows:
                yield self._batch(first + skipped, lines, rows, index)

    def _header(self) -> Iterator[tuple[int, str]]:
        for first, lines in _pieces(self._path):
            for number, line in enumerate(lines, first):
                if "\0" in line:
                    raise SourceError(f"{self._path}:{number}: this is no text", _NO_CSV)
                if _is_row(line):
                    yield number, line

    def _cells(self, line: str) -> list[str]:
        if '"' not in line:
            return line.split(self._separator)
        try:
            return next(csv.reader([line], delimiter=self._separator))
        except csv.Error:  # a cell longer than any number
            return line.split(self._separator)

    def _batch(
        self, first: int, lines: list[str], rows: list[str], index: Mapping[Column, int]
    ) -> Batch:
        def place(row: int) -> str:
            numbers = [number for number, line in enumerate(lines, first) if _is_row(line)]
            return f"{self._path}:{numbers[row]}"

        def cell(row: int, name: Column) -> str:
            return self._cells(rows[row])[index[name]].strip()

        broken: dict[int, str] = {}
        table = self._split(rows, [str(position) for position in index.values()], broken)
        columns = {name: table.column(str(position)) for name, position in index.items()}
        return Batch(columns, len(rows), broken, place, cell)

    def _unquoted(self, rows: list[str]) -> tuple[str, str]:
        """Rows as lines with decimal points and without quotation marks, and their separator."""
        text, separator = "\n".join(rows), self._separator
        if '"' in text:
            cells = (self._cells(row.replace(_UNIT, _UNKNOWN)) for row in rows)
            # What is but a quotation mark is a row too; Arrow leaves out empty lines.
            text, separator = "\n".join(_UNIT.join(row) or _UNKNOWN for row in cells), _UNIT
        return text.replace(",", ".") if self._separator == ";" else text, separator

    def _split(self, rows: list[str], wanted: list[str], broken: dict[int, str]) -> pa.Table:
        """Columns of text; a row with another number of cells is null and goes to ``broken``."""

        def skip(row: arrow_csv.InvalidRow) -> str:
            broken[row.number - 1] = f"{row.actual_columns} cells under {len(self.names)} columns"
            return "skip"

        text, separator = self._unquoted(rows)
        data = text.encode()
        table = arrow_csv.read_csv(
            pa.BufferReader(data),
            arrow_csv.ReadOptions(
                use_threads=False,
                block_size=len(data) + 1,
                column_names=[str(position) for position in range(len(self.names))],
            ),
            arrow_csv.ParseOptions(delimiter=separator, quote_char=False, invalid_row_handler=skip),
            arrow_csv.ConvertOptions(
                include_columns=wanted, column_types=dict.fromkeys(wanted, pa.string())
            ),
        )
        return _with_gaps(table, broken, len(rows)) if broken else table


def _with_gaps(table: pa.Table, missing: Mapping[int, str], count: int) -> pa.Table:
    """A table of ``count`` rows, those that are missing null."""
    absent = np.zeros(count, bool)
    absent[list(missing)] = True
    return table.take(pa.array(np.cumsum(~absent) - 1, mask=absent))


def _is_row(line: str) -> bool:
    start = line.lstrip()[:1]
    return start not in {"", "#"}


def _pieces(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The lines of a file, many at a time, with the number of the first one."""
    first = 1
    try:
        for piece in _whole_lines(path):
            lines = piece.decode("utf-8-sig" if first == 1 else "utf-8", "replace")
            yield first, (cut := _cut(lines))
            first += len(cut)
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise SourceError(message, "check the path") from error


def _cut(text: str) -> list[str]:
    """At the ends of lines, of whatever system they are, and at nothing else."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return lines if lines[-1] else lines[:-1]


def _whole_lines(path: Path) -> Iterator[bytes]:
    rest = b""
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            head, end, rest = (rest + piece).rpartition(b"\n")
            if len(rest) > _LONGEST_LINE:
                raise SourceError(f"{path}: there is a line of more than 1 MiB", _NO_CSV)
            if end:
                yield head + end
    if rest:
        yield rest
