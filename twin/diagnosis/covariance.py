"""What a residual weighs: the covariance of noise, cycle-to-cycle scatter and the model's error.

Scatter differs from cycle to cycle and averages out. The model's own error is the same in all of
them and does not; where a hypothesis explains much, a share of that is its error as well.
"""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from twin.diagnosis.another_day import unsure
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.inference import covariance as parts
from twin.inference.sensitivities import central, derivatives
from twin.inference.unmodelled import MISMATCH
from twin.model import theta as c
from twin.model.courses import Cause, Course, Schedule
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints
from twin.monitor.healthy import UNSEEN_LEVEL_MBAR
from twin.monitor.scatter_covariance import SCATTER, from_cycle_to_cycle, lasting, model_error
from twin.monitor.statistics import LEVELS
from twin.signals import MS, Phase

# When a valve acts: an edge that moves is not linear in that.
_ACTS = {"response_delay": c.RESPONSE, "blow_off_delay": c.BLOW_OFF_RESPONSE}
_CLOSES = (c.RESPONSE_OFF, c.BLOW_OFF_RESPONSE_OFF)
CLOSING_MS = 0.5  # by which a valve's closing differs, one sigma
KNEE_WINDOWS = 10  # a knee is found to a tenth of its window
# What that moves, of the columns of ``moved``: each knee by itself, where a cycle has several.
KNEES = [len(SCATTER) + len(_CLOSES), -1]
UNSEEN = 3.0  # sigmas in a bin: what the data set leaves open by more, calibration cannot have seen
_INTO = (Phase.HOLD, Phase.SUCTION)  # what begins at each
LEVEL_MBAR = 0.5  # a switching level is not known better, in all cycles alike


@dataclass(frozen=True)
class Weights:
    """Whitens the residuals of some cycles: each becomes one of sigma 1, all independent."""

    cycles: tuple[int, ...]  # positions
    bins: Ints  # of these cycles
    covariance: parts.Covariance  # of bins, then levels
    usual: float  # rms (mbar) over rows of a model that is as right as it was in healthy cycles
    unmeasured: float  # and of what no healthy cycle can have shown
    sigma: Floats  # of each level
    level_cycles: Ints  # of each level, positions

    @property
    def volume(self) -> float:
        """Logarithm of the covariance's determinant: what wide weights cost a likelihood."""
        return self.covariance.log_pdet

    def white(self, off: Floats, levels: Floats | None = None) -> Floats:
        """Residuals of hypotheses (mbar), (bins, n) and (levels, n), in sigmas."""
        rest = np.zeros((len(self.sigma), off.shape[1])) if levels is None else levels
        return self.covariance.white(np.concatenate([off[self.bins], rest]))


@dataclass(frozen=True)
class Covariance:
    """What bins of the judged cycles have in common about a hypothesis (mbar)."""

    evidence: Evidence
    mismatch: Floats  # of what is explained, in each bin
    moves: Floats  # by one sigma of each scatter, (bins, scatters)
    left_open: Floats  # by one sigma of each way that the data set is uncertain, and bent by it

    def of(self, cycles: Sequence[int], *, scattered: bool = True) -> Weights:
        """Weights of some cycles; where not ``scattered``, that is told apart by somebody else."""
        evidence, bins = self.evidence, self.evidence.bins
        here = np.flatnonzero(np.isin(bins.cycle, cycles))
        kind, time = bins.kind[here], bins.time[here]
        common, alone = model_error(evidence.healthy.error, kind, time)
        common = np.hypot(common, self.mismatch[here])
        moves, left_open = self.moves[here] * float(scattered), self.left_open[here]
        goes_on = lasting(bins, here, alone) + parts.low_rank(moves[:, KNEES], bins.stretch[here])
        moves = np.delete(moves, KNEES, axis=1)
        covariance = from_cycle_to_cycle(bins, here, goes_on, moves, evidence.noise)
        covariance += parts.fading(common, time, kind)
        usual = _usual(np.diag(covariance), bins.count[here], evidence.noise)
        unseen = left_open**2 * (left_open**2 > UNSEEN**2 * np.diag(covariance)[:, None])
        unmeasured = _usual(np.sum(unseen, axis=1), bins.count[here], 0.0)
        covariance += parts.low_rank(left_open)
        sigma = _level_sigmas(evidence, cycles)
        levels = np.diag(sigma**2) + _together(evidence, cycles)
        whole = block_diag(covariance * evidence.healthy.leftover**2, levels)
        shown = np.array([one for one, _ in _shown(evidence, cycles)], np.int64)
        known = parts.Covariance.of(whole)
        return Weights(tuple(cycles), here, known, usual, unmeasured, sigma, shown)


