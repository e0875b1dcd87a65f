"""Preview of how a table is read: its columns, its first rows, and a small plot."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from twin.signals import MBAR, MS, NS, Command, Samples
from twin.tables.reader import Table
from twin.tables.settings import TIMES, Column

FIRST = 8  # rows that are shown
WIDTH, HEIGHT = 72, 10  # of the plot, in characters

Floats = npt.NDArray[np.float64]


@dataclass
class Preview:
    """Collects a table's rows, block by block; memory does not grow with their number."""

    table: Table
    _first: Samples | None = None
    _last_ns: int = 0
    _rows: int = 0
    _steps: list[int] = field(default_factory=list)  # ns, of the first block
    _every: int = 1  # rows in a bin
    _bins: Floats = field(default_factory=lambda: np.empty((0, 3)))  # low, high (Pa), suction
    _rest: Floats = field(default_factory=lambda: np.empty((0, 3)))  # rows of an incomplete bin

    def see(self, block: Samples) -> None:
        """Add a block of rows."""
        if self._first is None:
            self._first = block[:FIRST].copy()
            self._steps = np.diff(block["time_ns"]).tolist()
        self._last_ns = int(block["time_ns"][-1])
        self._rows += len(block)
        pressure = block["pressure"].astype(np.float64)
        suction = (block["commands"] & Command.SUCTION.value) != 0
        rows = np.concatenate((self._rest, np.stack((pressure, pressure, suction), axis=1)))
        complete = len(rows) // self._every * self._every
        self._bins = np.concatenate((self._bins, _binned(rows[:complete], self._every)))
        self._rest = rows[complete:]
        while len(self._bins) > 4 * WIDTH:
            odd = len(self._bins) % 2
            even = self._bins[: len(self._bins) - odd]
            self._bins = np.concatenate((_binned(even, 2), self._bins[len(even) :]))
            self._every *= 2

    def __str__(self) -> str:
        lines = [*self._columns()]
        if self._first is not None:
            lines += ["", *self._table(), "", *self._plot()]
        return "\n".join(lines)

    def _columns(self) -> Iterator[str]:
        layout, zone = self.table.layout, self.table.settings.time_zone
        width = max(len(repr(header)) for header in layout.file_names.values())
        for name, header in layout.file_names.items():
            meaning = layout.meanings.get(name)
            description = str(name)
            if meaning is not None:
                description = f"{name.partition('_')[0]} in {meaning}"
            elif name is Column.TIME:
                description = (
                    f"date and time, {f'in {zone} where no zone stands' if zone else 'as it says'}"
                )
            elif name in TIMES:
                description = f"time in {name.rpartition('_')[2]}"
            yield f"{header!r:{width}}  {description}"
        for header in layout.ignored:
            yield f"{header!r:{width}}  not taken"

    def _table(self) -> Iterator[str]:
        if self._first is None:
            return
        begin = int(self._first["time_ns"][0])
        has_supply = bool(np.isfinite(self._first["supply"]).any())
        names = ("ms since begin", "suction", "blow-off", "mbar abs.", "vacuum mbar", "supply bar")
        widths = (14, 8, 8, 10, 12, 11)[: 6 if has_supply else 5]
        yield " ".join(f"{name:>{width}}" for name, width in zip(names, widths, strict=False))
        for row in self._first:
            since = (int(row["time_ns"]) - begin) * NS / MS
            bits = [int(bool(row["commands"] & bit.value)) for bit in Command]
            absolute = float(row["pressure"])
            text = f"{since:14.3f} {bits[0]:8d} {bits[1]:8d} {absolute / MBAR:10.1f}"
            text += f" {(self.table.ambient - absolute) / MBAR:12.1f}"
            yield text + (f" {float(row['supply']) / 1e5:11.2f}" if has_supply else "")

    def _plot(self) -> Iterator[str]:
        bins = np.concatenate((self._bins, self._rest))
        is_finite = np.isfinite(bins[:, 0])
        lasted = (
            (self._last_ns - int(self._first["time_ns"][0])) * NS
            if self._first is not None
            else 0.0
        )
        period = f", every {np.median(self._steps) * NS / MS:g} ms" if self._steps else ""
        yield f"{self._rows} rows, {lasted:.3f} s{period}"
        if not is_finite.any():
            yield "no pressure in them"
            return
        low, high = np.nanmin(bins[:, 0]), np.nanmax(bins[:, 1])
        yield f"pressure from {low / MBAR:.1f} to {high / MBAR:.1f} mbar absolute"
        edges = np.linspace(0, len(bins), min(WIDTH, len(bins)) + 1).astype(int)
        groups = [bins[first:last] for first, last in itertools.pairwise(edges)]
        yield from _curve(groups, float(low), float(high))
        yield f"{'suction':>8} " + "".join("█" if group[:, 2].any() else "·" for group in groups)


def _binned(rows: Floats, every: int) -> Floats:
    """Low, high and suction of each ``every`` rows."""
    groups = rows.reshape(-1, every, 3)
    low = np.fmin.reduce(groups[:, :, 0], axis=1)
    return np.stack(
        (low, np.fmax.reduce(groups[:, :, 1], axis=1), groups[:, :, 2].max(axis=1)), axis=1
    )


def _curve(groups: list[Floats], low: float, high: float) -> Iterator[str]:
    """Lines from the highest pressure (Pa) to the lowest, one character for each group."""
    step = max(high - low, 1.0) / HEIGHT
    for line in range(HEIGHT):
        bottom = high - (line + 1) * step
        marks = []
        for group in groups:
            least, most = np.fmin.reduce(group[:, 0]), np.fmax.reduce(group[:, 1])
            top = bottom + step if line else np.inf
            inside = most >= bottom and least < top
            marks.append("█" if inside else " ")
        level = high - (line + 0.5) * step
        yield f"{level / MBAR:8.0f} " + "".join(marks).rstrip()
