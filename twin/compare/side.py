"""One side of a comparison: the figures of every cycle of a log, and its mean curve over time."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from twin.config import Config
from twin.errors import SourceError
from twin.figures.curve import Stretch, readings, stretches, volume_of
from twin.figures.cycle import MOST_PIECES, CycleFigures, KeyFigures
from twin.inference.levels import SIGMAS_95
from twin.log.header import LogHeader
from twin.model import theta as c
from twin.model.dataset import coefficients
from twin.model.theta import Theta
from twin.monitor.cycles import Cycle, cut
from twin.monitor.cycles import figures as judged
from twin.quality import BREAK, UNUSABLE
from twin.signals import MBAR, MS, NS, Phase, Samples, Ticks, deviation, unbroken

Floats = npt.NDArray[np.float64]

BIN_S = 2.0 * MS
LONGEST_S = 10.0  # length of a cycle's curve
FEWEST_SHARE = 0.5  # share of the cycles that must reach a time for a mean there
_END_PHASES = (Phase.IDLE, Phase.BLOW_OFF)


@dataclass
class Curve:
    """Mean and spread over cycles, by time since the suction edge; in mbar."""

    _sums: Floats = field(default_factory=lambda: np.zeros((3, round(LONGEST_S / BIN_S))))

    def add(self, since: Floats, values: Floats) -> None:
        """Add the rows of one cycle: s since its suction edge, and values (mbar or NaN)."""
        bins = np.floor(since / BIN_S + 1e-6).astype(np.int64)
        is_valid = np.isfinite(values) & (bins >= 0) & (bins < self._sums.shape[1])
        bins, values = bins[is_valid], values[is_valid]
        count = np.bincount(bins, minlength=self._sums.shape[1])
        with np.errstate(invalid="ignore"):
            mean = np.bincount(bins, values, len(count)) / count
        is_filled = count > 0  # a cycle counts once in a bin, however many rows it has there
        self._sums[:, is_filled] += np.stack([np.ones(len(mean)), mean, mean**2])[:, is_filled]

    @property
    def mean(self) -> Floats:
        """Mean of the cycles in each bin; NaN where too few cycles reach it."""
        count, total, _ = self._sums
        enough = count >= max(FEWEST_SHARE * count.max(), 1.0)
        return np.where(enough, total / np.maximum(count, 1.0), np.nan)

    @property
    def spread(self) -> Floats:
        """Standard deviation of the cycles in each bin; NaN where the mean is."""
        count, total, squares = self._sums
        residual = squares - total**2 / np.maximum(count, 1.0)
        spread = np.sqrt(np.maximum(residual, 0.0) / np.maximum(count - 1.0, 1.0))
        return np.where(np.isfinite(self.mean), spread, np.nan)

    @property
    def error(self) -> Floats:
        """Standard error of the mean in each bin; NaN where the mean is."""
        error: Floats = self.spread / np.sqrt(np.maximum(self._sums[0], 1.0))
        return error


def bins() -> Floats:
    """Time of each bin since the suction edge (s)."""
    count = round(LONGEST_S / BIN_S)
    return np.linspace(0.0, LONGEST_S, count, endpoint=False) + 0.5 * BIN_S


def difference(a: Curve, b: Curve) -> tuple[Floats, Floats, Floats]:
    """Time (s), difference of the means B − A (mbar) and half its 95 % band, where both exist."""
    is_finite = np.isfinite(a.mean) & np.isfinite(b.mean)
    error = np.hypot(a.error, b.error)
    return bins()[is_finite], (b.mean - a.mean)[is_finite], SIGMAS_95 * error[is_finite]


@dataclass
class Side:
    """The complete cycles of one log; the suctions of one whose commands were derived."""

    name: str
    header: LogHeader
    data_set: str  # hash of its twin's data set
    cycles: list[int] = field(default_factory=list)
    measured: list[dict[str, float]] = field(default_factory=list)  # a row for each cycle
    expected: list[dict[str, float]] = field(default_factory=list)
    deviation: list[dict[str, float]] = field(default_factory=list)
    curve: list[dict[str, float]] = field(default_factory=list)  # read off it, without a model
    measured_vacuum: Curve = field(default_factory=Curve)
    expected_vacuum: Curve = field(default_factory=Curve)
    deviation_curve: Curve = field(default_factory=Curve)  # measured less expected pressure

    @property
    def asset(self) -> str:
        """Type and id, for people."""
        return " ".join(filter(None, (self.header.asset_type, self.header.asset_id)))

    @property
    def derived(self) -> bool:
        """Whether nobody recorded its commands."""
        return bool(self.header.derived)

    def add(self, cycle: Cycle, figures: CycleFigures, theta: Theta) -> None:
        """Add a whole cycle; ``theta`` holds the coefficients of the log's twin."""
        ambient = float(theta[c.AMBIENT])
        self.cycles.append(cycle.index)
        self.measured.append(dict(figures.measured))
        self.expected.append(dict(figures.expected))
        self.deviation.append(judged(cycle, theta))
        since = (cycle.samples["time_ns"] - cycle.samples["time_ns"][0]) * NS
        usable = (cycle.samples["quality"] & UNUSABLE) == 0
        pressure = np.where(usable, cycle.samples["pressure"], np.nan).astype(np.float64)
        self.measured_vacuum.add(since, (ambient - pressure) / MBAR)
        self.expected_vacuum.add(since, (ambient - cycle.ticks["expected"]) / MBAR)
        self.deviation_curve.add(since, deviation(cycle.samples, cycle.ticks) / MBAR)


