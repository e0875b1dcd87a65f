"""A CSV file as batches of text; every line is a row, a comment or empty.

A quoted cell does not continue in the next line, so that one stray quotation mark cannot swallow
rows. The header is the first row that has the name of a known column; rows before it are not read.
"""

import codecs
import csv
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv

from twin.errors import SourceError
from twin.tables import first_cells, scope
from twin.tables.layout import wanted_names
from twin.tables.settings import Column, Encoding, ImportSettings
from twin.tables.table_to_samples import Batch

_PIECE = 1 << 19  # characters, about 10 000 rows
_LOOK = 1 << 19  # bytes that decide the encoding
_LONGEST_LINE = 1 << 20  # characters
_UNIT = "\x1f"  # stands between cells that had quotation marks
_UNKNOWN = "\ufffd"
_SEPARATORS = (";", "\t", ",", " ")  # on a tie the first that the header has
_PREAMBLE = 200  # rows that may stand before the header
_NO_CSV = "export it from the PLC's tool as CSV, with commas, semicolons or tabs"
_MARKS: tuple[tuple[bytes, Encoding], ...] = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


class CsvFile:
    """A CSV file whose header has been read; SourceError if there is none."""

    def __init__(self, path: Path, settings: ImportSettings) -> None:
        self._path = path
        self.notes: list[str] = []
        self._encoding = settings.encoding or self._detected_encoding()
        known_names = wanted_names(settings)
        rows = self._rows()
        header = _find_header(islice(rows, _PREAMBLE), known_names)
        if header is None:
            raise SourceError(f"{path}: there is no header row", "name the columns in a first row")
        self._head, self._separator = header.line, header.separator
        self.names = _cells(header.text, self._separator)
        if header.before:
            self.notes.append(f"the header is line {self._head}; what stands before it is not read")
        self._first = self._head + 1  # first line that may hold values
        self._is_row: Callable[[str], bool] = _is_row
        self._whole: Callable[[str], str] = str
        if self.names[0] == scope.NAME:
            below = [(line, _cells(row, self._separator)) for line, row in islice(rows, _PREAMBLE)]
            self._find_channels(below, known_names)

    @property
    def location(self) -> str:
        """File and line of the header."""
        return f"{self._path}:{self._head}"

    def first_rows(self) -> list[list[str]]:
        """Some rows after the header as text, for what is not known of the columns."""
        rows = (row for line, row in self._rows() if line >= self._first and self._is_row(row))
        return [
            _cells(self._whole(row), self._separator) for row in islice(rows, first_cells.MOST_ROWS)
        ]

    def batches(self, file_names: Mapping[Column, str]) -> Iterator[Batch]:
        """Give the rows in order, with the columns that ``file_names`` lists."""
        index = {name: self.names.index(header) for name, header in file_names.items()}
        for first, piece in self._pieces():
            skipped = max(0, self._first - first)  # the header and what is before it
            lines = piece[skipped:]
            rows = [self._whole(line) for line in lines if self._is_row(line)]
            if rows:
                yield self._batch(first + skipped, lines, rows, index)

    def _detected_encoding(self) -> Encoding:
        """The encoding by a byte order mark, or by whether the first piece is valid UTF-8."""
        with _opened(self._path), self._path.open("rb") as file:
            start = file.read(_LOOK)
        for mark, encoding in _MARKS:
            if start.startswith(mark):
                if encoding != "utf-8":
                    self.notes.append("read as UTF-16, as its first bytes say")
                return encoding
        try:
            codecs.getincrementaldecoder("utf-8")().decode(start)
        except UnicodeDecodeError:
            encodings = ", ".join(get_args(Encoding))
            self.notes.append(
                "it is not UTF-8: read as cp1252 (Windows, western Europe); if names look wrong,"
                f" say encoding under [import], one of {encodings}"
            )
            return "cp1252"
        return "utf-8"

    def _rows(self) -> Iterator[tuple[int, str]]:
        for first, lines in self._pieces():
            for number, line in enumerate(lines, first):
                if "\0" in line:
                    hint = f'{_NO_CSV}; if it is UTF-16, say encoding = "utf-16-le" under [import]'
                    raise SourceError(f"{self._path}:{number}: this is no text", hint)
                if _is_row(line):
                    yield number, line

    def _batch(
        self, first: int, lines: list[str], rows: list[str], index: Mapping[Column, int]
    ) -> Batch:
        def location(row: int) -> str:
            numbers = [number for number, line in enumerate(lines, first) if self._is_row(line)]
            return f"{self._path}:{numbers[row]}"

        def cell(row: int, name: Column) -> str:
            return _cells(rows[row], self._separator)[index[name]]

        broken: dict[int, str] = {}
        table = self._split(rows, [str(position) for position in index.values()], broken)
        columns = {name: table.column(str(position)) for name, position in index.items()}
        return Batch(columns, len(rows), broken, location, cell)

    def _unquoted(self, rows: list[str]) -> tuple[str, str]:
        """Rows as lines with decimal points and without quotation marks, and their separator."""
        text, separator = "\n".join(rows), self._separator
        if '"' in text or separator == " ":
            cells = (_cells(row.replace(_UNIT, _UNKNOWN), separator) for row in rows)
            # A lone quotation mark is a row too, but Arrow skips empty lines.
            text, separator = "\n".join(_UNIT.join(row) or _UNKNOWN for row in cells), _UNIT
        return text if self._separator == "," else text.replace(",", "."), separator

    def _split(self, rows: list[str], positions: list[str], broken: dict[int, str]) -> pa.Table:
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
                include_columns=positions, column_types=dict.fromkeys(positions, pa.string())
            ),
        )
        return _with_gaps(table, broken, len(rows)) if broken else table

    def _find_channels(self, below: scope.Rows, wanted: set[str]) -> None:
        """Where values and times are, if the file is an export of TwinCAT Scope."""
        if not scope.has_properties(below):
            return
        self._first, self.names, self._time = scope.values(self.names, below, wanted, self.location)
        self._is_row, self._whole = self._is_row_of_scope, self._whole_row_of_scope
        self.notes.append("it is of TwinCAT Scope: all channels have the same times")

    def _is_row_of_scope(self, line: str) -> bool:
        """Whether a line has values of the channels that are read; others may go on longer."""
        if not line.strip() or line.strip() == scope.END:
            return False
        cells = _cells(line, self._separator)
        return self._time < len(cells) and cells[self._time] != ""

    def _whole_row_of_scope(self, line: str) -> str:
        """A line with all its cells: those of channels that have ended may be left out."""
        return line + self._separator * (len(self.names) - 1 - line.count(self._separator))

    def _pieces(self) -> Iterator[tuple[int, list[str]]]:
        """The lines of the file in pieces, each with the number of its first line."""
        first = 1
        with _opened(self._path):
            for piece in _whole_lines(self._path, self._encoding):
                yield first, (lines := _cut(piece))
                first += len(lines)


