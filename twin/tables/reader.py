"""A table of another program, opened: its rows as blocks of samples."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from twin.errors import ConfigError, SourceError
from twin.files import MEMORY_BUDGET, require_within_budget
from twin.signals import SAMPLE, Samples, joined
from twin.tables.csv_file import CsvFile
from twin.tables.date_time import Calendar
from twin.tables.derive import Derived, derive
from twin.tables.excel_file import ExcelFile
from twin.tables.first_cells import FirstCells
from twin.tables.intake import Intake
from twin.tables.layout import COMMANDS, Layout, find_layout
from twin.tables.parquet_file import ParquetFile
from twin.tables.settings import Column, ImportSettings
from twin.tables.table_to_samples import Batch
from twin.tables.unit_check import UnitCheck

Bits = npt.NDArray[np.uint8]
READING = np.dtype([(name, SAMPLE[name]) for name in ("time_ns", "pressure", "quality")])


class _File(Protocol):
    names: list[str]  # of its columns
    notes: list[str]  # remarks on how it was read

    def __init__(self, path: Path, settings: ImportSettings) -> None: ...

    @property
    def location(self) -> str:
        """File and line of the columns' names, for messages."""

    def first_rows(self) -> list[list[str]]:
        """Some rows after the header as text, for what is not known of the columns."""

    def batches(self, file_names: Mapping[Column, str]) -> Iterator[Batch]:
        """Give the rows in order, with the columns that ``file_names`` lists."""


@dataclass(frozen=True)
class Table:
    """A table with its columns identified; each iteration reads the file anew, piece by piece."""

    path: Path
    layout: Layout
    settings: ImportSettings
    ambient: float  # Pa, the zero of a vacuum
    _file: _File
    derived: Derived | None = None  # commands that the file lacks, once derived

    @property
    def ignored(self) -> tuple[str, ...]:
        """Names of the columns in the file that are not read."""
        return self.layout.ignored

    @property
    def notes(self) -> Sequence[str]:
        """Remarks on how the file is read: its encoding, its sheet, its header."""
        return self._file.notes

    @property
    def commands(self) -> str:
        """Text on how commands were derived; empty if the file has them."""
        return "" if self.derived is None else self.derived.words(self.layout.lacking)

    @property
    def counts_from_ambient(self) -> bool:
        """Whether the pressure's column is a vacuum or gauge pressure."""
        return self.layout.meanings[self.layout.pressure].reference != "absolute"

    def with_commands(self) -> "Table":
        """The same with the commands that the file lacks, derived from all of its pressures.

        SourceError if it shows no cycle, and otherwise as from ``blocks``.
        """
        try:
            # A vacuum counts from ambient. With an absolute pressure, ambient is unknown.
            zero = self.ambient if self.counts_from_ambient else None
            return replace(self, derived=derive(self._readings(), zero))
        except SourceError as error:
            if self.path.name in str(error):
                raise
            raise SourceError(f"{self._file.location}: {error}", error.hint) from error

    def _readings(self) -> Samples:
        """Time, pressure and quality of all rows; SourceError if they exceed the memory budget."""
        blocks: list[Samples] = []
        count = 0
        for block in self.blocks():
            count += len(block)
            try:
                require_within_budget(count * READING.itemsize, "what commands are derived from")
            except ValueError as error:
                rows = MEMORY_BUDGET // READING.itemsize
                message = f"{self._file.location}: {error}"
                hint = f"import it in parts of at most {rows:,} rows".replace(",", " ")
                raise SourceError(message, hint) from error
            reading = np.empty(len(block), READING)
            for name in READING.names or ():
                reading[name] = block[name]
            blocks.append(reading)
        return joined(*blocks)

    def blocks(self) -> Iterator[Samples]:
        """Every row of the file in order, about 10 000 rows of SAMPLE at a time.

        SourceError names line and column of the first bad input, after all blocks before it have
        been given. It is also raised for a file without rows, or with implausible pressures.
        """
        zone, order = self.settings.time_zone, self.settings.date_order
        calendar = Calendar(zone, order, self._file.location)
        intake = Intake(self.layout, self.settings, self.ambient, calendar)
        check = UnitCheck(self.layout, self.settings, self.ambient)
        block, first = None, 0
        for batch in self._file.batches(self.layout.file_names):
            block = intake.take(batch)
            if self.derived is not None:
                derived = self.derived.commands[first : first + len(block)]
                block["commands"] |= self._lacking(derived, block["commands"])
                first += len(block)
            check.see(block)
            yield block
        check.refuse(self._file.location)
        if block is None:
            raise SourceError(f"{self._file.location}: no row follows", "export it with its data")

    def _lacking(self, derived: Bits, commanded: Bits) -> Bits:
        """The derived commands that the file lacks; none where the file commands something."""
        bits = np.uint8(sum(COMMANDS[name].value for name in self.layout.lacking))
        return np.where(commanded == 0, derived & bits, np.uint8(0))


_KINDS: dict[str, type[_File]] = {
    ".csv": CsvFile,
    ".txt": CsvFile,
    ".tsv": CsvFile,
    ".xlsx": ExcelFile,
    ".parquet": ParquetFile,
}

_OTHER_FORMATS = {  # what to do with them
    ".svdx": "export one in TwinCAT Scope: Export to csv",
    ".ttrecx": "export one in TIA Portal: Export measurement, as *.csv",
    ".trace": "export one in CODESYS: Save Trace, as *.txt",
    ".xls": "save it as *.xlsx",
    ".mcap": "a log needs no import, as in: twin diagnose LOG.mcap",
}


def open_table(
    path: Path, settings: ImportSettings, ambient: float, *, derive: bool = False
) -> Table:
    """Open a CSV, Excel or Parquet file by its suffix and find its columns; ``ambient`` in Pa.

    With ``derive`` the file may lack commands, to be derived.
    ConfigError for another suffix, SourceError if the file cannot be read or lacks a column.
    """
    kind = _KINDS.get(path.suffix.lower())
    if not path.exists():
        raise SourceError(f"{path}: cannot be read: No such file or directory", "check the path")
    if kind is None:
        suffixes = ", ".join(_KINDS)
        advice = _OTHER_FORMATS.get(path.suffix.lower())
        hint = f"{suffixes} files can be read" + (f"; {advice}" if advice else "")
        raise ConfigError(f"{path}: cannot tell what it is", hint)
    file = kind(path, settings)
    try:
        layout = find_layout(
            file.names, settings, file.location, lambda: _first_cells(file), derive=derive
        )
    except SourceError as error:  # another sheet or encoding may have the column
        error.hint = "\n  ".join((*file.notes, error.hint))
        raise
    return Table(path, layout, settings, ambient, file)


def _first_cells(file: _File) -> FirstCells:
    """The first cells of each column, by its name; none where they cannot be read."""
    try:
        rows = file.first_rows()
    except SourceError:
        return {}
    whole = [row for row in rows if len(row) >= len(file.names)]
    return {name: [row[at] for row in whole] for at, name in enumerate(file.names)}
