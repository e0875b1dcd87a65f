"""Deviation of a model on held-out cycles, to which no size was fitted."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.healthy import left_in_each, usual_leftover
from twin.diagnosis.residual_covariance import ResidualWhitener, levels
from twin.inference.levels import UPPER_95
from twin.model import theta as c
from twin.monitor.bins import Floats, Ints
from twin.monitor.cycles import PAPER_VACUUM, time_to_vacuum
from twin.signals import MBAR, MS

FEWEST = 5  # held-out cycles, for an interval of the gain
LITTLE = 1.25  # times the usual deviation: the scatter of cycles


@dataclass(frozen=True)
class Judged:
    """A hypothesis, judged on held-out cycles."""

    expected: Floats  # Pa, of each row of the log
    off: Floats  # mbar, of each bin
    squares: Floats  # mean square deviation of each held-out cycle, mbar²
    leftover: float  # sigmas
    chi2: Floats  # per residual, of each held-out cycle
    usual: float  # mbar rms, of healthy cycles like these
    unmeasured: float  # mbar rms, uncertainty that no healthy cycle can have shown
    figures: dict[str, float | None]

    @property
    def rms(self) -> float:
        """Deviation (mbar rms) over all held-out cycles."""
        return math.sqrt(float(self.squares.mean()))

    @property
    def steady(self) -> float:
        """Leftover (sigmas), robust against one odd cycle."""
        return usual_leftover(self.chi2)


def judge(evidence: Evidence, weights: ResidualWhitener, hypothesis: Hypothesis) -> Judged:
    """Deviation, errors of evacuation times and whitened rms on the cycles of ``weights``."""
    expected = evidence.expected(hypothesis)
    off = evidence.bins.mean(evidence.samples["pressure"] - expected) / MBAR
    level = levels(evidence, weights.cycles, [hypothesis])
    white = weights.white(off[:, None], level)
    deviations = _deviations(evidence, expected, weights.cycles)
    squares = _mean_squares(deviations)
    binned = off[np.isin(evidence.bins.cycle, weights.cycles)]
    leftover = float(np.sqrt(np.mean(white**2)))
    h2 = float(evidence.theta[c.H2])
    figures: dict[str, float | None] = {
        "rms_mbar": float(np.sqrt(np.mean(np.concatenate(deviations) ** 2))),
        "max_mbar": float(np.max(np.abs(binned))),
        "evacuation_time_error_pct": _time_error(evidence, expected, weights.cycles, PAPER_VACUUM),
        "h2_time_error_pct": _time_error(evidence, expected, weights.cycles, h2),
        "level_rms_mbar": float(np.sqrt(np.mean(level**2))) if level.size else None,
        "leftover_sigma": leftover,
    }
    return Judged(
        expected,
        off,
        squares,
        leftover,
        left_in_each(evidence, weights, white[:, 0]),
        weights.usual,
        weights.unmeasured,
        {name: None if value is None else rounded(value) for name, value in figures.items()},
    )


def _deviations(evidence: Evidence, expected: Floats, cycles: Sequence[int]) -> list[Floats]:
    """Measured minus expected pressure (mbar) of the rows of each cycle."""
    rows = [_rows(evidence, cycle) for cycle in cycles]
    return [(evidence.samples["pressure"][part] - expected[part]) / MBAR for part in rows]


def _mean_squares(deviations: Sequence[Floats]) -> Floats:
    return np.array([float(np.mean(deviation**2)) for deviation in deviations])


def reduces(
    evidence: Evidence, cycles: Sequence[int], before: Hypothesis, after: Hypothesis
) -> bool:
    """Whether causes leave less deviation (mbar rms) than others in these cycles.

    The 95 % interval of the reduction must lie above zero, where the cycles give one.
    """
    left_before, left_after = (
        _mean_squares(_deviations(evidence, evidence.expected(causes), cycles))
        for causes in (before, after)
    )
    low, _ = _interval(left_before, left_after)
    return bool(left_after.mean() < left_before.mean()) if low is None else low > 0.0


def gain(before: Judged, after: Judged) -> dict[str, float | None]:
    """Reduction of the rms deviation (%), its 95 % interval, its share of the achievable one.

    Healthy cycles have a deviation as well. The interval is None if held-out cycles are too few,
    or do not differ.
    """
    low, high = _interval(before.squares, after.squares)
    return {
        "rms_reduction_pct": rounded(100.0 * (1.0 - after.rms / before.rms)),
        "low95": low,
        "high95": high,
        "share_of_achievable_pct": rounded(100.0 * _share(before.rms, after.rms, before.usual)),
    }


def _interval(before: Floats, after: Floats) -> tuple[float | None, float | None]:
    """95 % interval (%) of the reduction, from mean squares by cycle; rounded outward.

    It is that of a ratio of means, linearised in its logarithm, by Student's t. A few cycles show
    their spread only roughly, which resampling would ignore.
    """
    cycles = len(before)
    if cycles < FEWEST:
        return None, None
    changes = after / after.mean() - before / before.mean()
    sigma = float(np.std(changes, ddof=1)) / math.sqrt(cycles)
    if sigma == 0.0:
        return None, None
    reach = float(stdtrit(cycles - 1, UPPER_95)) * sigma / 2.0  # of the rms, not its square
    ratio = math.sqrt(after.mean() / before.mean())
    low, high = (100.0 * (1.0 - ratio * math.exp(r)) for r in (reach, -reach))
    return math.floor(100.0 * low) / 100.0, math.ceil(100.0 * high) / 100.0


def _share(before: float, after: float, usual: float) -> float:
    """Share of the achievable reduction; 1 if hardly anything could be reduced."""
    if before < LITTLE * usual:
        return float(after < LITTLE * usual)
    return min((before - after) / (before - usual), 1.0)


def _rows(evidence: Evidence, cycle: int) -> Ints:
    rows = np.arange(evidence.starts[cycle], evidence.starts[cycle + 1])
    return rows[evidence.bins.number[rows] >= 0]


def _time_error(
    evidence: Evidence, expected: Floats, cycles: Sequence[int], vacuum: float
) -> float | None:
    """Mean error of the evacuation time to ``vacuum`` (Pa), %; None if it is not reached."""
    ambient = float(evidence.theta[c.AMBIENT])
    errors = []
    for cycle in cycles:
        rows = _rows(evidence, cycle)
        times = evidence.samples["time_ns"][rows]
        measured = evidence.samples["pressure"][rows].astype(np.float64)
        times_to_vacuum = [
            time_to_vacuum(vacuum, p, times, ambient) for p in (measured, expected[rows])
        ]
        if times_to_vacuum[0] > MS and math.isfinite(times_to_vacuum[1]):
            errors.append(100.0 * abs(times_to_vacuum[1] / times_to_vacuum[0] - 1.0))
    return float(np.mean(errors)) if errors else None


def rounded(value: float) -> float:
    """Round to four significant digits: more would suggest a precision that is not there."""
    return float(f"{value:.4g}")
