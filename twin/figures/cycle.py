"""From cycles to their key figures: measured and expected side by side, and the warnings."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twin.config import Config
from twin.figures.cycle_view import Rows, measured
from twin.figures.expected import Expectation
from twin.figures.key_figures import FIGURES, UNKNOWN, Unit, figures
from twin.figures.settings import FigureSettings, Limits, limits
from twin.figures.warnings import in_words, warnings
from twin.model.dataset import DataSet
from twin.monitor.cycles import LONGEST_PIECE, Cycle
from twin.monitor.settings import MonitorSettings
from twin.quality import BREAK
from twin.signals import MBAR, MS, SAMPLE, TICK, Phase, Samples, Ticks, joined

_OVER = (Phase.IDLE, Phase.BLOW_OFF)
_LABELS = {
    "t0": "evacuated to H2 in",
    "t1": "on to H1 in",
    "leakage": "leakage",
    "free_flow": "free-flow vacuum",
}
MOST_PIECES = 30  # of a long cycle, five minutes; a longer one is evaluated before its end


@dataclass(frozen=True)
class CycleFigures:
    """The key figures of one cycle; NaN if it cannot tell."""

    cycle: int
    begin_ns: int  # PLC time of its suction edge
    end_ns: int  # PLC time of its last row
    host_ns: int  # when its first row was received
    measured: Mapping[str, float]
    expected: Mapping[str, float]
    warnings: tuple[str, ...]  # latched to the end of the cycle
    limits: Limits
    complete: bool  # the end of its suction was seen

    @property
    def words(self) -> str:
        """The cycle in one line for people."""
        texts = [
            f"{label} {self.measured[name]:.0f} {FIGURES[name].unit}{self._expected_text(name)}"
            for name, label in _LABELS.items()
            if math.isfinite(self.measured[name])
        ]
        text = f"cycle {self.cycle}: {', '.join(texts) or self._absence}"
        return "; ".join([text, *self._warned.values()])

    @property
    def _absence(self) -> str:
        """The text if none of these figures is known."""
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

    def _expected_text(self, name: str) -> str:
        expected = self.expected[name]
        return f" (expected {expected:.0f})" if math.isfinite(expected) else ""

    def plain(self) -> dict[str, Any]:
        """The cycle for JSON: names end with their side, and unknown figures are left out."""
        by_side = {
            f"{name}_{side}": round(float(values[name]), 4)
            for name in FIGURES
            for side, values in (("measured", self.measured), ("expected", self.expected))
            if math.isfinite(values[name])
        }
        times = {"begin_ns": self.begin_ns, "end_ns": self.end_ns, "host_ns": self.host_ns}
        identity = {"cycle": self.cycle, **times, "complete": self.complete}
        warned = {"warned": self._warned} if self.warnings else {}
        return {**identity, **by_side, "warnings": list(self.warnings), **warned}


def compiled(config: Config) -> "KeyFigures":
    """Key figures with their code compiled: that may take seconds, which the loop cannot wait."""
    samples, ticks = np.zeros(3, SAMPLE), np.zeros(3, TICK)
    ticks["phase"] = Phase.SUCTION, Phase.HOLD, Phase.IDLE  # a cycle that is over
    ticks["level"] = config.data.ambient.pressure_mbar * MBAR
    settings = config.document.section(FigureSettings, "figures")
    KeyFigures(config.data, settings).take(Cycle(0, samples, ticks, True, False, True))
    return KeyFigures(config.data, settings, config.monitor)


@dataclass
class KeyFigures:
    """Turns the pieces of a CycleCutter into key figures, as soon as a cycle's suction is over."""

    data: DataSet
    settings: FigureSettings = field(default_factory=FigureSettings)
    watch: MonitorSettings = field(default_factory=MonitorSettings)  # pyright: ignore[reportArgumentType]
    _pieces: list[Cycle] = field(default_factory=list)  # of a long cycle that is not over
    _index: int = -1  # of the cycle that was begun last

    def __post_init__(self) -> None:
        self._unit = Unit(self.data, self.settings.energy_kwh_m3)
        self.limits = limits(self.settings, self.data, self.watch)  # a person may change them
        self._expectation = Expectation(self.data)

    def run_ahead(self, samples: Samples, ticks: Ticks, at_edge: bool) -> None:
        """Run the model over the rows of the next piece that have arrived so far."""
        if at_edge or self._goes_on(samples):
            self._run(samples, ticks)

    def _goes_on(self, samples: Samples) -> bool:
        """Whether a piece without a suction edge continues the collected ones."""
        return bool(self._pieces) and not samples["quality"][0] & BREAK

    def _run(self, samples: Samples, ticks: Ticks) -> None:
        """Run the model over the rows of a piece that it has not run over yet."""
        done = self._expectation.rows - sum(len(piece.samples) for piece in self._pieces)
        self._expectation.go_on(samples[done:], ticks[done:], at_edge=not self._pieces)

    def take(self, piece: Cycle) -> CycleFigures | None:
        """Take the next piece; give the key figures of the cycle if the piece completes it."""
        at_edge = piece.index > self._index
        if not at_edge and not self._goes_on(piece.samples):
            return self._break_off(piece)
        self._index = piece.index
        self._run(piece.samples, piece.ticks)
        self._pieces.append(piece)
        over = int(piece.ticks["phase"][-1]) in _OVER
        if not over and len(piece.samples) == LONGEST_PIECE and len(self._pieces) < MOST_PIECES:
            return None
        return self._completed_cycle()

    def _break_off(self, piece: Cycle) -> CycleFigures | None:
        """Give the collected cycle, if any; ``piece`` belongs to no cycle that has its edge.

        The model runs over it only if no suction is commanded in it.
        """
        completed = self._completed_cycle() if self._pieces else None
        if np.isin(piece.ticks["phase"], _OVER).all():
            self._expectation.over(piece.samples, piece.ticks, at_edge=False)
        else:
            self._expectation.lose()
        return completed

    def _completed_cycle(self) -> CycleFigures:
        pieces, self._pieces = self._pieces, []
        samples, ticks = pieces[0].samples, pieces[0].ticks
        if len(pieces) > 1:
            samples = joined(*(piece.samples for piece in pieces))
            ticks = joined(*(piece.ticks for piece in pieces))
        last = int(ticks["phase"][-1])
        ended = last in _OVER
        ends_seen = ended, ended and not (pieces[-1].cut_short and last == Phase.BLOW_OFF)
        rows = self._measured(samples, ticks, *ends_seen)
        values = figures(rows, self._unit)
        expected = self._expected(rows, math.isfinite(values["free_flow"]))
        return CycleFigures(
            self._index,
            int(samples["time_ns"][0]),
            int(samples["time_ns"][-1]),
            int(samples["host_ns"][0]),
            values,
            expected,
            warnings(values, expected, self.limits),
            self.limits,
            ended,
        )

    def _measured(self, samples: Samples, ticks: Ticks, ended: bool, blown: bool) -> Rows:
        ejector = self.data.ejector
        columns = measured(samples, ticks, self.data.ambient.pressure_mbar)
        return Rows(*columns, ended, blown, ejector.response_off_ms * MS, ejector.response_ms * MS)

    def _expected(self, measured_rows: Rows, is_open: bool) -> dict[str, float]:
        """Figures of the model's cycle; if a cup was open, the model's free-flow vacuum."""
        simulated = self._expectation.end(at_edge=True)
        if simulated is None:
            return dict.fromkeys(FIGURES, UNKNOWN)
        vacuum, phase = simulated
        supply = np.full(len(vacuum), self.data.supply.nozzle_bar)
        rows = Rows(
            measured_rows.time, vacuum, supply, phase, measured_rows.ended, measured_rows.blown
        )
        expected = figures(rows, self._unit)
        if is_open:
            share = self._expectation.free_flow / self._unit.h1
            expected["free_flow"] = self._expectation.free_flow
            expected["performance"] = 100.0 * (1.0 - share)
        return expected
