"""A table of another program, opened: its rows as blocks of samples."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from twin.errors import ConfigError, SourceError
from twin.signals import Samples, joined
from twin.tables.csv_file import CsvFile
from twin.tables.decode import Batch
from twin.tables.derive import Derived, derive
from twin.tables.intake import Intake
from twin.tables.layout import BELOW_AMBIENT, COMMANDS, Layout, find_layout
from twin.tables.parquet_file import ParquetFile
from twin.tables.settings import Column, ImportSettings
from twin.tables.unit_check import UnitCheck

Bits = npt.NDArray[np.uint8]


class _File(Protocol):
    names: list[str]  # of its columns

    def __init__(self, path: Path) -> None: ...

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
    def commands(self) -> str:
        """How commands were derived, in words; empty where the file has them."""
        return "" if self.derived is None else self.derived.words(self.layout.lacking)

    @property
    def counts_from_ambient(self) -> bool:
        """Whether the pressure's column is a vacuum."""
        return self.layout.pressure in BELOW_AMBIENT

    def with_commands(self) -> "Table":
        """The same with the commands that the file lacks, found from the pressure of all its rows.

        SourceError where there is no cycle in it, and otherwise as from ``blocks``.
        """
        try:
            # A vacuum counts from ambient; of an absolute pressure nobody knows where that is.
            zero = self.ambient if self.counts_from_ambient else None
            return replace(self, derived=derive(joined(*self.blocks()), zero))
        except SourceError as error:
            if self.path.name in str(error):
                raise
            raise SourceError(f"{self._file.place}: {error}", error.hint) from error

    def blocks(self) -> Iterator[Samples]:
        """Every row of the file in order, about 10 000 rows of SAMPLE at a time.

        SourceError names the line and column of the first bad input, once all blocks before its
        own are given, and says where a file ends without a row, or with pressures in another unit.
        """
        intake = Intake(self.layout, self.settings, self.ambient)
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


_KINDS: dict[str, type[_File]] = {".csv": CsvFile, ".parquet": ParquetFile}


def open_table(
    path: Path, settings: ImportSettings, ambient: float, *, derive: bool = False
) -> Table:
    """Open a CSV or Parquet file by its suffix and find its columns; ``ambient`` in Pa.

    With ``derive`` the file may lack commands, to be derived.
    ConfigError for another suffix, SourceError where the file cannot be read or lacks a column.
    """
    kind = _KINDS.get(path.suffix.lower())
    if not path.exists():
        raise SourceError(f"{path}: cannot be read: No such file or directory", "check the path")
    if kind is None:
        known = " and ".join(_KINDS)
        raise ConfigError(f"{path}: cannot tell what it is", f"{known} files can be read")
    file = kind(path)
    layout = find_layout(file.names, settings, file.place, derive=derive)
    return Table(path, layout, settings, ambient, file)