def _usual(variance: Floats, count: Ints, noise: float) -> float:
    """The rms (mbar) over rows of bins that vary so; a bin's mean has less noise than its rows."""
    rows = variance + noise**2 * (1.0 - 1.0 / count)
    return float(np.sqrt(np.average(rows, weights=count))) if len(count) else 0.0


def covariance(
    evidence: Evidence, about: Hypothesis = HEALTHY, *, both_ways: bool = True
) -> Covariance:
    """What scatters and is uncertain about a hypothesis.

    Where the data set is not varied ``both_ways``, how what it leaves open bends is not seen: that
    takes half the time, and is near enough to compare hypotheses.
    """
    sizes = scatter(evidence)
    uncertain = (*evidence.uncertain, *_another_day(evidence, about))
    off, moves, left_open = moved(evidence, about, sizes, uncertain, both_ways=both_ways)
    (healthy,) = evidence.off([HEALTHY]).T
    return Covariance(evidence, MISMATCH * np.abs(healthy - off), moves, left_open)


def _another_day(evidence: Evidence, about: Hypothesis) -> list[tuple[Theta, Theta]]:
    """What the log's day leaves open, where it is farthest from the calibration's."""
    if not evidence.another_day:
        return []
    calibrated = float(evidence.calibrated[c.AMBIENT])
    ambient = [float(theta[c.AMBIENT]) for _, theta in evidence.course(about)]
    farthest = max(ambient, key=lambda one: abs(one - calibrated))
    told, gauge = evidence.told, evidence.gauge
    return list(unsure(evidence.calibrated, evidence.theta, farthest, told, gauge))


def moved(
    evidence: Evidence,
    about: Hypothesis,
    sizes: Mapping[str, tuple[str, float]],
    uncertain: Sequence[tuple[Theta, Theta]] = (),
    *,
    both_ways: bool = True,
) -> tuple[Floats, Floats, Floats]:
    """Deviation of a hypothesis (mbar), and by how much it moves, (bins, ·).

    By each scatter's size; then by one sigma of what else differs from cycle to cycle: when the
    valves close, and where a knee was found; then by what is not linear in such times. Last by the
    ``uncertain`` data sets, in the same way; not ``both_ways``, only by the first of each.
    """
    steady = [(*about, Cause(name, {key: size})) for name, (key, size) in sizes.items()]
    acts = [(_ACTS[name], size) for name, (_, size) in sizes.items() if name in _ACTS]
    times = [*acts, *((closes, CLOSING_MS) for closes in _CLOSES)]
    steady = steady[: len(steady) - len(acts)]
    late = max(round(evidence.knees.window / KNEE_WINDOWS), 1)
    both = [(_acting(evidence.theta, *one, sign), 0) for sign in (1, -1) for one in times]
    both[len(times) : len(times)] = [(evidence.theta, late)]
    both.append((evidence.theta, -late))
    both += [(up, 0) for up, _ in uncertain]
    both += [(down, 0) for _, down in uncertain if both_ways]
    as_it_is = len(steady) + 1
    off = evidence.off(
        [about, *steady, *[about] * len(both)],
        [*[evidence.theta] * as_it_is, *(theta for theta, _ in both)],
        [*[0] * as_it_is, *(rows for _, rows in both)],
    )
    ends = np.cumsum([len(steady), *[len(times) + 1] * 2, len(uncertain)])
    as_found, changes = derivatives(off)
    linear, sooner, later, up, down = np.split(changes, ends, axis=1)
    moves, left_open = central(sooner, later), central(up, down) if both_ways else (up,)
    return as_found, np.hstack([linear, *moves]), np.hstack(left_open)


