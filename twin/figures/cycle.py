"""From cycles to their key figures: measured and expected side by side, and the warnings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twin.config import Config
from twin.figures.cycle_view import Rows, measured
from twin.figures.expected import Expectation
from twin.figures.settings import FigureSettings, Limits, limits
from twin.figures.table import FIGURES, UNKNOWN, Unit, figures
from twin.figures.warnings import in_words, warnings
from twin.model.dataset import DataSet
from twin.monitor.cycles import LONGEST_PIECE, Cycle
from twin.monitor.monitor import MonitorSettings
from twin.signals import (
    BREAK,
    MBAR,
    MS,
    SAMPLE,
    TICK,
    Phase,
    Samples,
    Ticks,
    joined,
)

_OVER = (Phase.IDLE, Phase.BLOW_OFF)
_TOLD = {
    "t0": "evacuated to H2 in",
    "t1": "on to H1 in",
    "leakage": "leakage",
    "free_flow": "free-flow vacuum",
}
AHEAD = 250  # rows over which the model runs at once: what many calls cost is spared
MOST_PIECES = 30  # of a long cycle, five minutes; beyond, its end is not waited for


@dataclass(frozen=True)
class CycleFigures:
    """The key figures of one cycle; NaN where it cannot tell."""

    cycle: int
    begin_ns: int  # PLC time of its suction edge
    end_ns: int  # PLC time of its last row
    host_ns: int  # when that row was received
    measured: Mapping[str, float]
    expected: Mapping[str, float]
    warnings: tuple[str, ...]  # latched to the end of the cycle
    limits: Limits
    complete: bool  # the end of its suction was seen

    @property
    def words(self) -> str:
        """What a person wants to know of it, in a line."""
        parts = [
            f"{label} {self.measured[name]:.0f} {FIGURES[name].unit}{self._beside(name)}"
            for name, label in _TOLD.items()
            if math.isfinite(self.measured[name])
        ]
        told = f"cycle {self.cycle}: {', '.join(parts) or self._why_none}"
        return "; ".join([told, *self._warned.values()])

    @property
    def _why_none(self) -> str:
        """Why a cycle has none of them."""
        if not math.isfinite(self.measured["max_vacuum"]):
            return "incomplete, not evaluated"
        expected = self.expected["t0"]
        return "H2 not reached" + (
            f" (expected in {expected:.0f} {FIGURES['t0'].unit})" if math.isfinite(expected) else ""
        )

    @property
    def _warned(self) -> dict[str, str]:
        """The warnings for people, by name."""
        words = in_words(self.warnings, self.measured, self.limits)
        return dict(zip(self.warnings, words, strict=True))

    def _beside(self, name: str) -> str:
        expected = self.expected[name]
        return f" (expected {expected:.0f})" if math.isfinite(expected) else ""

    def plain(self) -> dict[str, Any]:
        """As JSON has it: names end with their side, and what is not known is left out."""
        both = {
            f"{name}_{side}": round(float(values[name]), 4)
            for name in FIGURES
            for side, values in (("measured", self.measured), ("expected", self.expected))
            if math.isfinite(values[name])
        }
        when = {"begin_ns": self.begin_ns, "end_ns": self.end_ns, "host_ns": self.host_ns}
        own = {"cycle": self.cycle, **when, "complete": self.complete}
        warned = {"warned": self._warned} if self.warnings else {}
        return {**own, **both, "warnings": list(self.warnings), **warned}


def compiled(config: Config) -> "KeyFigures":
    """Key figures whose path is compiled, which may take seconds: not to fall into the loop."""
    samples, ticks = np.zeros(3, SAMPLE), np.zeros(3, TICK)
    ticks["phase"] = Phase.SUCTION, Phase.HOLD, Phase.IDLE  # a cycle that is over
    ticks["level"] = config.data.ambient.pressure_mbar * MBAR
    settings = config.document.section(FigureSettings, "figures")
    KeyFigures(config.data, settings).take(Cycle(0, samples, ticks, True, False, True))
    return KeyFigures(config.data, settings, config.monitor)


@dataclass
class KeyFigures:
    """Takes the pieces of a CycleCutter, gives key figures as soon as a cycle's suction is over."""

    data: DataSet
    settings: FigureSettings = field(default_factory=FigureSettings)
    watch: MonitorSettings = field(default_factory=MonitorSettings)
    _pieces: list[Cycle] = field(default_factory=list)  # of a long cycle that is not over
    _index: int = -1  # of the cycle that was last given or begun
    _ran: int = 0  # rows of the next piece over which the model has run already

    def __post_init__(self) -> None:
        self._unit = Unit(self.data, self.settings.energy_kwh_m3)
        self._limits = limits(self.settings, self.data, self.watch)
        self._expectation = Expectation(self.data)

    def ahead(self, parts: Sequence[tuple[Samples, Ticks]], at_edge: bool) -> None:
        """Let the model run over the rows of the next piece, as far as they have come."""
        rows = sum(len(samples) for samples, _ in parts)
        if rows - self._ran < AHEAD:
            return
        if at_edge or (self._pieces and not parts[0][0]["quality"][0] & BREAK):
            samples, ticks = (joined(*column) for column in zip(*parts, strict=True))
            self._run(samples, ticks)

    def _run(self, samples: Samples, ticks: Ticks) -> None:
        """Let the model run over the rows of a piece, without those that it has run over."""
        fresh, self._ran = slice(self._ran, None), len(samples)
        self._expectation.go_on(samples[fresh], ticks[fresh], at_edge=not self._pieces)

    def take(self, piece: Cycle) -> CycleFigures | None:
        """Take the next piece; give the key figures of the cycle that it completes, if it does."""
        at_edge = piece.index > self._index
        goes_on = bool(self._pieces) and not piece.samples["quality"][0] & BREAK
        if not at_edge and not goes_on:
            return self._broken_off(piece)
        self._index = piece.index
        self._run(piece.samples, piece.ticks)
        self._ran = 0
        self._pieces.append(piece)
        over = int(piece.ticks["phase"][-1]) in _OVER
        if not over and len(piece.samples) == LONGEST_PIECE and len(self._pieces) < MOST_PIECES:
            return None
        return self._given()

    def _broken_off(self, piece: Cycle) -> CycleFigures | None:
        """Give what was being collected, if anything; ``piece`` belongs to no cycle from its edge.

        The model only goes on over it where it is what it looks like: no suction is commanded.
        """
        given = self._given() if self._pieces else None
        if np.isin(piece.ticks["phase"], _OVER).all():
            self._expectation.over(piece.samples, piece.ticks, at_edge=False)
        else:
            self._expectation.lose()
        return given

    def _given(self) -> CycleFigures:
        pieces, self._pieces = self._pieces, []
        samples, ticks = pieces[0].samples, pieces[0].ticks
        if len(pieces) > 1:
            samples = joined(*(piece.samples for piece in pieces))
            ticks = joined(*(piece.ticks for piece in pieces))
        last = int(ticks["phase"][-1])
        ended = last in _OVER
        seen = ended, ended and not (pieces[-1].cut_short and last == Phase.BLOW_OFF)
        rows = self._measured(samples, ticks, *seen)
        found = figures(rows, self._unit)
        expected = self._expected(rows, math.isfinite(found["free_flow"]))
        return CycleFigures(
            self._index,
            int(samples["time_ns"][0]),
            int(samples["time_ns"][-1]),
            int(samples["host_ns"][0]),
            found,
            expected,
            warnings(found, expected, self._limits),
            self._limits,
            ended,
        )

    def _measured(self, samples: Samples, ticks: Ticks, ended: bool, blown: bool) -> Rows:
        ejector = self.data.ejector
        columns = measured(samples, ticks, self.data.ambient.pressure_mbar)
        return Rows(*columns, ended, blown, ejector.response_off_ms * MS, ejector.response_ms * MS)

    def _expected(self, beside: Rows, is_open: bool) -> dict[str, float]:
        """As the model has the same cycle; where a cup was open, with its cups open."""
        found = self._expectation.end(at_edge=True)
        if found is None:
            return dict.fromkeys(FIGURES, UNKNOWN)
        vacuum, phase = found
        supply = np.full(len(vacuum), self.data.supply.nozzle_bar)
        rows = Rows(beside.time, vacuum, supply, phase, beside.ended, beside.blown)
        expected = figures(rows, self._unit)
        if is_open:
            share = self._expectation.free_flow / self._unit.h1
            expected["free_flow"] = self._expectation.free_flow
            expected["performance"] = 100.0 * (1.0 - share)
        return expected