class Recording(Protocol):
    """What is read of a log; each iteration begins anew."""

    @property
    def path(self) -> Path:
        """Its file, which names it to people."""

    @property
    def header(self) -> LogHeader:
        """What it says about all its rows."""

    def blocks(self) -> Iterator[tuple[Samples, Ticks]]:
        """Its rows in order."""


def side_of(log: Recording, settings: Config, key_figures: KeyFigures) -> Side:
    """Read a whole log; SourceError if no cycle of it can be compared.

    The first cycle after the start or a break is left out: its gas, and the model's, is not yet as
    warm as in the others.
    """
    theta = coefficients(settings.data)
    side = Side(log.path.name, log.header, settings.data.hash)
    blocks = (rows for rows, _ in log.blocks())
    suctions = _settled(
        stretch for stretch in stretches(blocks, volume_of(settings)) if stretch.ended
    )
    side.curve = [_reading_values(stretch) for stretch in suctions]
    if side.derived:
        _add_suctions(side, suctions)
        return side
    for cycle in whole(unbroken(log.blocks())):
        figures = key_figures.take(cycle)
        if figures is not None and figures.complete and cycle.complete and cycle.settled:
            side.add(cycle, figures, theta)
    if not side.cycles:
        raise SourceError(
            f"{log.path}: no cycle to compare: none is whole, and follows on another",
            "record at least two cycles in a row without a gap",
        )
    return side


def _settled(suctions: Iterable[Stretch]) -> list[Stretch]:
    """All suctions without the first of several: its gas is not yet as warm as in the others."""
    all_suctions = list(suctions)
    return all_suctions[1:] if len(all_suctions) > 1 and all_suctions[0].begun else all_suctions


def _reading_values(suction: Stretch) -> dict[str, float]:
    return {name: reading.value for name, reading in readings(suction).items() if not reading.why}


def _add_suctions(side: Side, suctions: list[Stretch]) -> None:
    """Add the suctions of derived commands; SourceError if none ends in the record."""
    if not suctions:
        raise SourceError(
            f"{side.name}: no suction to compare: none ends in the record",
            "record at least one suction with its release",
        )
    side.cycles = list(range(len(suctions)))
    for suction in suctions:
        side.measured_vacuum.add(suction.time - suction.origin, suction.vacuum)


def whole(blocks: Iterable[tuple[Samples, Ticks]]) -> Iterator[Cycle]:
    """Cut rows into cycles, joined up to some minutes; also yields rows that belong to none."""
    pieces: list[Cycle] = []
    previous = -1  # index of the last yielded cycle
    for piece in cut(blocks):
        if pieces and (piece.index > pieces[0].index or piece.samples["quality"][0] & BREAK):
            yield _join(pieces, previous)
            previous, pieces = pieces[0].index, []
        pieces.append(piece)
        if piece.ticks["phase"][-1] in _END_PHASES or len(pieces) == MOST_PIECES:
            yield _join(pieces, previous)
            previous, pieces = pieces[0].index, []
    if pieces:
        yield _join(pieces, previous)


def _join(pieces: list[Cycle], previous: int) -> Cycle:
    first, last = pieces[0], pieces[-1]
    if first is last:
        return first
    at_suction_edge, is_over = first.index > previous, last.ticks["phase"][-1] in _END_PHASES
    return replace(
        first,
        samples=np.concatenate([piece.samples for piece in pieces]),
        ticks=np.concatenate([piece.ticks for piece in pieces]),
        complete=bool(at_suction_edge and is_over),
        cut_short=last.cut_short,
    )
