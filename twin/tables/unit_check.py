"""Whether a column in mbar can be one: pressures in bar are a thousandth of what they should be."""

from dataclasses import dataclass

import numpy as np

from twin.errors import SourceError
from twin.signals import MBAR, Command, Samples
from twin.tables.layout import Layout
from twin.tables.settings import Column, ImportSettings

# Ambient is about 1 bar: read as mbar, no absolute pressure or vacuum in bar comes to 2 mbar.
# No ejector evacuates to as little, and only a dead one leaves as little after a second of suction.
LEAST = 2.0 * MBAR
LONG_NS = 1_000_000_000
_IN_BAR = {
    Column.VACUUM_MBAR: Column.VACUUM_BAR,
    Column.PRESSURE_MBAR: Column.PRESSURE_BAR,
}


@dataclass
class UnitCheck:
    """What is seen of one file's pressure, block after block; ``ambient`` in Pa."""

    layout: Layout
    settings: ImportSettings
    ambient: float
    _highest: float = -np.inf  # Pa, as the column counts it
    _suction_ns: int = 0  # commanded so far

    def see(self, block: Samples) -> None:
        """Take in a block of rows."""
        suction = (block["commands"] & Command.SUCTION.value) != 0
        steps = np.diff(block["time_ns"]).clip(0, LONG_NS)
        self._suction_ns += int(steps[suction[1:]].sum())
        counted = block["pressure"].astype(np.float64)
        if self.layout.pressure is Column.VACUUM_MBAR:
            counted = self.ambient - counted[suction]
        counted = counted[np.isfinite(counted)]
        self._highest = max(self._highest, counted.max(initial=-np.inf))

    def refuse(self, place: str) -> None:
        """SourceError after the last block if the column is hardly in mbar, and not said to be."""
        if self.settings.pressure_unit is not None:
            return
        column = self.layout.pressure
        better = _IN_BAR.get(column)
        if better is None or self._suction_ns < LONG_NS or not self._highest < LEAST:
            return
        theirs = self.layout.theirs[column]
        when = " while suction is commanded" if column is Column.VACUUM_MBAR else ""
        raise SourceError(
            f"{place}: column {theirs!r} is never above {self._highest / MBAR:.3g} mbar{when}: it"
            " is probably in bar",
            f'say so under [import.columns]: {better} = "{theirs}"; if it is negative under'
            " suction, turn its sign in the file. If it is in mbar, say so under [import]:"
            ' pressure_unit = "mbar"',
        )
