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
from twin.tables.decode import Batch
from twin.tables.derive import Derived, derive
from twin.tables.excel_file import ExcelFile
from twin.tables.intake import Intake
from twin.tables.layout import COMMANDS, Layout, find_layout
from twin.tables.parquet_file import ParquetFile
from twin.tables.settings import Column, ImportSettings
from twin.tables.unit_check import UnitCheck

Bits = npt.NDArray[np.uint8]
READING = np.dtype([(name, SAMPLE[name]) for name in ("time_ns", "pressure", "quality")])


class _File(Protocol):
    names: list[str]  # of its columns
    notes: list[str]  # what is to be said of how it was read

    def __init__(self, path: Path, settings: ImportSettings) -> None: ...

    @property
    def place(self) -> str:
        """Where the columns are named."""

    def batches(self, theirs: Mapping[Column, str]) -> Iterator[Batch]:
        """Give the rows in order, with the columns of these names in the file."""


@dataclass(frozen=True)
class Table:
    """A table whose columns are known; each iteration reads the file anew, a piece at a time."""

    path: Path
    layout: Layout
    settings: ImportSettings
    ambient: float  # Pa, from which a vacuum is counted
    _file: _File
    derived: Derived | None = None  # commands that the file lacks, once they are found

    @property
    def ignored(self) -> tuple[str, ...]:
        """Names of the columns in the file that are not taken."""
        return self.layout.ignored

    @property
    def notes(self) -> Sequence[str]:
        """What is to be said of how the file is read: its encoding, its sheet, its header."""
        return self._file.notes

    @property
    def commands(self) -> str:
        """How commands were derived, in words; empty where the file has them."""
        return "" if self.derived is None else self.derived.words(self.layout.lacking)

    @property
    def counts_from_ambient(self) -> bool:
        """Whether the pressure's column is a vacuum or gauge pressure."""
        return self.layout.meanings[self.layout.pressure].reference != "absolute"

    def with_commands(self) -> "Table":
        """The same with the commands that the file lacks, found from the pressure of all its rows.

        SourceError where there is no cycle in it, and otherwise as from ``blocks``.
        """
        try:
            # A vacuum counts from ambient; of an absolute pressure nobody knows where that is.
            zero = self.ambient if self.counts_from_ambient else None
            return replace(self, derived=derive(self._readings(), zero))
        except SourceError as error:
            if self.path.name in str(error):
                raise
            raise SourceError(f"{self._file.place}: {error}", error.hint) from error

    def _readings(self) -> Samples:
        """Time, pressure and quality of all rows; SourceError where they are more than may be."""
        blocks: list[Samples] = []
        count = 0
        for block in self.blocks():
            count += len(block)
            try:
                require_within_budget(count * READING.itemsize, "what commands are derived from")
            except ValueError as error:
                rows = MEMORY_BUDGET // READING.itemsize
                message = f"{self._file.place}: {error}"
                hint = f"import it in parts of at most {rows:,} rows".replace(",", " ")
                raise SourceError(message, hint) from error
            reading = np.empty(len(block), READING)
            for name in READING.names or ():
                reading[name] = block[name]
            blocks.append(reading)
        return joined(*blocks)

    def blocks(self) -> Iterator[Samples]:
        """Every row of the file in order, about 10 000 rows of SAMPLE at a time.

        SourceError names the line and column of the first bad input, once all blocks before its
        own are given, and says where a file ends without a row, or with pressures in another unit.
        """
        zone, order = self.settings.time_zone, self.settings.date_order
        calendar = Calendar(zone, order, self._file.place)
        intake = Intake(self.layout, self.settings, self.ambient, calendar)
        check = UnitCheck(self.layout, self.settings, self.ambient)
        block, first = None, 0
        for batch in self._file.batches(self.layout.theirs):
            block = intake.take(batch)
            if self.derived is not None:
                found = self.derived.commands[first : first + len(block)]
                block["commands"] |= self._lacking(found, block["commands"])
                first += len(block)
            check.see(block)
            yield block
        check.refuse(self._file.place)
        if block is None:
            raise SourceError(f"{self._file.place}: no row follows", "export it with its data")

    def _lacking(self, derived: Bits, there: Bits) -> Bits:
        """Those of the derived commands that the file lacks; none while it commands something."""
        bits = np.uint8(sum(COMMANDS[name].value for name in self.layout.lacking))
        return np.where(there == 0, derived & bits, np.uint8(0))


_KINDS: dict[str, type[_File]] = {
    ".csv": CsvFile,
    ".txt": CsvFile,
    ".tsv": CsvFile,
    ".xlsx": ExcelFile,
    ".parquet": ParquetFile,
}


def open_table(
    path: Path, settings: ImportSettings, ambient: float, *, derive: bool = False
) -> Table:
    """Open a CSV, Excel or Parquet file by its suffix and find its columns; ``ambient`` in Pa.

    With ``derive`` the file may lack commands, to be derived.
    ConfigError for another suffix, SourceError where the file cannot be read or lacks a column.
    """
    kind = _KINDS.get(path.suffix.lower())
    if not path.exists():
        raise SourceError(f"{path}: cannot be read: No such file or directory", "check the path")
    if kind is None:
        known = ", ".join(_KINDS)
        raise ConfigError(f"{path}: cannot tell what it is", f"{known} files can be read")
    file = kind(path, settings)
    layout = find_layout(file.names, settings, file.place, derive=derive)
    return Table(path, layout, settings, ambient, file)