def _acting(theta: Theta, place: int, size: float, sign: int) -> Theta:
    """Coefficients of an ejector in which something acts later by ``size`` ms, or earlier."""
    moved = theta.copy()
    moved[place] = max(moved[place] + sign * size * MS, 0.0)
    return moved


def scatter(evidence: Evidence) -> dict[str, tuple[str, float]]:
    """What scatters: effect to parameter and one standard deviation."""
    known = evidence.healthy.scatter
    return {name: (key, known.get(name, size)) for name, (key, size) in SCATTER.items()}


# --- levels: one row for each that a cycle shows --------------------------------------------------


def levels(evidence: Evidence, cycles: Sequence[int], hypotheses: Sequence[Hypothesis]) -> Floats:
    """Measured minus expected switching levels (mbar) of cycles, (levels, hypotheses)."""
    shown = _shown(evidence, cycles)
    at = np.array([evidence.knee(cycle, _INTO[number]) for cycle, number in shown], np.int64)
    nodes = [_nodes(evidence, at, one) for one in hypotheses]
    there = [
        [_at(course, row) for row in rows]
        for course, rows in zip(map(evidence.course, hypotheses), nodes, strict=True)
    ]
    evidence.look(theta for some in there for theta in some)
    number = np.array([number for _, number in shown], np.int64)
    beside = np.array([_beside_the_twin(evidence, *one) for one in shown])
    found = np.empty((len(shown), len(hypotheses)))
    for i, (rows, some) in enumerate(zip(nodes, there, strict=True)):
        seen = np.array([evidence.seen(one).levels for one in some])
        for which in np.unique(number):
            mine = number == which
            found[mine, i] = beside[mine] - np.interp(at[mine], rows, seen[:, which])
    return found


def _nodes(evidence: Evidence, at: Ints, hypothesis: Hypothesis) -> Ints:
    """Rows at which a hypothesis is looked at, to know its switching ``at`` others.

    What grows steadily is looked at in its middle and at its ends.
    """
    at = np.unique(at)
    if not {cause.course for cause in hypothesis} <= {Course.CONSTANT, Course.RAMP}:
        return at
    nodes: set[int] = {*at[:1], *at[-1:]}
    for cause in hypothesis:
        if cause.course == Course.RAMP:
            grown = at[evidence.seconds[at] > cause.onset_s]
            before = at[evidence.seconds[at] <= cause.onset_s]
            nodes |= {*before[-1:], *grown[:1], *grown[len(grown) // 2 : len(grown) // 2 + 1]}
    return np.array(sorted(nodes), np.int64)


def _shown(evidence: Evidence, cycles: Sequence[int]) -> list[tuple[int, int]]:
    """Cycle and index into LEVELS of each level that was measured."""
    return [
        (cycle, number)
        for cycle in cycles
        for number, name in enumerate(LEVELS)
        if name in evidence.figures[cycle]
    ]


def _at(course: Schedule, row: int) -> Theta:
    """The coefficients at a row."""
    return course[bisect_right(course, row, key=lambda one: one[0]) - 1][1]


def _beside_the_twin(evidence: Evidence, cycle: int, number: int) -> float:
    """Measured level (mbar), less by how much healthy ones are above the calibrated twin's."""
    measured = evidence.figures[cycle][LEVELS[number]]
    healthy = evidence.healthy.figures.get(LEVELS[number])
    if healthy is None:
        return measured
    return measured - (healthy.mean - evidence.seen(evidence.theta).levels[number])


def _level_sigmas(evidence: Evidence, cycles: Sequence[int]) -> Floats:
    sigmas = []
    for _, number in _shown(evidence, cycles):
        healthy = evidence.healthy.figures.get(LEVELS[number])
        sigmas.append(healthy.sigma if healthy else UNSEEN_LEVEL_MBAR)
    return np.array(sigmas)


def _together(evidence: Evidence, cycles: Sequence[int]) -> Floats:
    """Covariance of levels that cycles have in common."""
    number = np.array([number for _, number in _shown(evidence, cycles)])
    known = np.array([LEVELS[n] in evidence.healthy.figures for n in number], bool)
    size = np.where(known, LEVEL_MBAR, evidence.healthy.unseen_level_mbar)
    common: Floats = np.outer(size, size) * (number[:, None] == number)
    return common
