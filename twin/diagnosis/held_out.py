"""How far measurement and a model part on cycles that no size was fitted to."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from twin.diagnosis.covariance import Weights, levels
from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.healthy import left_in_each, usual_leftover
from twin.inference.levels import UPPER_95
from twin.model import theta as c
from twin.monitor.bins import Floats, Ints
from twin.monitor.cycles import PAPER_VACUUM, time_to_vacuum
from twin.signals import MBAR, MS

FEWEST = 5  # held-out cycles, to tell from how they differ how sure a gain is
LITTLE = 1.25  # times the usual deviation: cycles differ by as much


@dataclass(frozen=True)
class Judged:
    """A hypothesis beside the held-out cycles."""

    expected: Floats  # Pa, of each row of the log
    off: Floats  # mbar, of each bin
    squares: Floats  # mean square deviation of each held-out cycle, mbar²
    leftover: float  # sigmas
    steady: float  # sigmas, where one odd cycle counts little
    usual: float  # mbar rms, of healthy cycles like these
    unmeasured: float  # mbar rms, that may be left of what no healthy cycle can have shown
    figures: dict[str, float | None]

    @property
    def rms(self) -> float:
        """Deviation (mbar rms) over all held-out cycles."""
        return math.sqrt(float(self.squares.mean()))


def judge(evidence: Evidence, weights: Weights, hypothesis: Hypothesis) -> Judged:
    """Deviation, evacuation times and what is left in sigmas on the cycles of ``weights``."""
    expected = evidence.expected(hypothesis)
    off = evidence.bins.mean(evidence.samples["pressure"] - expected) / MBAR
    level = levels(evidence, weights.cycles, [hypothesis])
    white = weights.white(off[:, None], level)
    rows = [_rows(evidence, cycle) for cycle in weights.cycles]
    deviations = [(evidence.samples["pressure"][one] - expected[one]) / MBAR for one in rows]
    squares = np.array([float(np.mean(one**2)) for one in deviations])
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
        usual_leftover(left_in_each(evidence, weights, white[:, 0])),
        weights.usual,
        weights.unmeasured,
        {name: None if one is None else rounded(one) for name, one in figures.items()},
    )


def gain(before: Judged, after: Judged) -> dict[str, float | None]:
    """Reduction of the rms deviation (%), its 95 % interval, its share of what could be reached.

    Healthy cycles are not without deviation either. The interval is None where held-out cycles are
    too few to tell, or do not differ.
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

    That of a ratio of means, linearised in its logarithm, by Student's t: few cycles show their
    spread only roughly, and resampling them would not tell.
    """
    cycles = len(before)
    if cycles < FEWEST:
        return None, None
    each = after / after.mean() - before / before.mean()
    sigma = float(np.std(each, ddof=1)) / math.sqrt(cycles)
    if sigma == 0.0:
        return None, None
    reach = float(student.ppf(UPPER_95, cycles - 1)) * sigma / 2.0  # of the rms, not its square
    ratio = math.sqrt(after.mean() / before.mean())
    low, high = (100.0 * (1.0 - ratio * math.exp(r)) for r in (reach, -reach))
    return math.floor(100.0 * low) / 100.0, math.ceil(100.0 * high) / 100.0


def _share(before: float, after: float, usual: float) -> float:
    """Share of the achievable reduction; all of it where hardly anything could be reduced."""
    if before < LITTLE * usual:
        return float(after < LITTLE * usual)
    return min((before - after) / (before - usual), 1.0)


def _rows(evidence: Evidence, cycle: int) -> Ints:
    rows = np.arange(evidence.starts[cycle], evidence.starts[cycle + 1])
    return rows[evidence.bins.number[rows] >= 0]


def _time_error(
    evidence: Evidence, expected: Floats, cycles: Sequence[int], vacuum: float
) -> float | None:
    """Mean error of the evacuation time to ``vacuum`` (Pa), %; None where it is not reached."""
    ambient = float(evidence.theta[c.AMBIENT])
    errors = []
    for cycle in cycles:
        rows = _rows(evidence, cycle)
        times = evidence.samples["time_ns"][rows]
        measured = evidence.samples["pressure"][rows].astype(np.float64)
        found = [time_to_vacuum(vacuum, p, times, ambient) for p in (measured, expected[rows])]
        if found[0] > MS and math.isfinite(found[1]):
            errors.append(100.0 * abs(found[1] / found[0] - 1.0))
    return float(np.mean(errors)) if errors else None


def rounded(value: float) -> float:
    """Four significant digits: more would be a claim."""
    return float(f"{value:.4g}")
