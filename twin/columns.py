"""Rows of a log or a simulation for notebooks: SI columns, field units as properties, a plot."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.diagnosis import page
from twin.diagnosis.curves import Expected, draw_curves, outline
from twin.diagnosis.drawing import Picture, empty
from twin.errors import ConfigError
from twin.signals import BAR, MBAR, MS, Phase

Floats = npt.NDArray[np.float64]

LONGEST_MS = 20.0  # s of a time axis in ms; a longer one is in s


class Columns(dict[str, npt.NDArray[Any]]):
    """One array for each column, in SI units; the properties have the field's units.

    ``ambient_pa`` is the pressure from which vacuum counts. ``title`` names the rows to people.
    ``FIELD`` names the properties that ``frame`` adds as columns.
    """

    FIELD: tuple[str, ...] = ("time_ms", "pressure_mbar", "vacuum_mbar")

    def __init__(
        self, columns: Mapping[str, npt.NDArray[Any]], ambient_pa: float, title: str
    ) -> None:
        super().__init__(columns)
        self.ambient_pa, self.title = ambient_pa, title

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.title}: {', '.join(self)}>"

    @property
    def time_ms(self) -> Floats:
        """Time since the first row (n), ms."""
        return self["time_s"] / MS

    @property
    def pressure_mbar(self) -> Floats:
        """Pressure (n), mbar absolute."""
        return self["pressure_pa"] / MBAR

    @property
    def vacuum_mbar(self) -> Floats:
        """Vacuum (n), mbar below ambient: positive when evacuated."""
        return (self.ambient_pa - self["pressure_pa"]) / MBAR

    @property
    def suctions(self) -> int:
        """Number of suction commands that begin in these rows."""
        return int(np.count_nonzero(np.diff(self["suction"].astype(np.int8), prepend=0) > 0))

    def between(self, begin_s: float = 0.0, end_s: float = math.inf) -> "Columns":
        """The rows of a range of time (s); ConfigError if there is none."""
        inside = (self["time_s"] >= begin_s) & (self["time_s"] <= end_s)
        if not inside.any():
            raise ConfigError(
                f"no row lies between {begin_s:g} and {end_s:g} s", "choose another range of time"
            )
        return type(self)(
            {name: column[inside] for name, column in self.items()}, self.ambient_pa, self.title
        )

    def frame(self) -> Any:
        """As a ``pandas.DataFrame``: the columns in SI units, and the properties in the field's."""
        from pandas import DataFrame  # noqa: PLC0415  (it takes its time)

        return DataFrame({**self, **{name: getattr(self, name) for name in self.FIELD}})

    def plot(self, begin_s: float = 0.0, end_s: float = math.inf) -> Picture:
        """Draw the vacuum (mbar) over a range of time (s), with what else there is to compare."""
        shown = self.between(begin_s, end_s)
        measured, expected = shown._curves()
        curves = [curve.vacuum for curve in expected]
        if measured is not None:
            curves += [measured, *(curve - measured for curve in curves)]
        rows = outline(curves)
        in_ms = shown["time_s"][-1] - shown["time_s"][0] <= LONGEST_MS
        with empty("curves", 3.4 if measured is None else 5.2, self.title) as picture:
            below = draw_curves(
                picture,
                (shown.time_ms if in_ms else shown["time_s"])[rows],
                None if measured is None else measured[rows],
                [Expected(curve.vacuum[rows], curve.label) for curve in expected],
                shown._phase()[rows],
            )
            below.set_xlabel(f"time ({'ms' if in_ms else 's'})")
        return picture

    def summary(self, facts: Sequence[tuple[str, str]] = ()) -> str:
        """What a notebook shows: ``facts`` and those of the rows, with a small picture."""
        if not len(self["time_s"]):
            return page.summary(f"{self.title}: no rows", [page.pairs(facts)])
        return page.summary(self.title, [page.pairs([*facts, *self._facts()])], self.plot())

    def _repr_html_(self) -> str:
        return self.summary()

    def _curves(self) -> tuple[Floats | None, list[Expected]]:
        """Measured vacuum (mbar), if there is one, and what is expected."""
        return None, [Expected(self.vacuum_mbar, "simulated")]

    def _phase(self) -> npt.NDArray[np.uint8]:
        """Phase of each row; here as commanded."""
        blown = np.where(self["blow_off"], Phase.BLOW_OFF, Phase.IDLE)
        return np.where(self["suction"], Phase.SUCTION, blown).astype(np.uint8)

    def _facts(self) -> list[tuple[str, str]]:
        """What a summary says about the rows, as names and texts."""
        begin, end = self["time_s"][[0, -1]]
        return [
            ("time", f"{begin:.4g} to {end:.4g} s, {len(self['time_s'])} rows"),
            ("suctions", str(self.suctions)),
            ("highest vacuum", f"{np.fmax.reduce(self.vacuum_mbar):.1f} mbar"),
        ]


class LogColumns(Columns):
    """Rows of a log: measured and expected."""

    FIELD = (*Columns.FIELD, "expected_vacuum_mbar", "deviation_mbar", "supply_bar")

    @property
    def expected_vacuum_mbar(self) -> Floats:
        """What the sensor should read (n), mbar below ambient; NaN before the twin has started."""
        return (self.ambient_pa - self["expected_pa"]) / MBAR

    @property
    def deviation_mbar(self) -> Floats:
        """Measured less expected pressure (n), mbar; NaN if either is unusable."""
        return self["deviation_pa"] / MBAR

    @property
    def supply_bar(self) -> Floats:
        """Supply pressure (n), bar gauge; NaN if it is not measured."""
        return self["supply_pa"] / BAR

    def _curves(self) -> tuple[Floats | None, list[Expected]]:
        return self.vacuum_mbar, [Expected(self.expected_vacuum_mbar, "expected")]

    def _phase(self) -> npt.NDArray[np.uint8]:
        return self["phase"]

    def _facts(self) -> list[tuple[str, str]]:
        off = self.deviation_mbar[np.isfinite(self.deviation_mbar)]
        rms = f"{np.sqrt(np.mean(off**2)):.2f} mbar rms" if len(off) else "unknown"
        return [*super()._facts(), ("deviation from the twin", rms)]