class _Header(NamedTuple):
    line: int
    text: str
    separator: str
    before: int  # rows


def _find_header(rows: Iterator[tuple[int, str]], known_names: set[str]) -> _Header | None:
    """The first row that has a known name, else the one with the most words."""
    wordiest: tuple[int, _Header | None] = -1, None
    for before, (line, row) in enumerate(rows):
        by_fit = {
            sign: len(known_names & set(_cells(row, sign))) for sign in _SEPARATORS if sign in row
        }
        separator = max(by_fit, key=by_fit.__getitem__, default=",")
        header = _Header(line, row, separator, before)
        if by_fit and by_fit[separator]:
            return header
        words = sum(any(map(str.isalpha, cell)) for cell in _cells(row, separator))
        if words > wordiest[0]:
            wordiest = words, header
    return wordiest[1]


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        cells = next(csv.reader([line], delimiter=separator))
    except csv.Error:  # a cell longer than any number
        cells = line.split(separator)
    return [cell.strip() for cell in cells]


def _with_gaps(table: pa.Table, missing: Mapping[int, str], count: int) -> pa.Table:
    """A table of ``count`` rows; missing rows are null."""
    absent = np.zeros(count, bool)
    absent[list(missing)] = True
    return table.take(pa.array(np.cumsum(~absent) - 1, mask=absent))


def _is_row(line: str) -> bool:
    start = line.lstrip()[:1]
    return start not in {"", "#"}


@contextmanager
def _opened(path: Path) -> Iterator[None]:
    """Turn OSError into SourceError for a file that cannot be opened or read."""
    try:
        yield
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise SourceError(message, "check the path") from error


def _cut(text: str) -> list[str]:
    """Lines of a text, cut at the line ends of any system and nowhere else."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return lines if lines[-1] else lines[:-1]


def _whole_lines(path: Path, encoding: Encoding) -> Iterator[str]:
    remainder = ""
    codec = "utf-8-sig" if encoding == "utf-8" else encoding
    with path.open(encoding=codec, errors="replace", newline="") as file:
        while piece := file.read(_PIECE):
            head, end, remainder = (remainder + piece).rpartition("\n")
            if len(remainder) > _LONGEST_LINE:
                raise SourceError(f"{path}: there is a line of more than 1 MiB", _NO_CSV)
            if end:
                yield head + end
    if remainder:
        yield remainder
