"""Covariance of residuals: noise, cycle-to-cycle scatter and the model's own error.

Scatter differs from cycle to cycle and averages out. The model's error is the same in all cycles
and does not average out. A share of the deviation that a hypothesis explains counts as error too.
"""

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.inference import whitening as parts
from twin.inference.sensitivities import central, derivatives
from twin.inference.unmodelled import MISMATCH
from twin.model import theta as c
from twin.model.catalogue import mechanism_of
from twin.model.courses import Cause, Course, Schedule
from twin.model.effects import WEATHER, effect_of
from twin.model.mechanism import MECHANISMS, PLACES, RHYTHMIC, WHENS, Mechanism
from twin.model.theta import Theta
from twin.monitor.another_day import unsure
from twin.monitor.bins import Bins, Floats, Ints
from twin.monitor.healthy import UNSEEN_LEVEL_MBAR
from twin.monitor.scatter_covariance import (
    SCATTERING,
    Reading,
    comes_on_part,
    from_cycle_to_cycle,
    lasting,
    model_error,
)
from twin.monitor.statistics import LEVELS
from twin.signals import MS, Phase

# Delays that scatter, each with the time at which its valve opens: the response of an edge is not
# linear in them.
_OPENS = {name: p.touches[0] for name, p in SCATTERING.items() if p.is_time}
_CLOSES = (c.RESPONSE_OFF, c.BLOW_OFF_RESPONSE_OFF)
ROW = math.sqrt(3.0)  # half a row over the sigma of a time that is uniform within a row
CLOSING_MS = 0.5  # one sigma of the time at which a valve closes
BREAK_WINDOWS = 10  # the detector's window over the sigma of a breakpoint's time
# Columns of ``moved``: breakpoints are independent within a cycle; one column is for contact.
_TIMES = len(_OPENS) + len(_CLOSES) + 2
BREAK_COLUMNS = [len(SCATTERING) + len(_CLOSES) + _TIMES * order for order in (0, 1)]
MEETS = BREAK_COLUMNS[0] + 1
# Sigmas in a bin: largest uncertainty of the data set that healthy cycles can hide. The
# uncertainty by another weather never shows in them.
UNSEEN = 3.0
_INTO = (Phase.HOLD, Phase.SUCTION)  # the phase after each of LEVELS
WARMING_SENSOR = Mechanism(PLACES["sensor"], WHENS["warming_up"]).name
# Mechanisms that act at each switching otherwise, by the time in the log alone.
OF_THE_LOG = {one.name for one in MECHANISMS.values() if one.when.code in RHYTHMIC}
OF_THE_LOG |= {WARMING_SENSOR}
LEVEL_MBAR = 0.5  # sigma of a switching level, common to all cycles


@dataclass(frozen=True)
class ResidualWhitener:
    """Whitens the residuals of some cycles to independent values with sigma 1."""

    cycles: tuple[int, ...]  # positions of the cycles
    bins: Ints  # bins of these cycles
    covariance: parts.CoupledCovariance  # covariance of bins, then levels
    usual: float  # rms (mbar) over rows of the residuals expected for a correct hypothesis
    unmeasured: float  # rms (mbar) of the uncertainty that healthy cycles cannot show
    sigma: Floats  # sigma of each level
    level_cycles: Ints  # position of the cycle of each level

    @property
    def volume(self) -> float:
        """Log-determinant of the covariance, as it stands in a log-likelihood."""
        return self.covariance.log_pdet

    def white(self, off: Floats, levels: Floats | None = None) -> Floats:
        """Whitened residuals of hypotheses; inputs in mbar, (bins, n) and (levels, n)."""
        rest = np.zeros((len(self.sigma), off.shape[1])) if levels is None else levels
        return self.covariance.white(np.concatenate([off[self.bins], rest]))


@dataclass(frozen=True)
class Covariance:
    """Covariance of the bins of the judged cycles about a hypothesis (mbar)."""

    evidence: Evidence
    mismatch: Floats  # by one sigma of the error of the explained deviation, in each bin
    moves: Floats  # by one sigma of each scattering quantity, (bins, quantities)
    # By one sigma of each data-set uncertainty, as far as healthy cycles show it.
    parameter_sensitivity: Floats
    beyond: Floats  # the rest of these responses: first order, then second order
    another_day: Floats  # by one sigma of each uncertainty of the log's day
    day_mismatch: Floats  # by one sigma of the error of the deviation that the day explains
    of_weather: bool = False  # whether the log's day has another weather

    def of(self, cycles: Sequence[int], *, scattered: bool = True) -> ResidualWhitener:
        """Weights of some cycles; with ``scattered`` False, effects do not scatter."""
        evidence, bins = self.evidence, self.evidence.bins
        rows = np.flatnonzero(np.isin(bins.cycle, cycles))
        common, alone = model_error(evidence.healthy.error, bins.kind[rows], bins.time[rows])
        scatter = self.moves[rows] * float(scattered)
        # The factor holds for uncertainty that healthy cycles show, not for new causes in a log.
        learned = evidence.healthy.leftover
        unsure = np.hstack([self.beyond[rows], self.another_day[rows]])
        unsure[:, : self.parameter_sensitivity.shape[1]] += (
            learned * self.parameter_sensitivity[rows]
        )
        mismatches = [self.mismatch[rows], self.day_mismatch[rows]]

        def by_cycle(leftover: float) -> list[Floats]:
            return [
                self._of_cycle(rows[of_cycle], alone[of_cycle], scatter[of_cycle], leftover)
                for of_cycle in _runs(bins.cycle[rows])
            ]

        variance = np.concatenate([np.empty(0), *map(np.diag, by_cycle(1.0))])
        rounding = evidence.healthy.rounding_mbar
        in_common = (np.hypot(common, rounding), *mismatches)
        variance += np.sum([error**2 for error in in_common], axis=0)
        usual = _row_rms(variance, bins.count[rows], evidence.noise)
        is_unseen = unsure**2 > UNSEEN**2 * variance[:, None]
        is_unseen[:, self.beyond.shape[1] :] |= self.of_weather
        unmeasured = _row_rms(np.sum(unsure**2 * is_unseen, axis=1), bins.count[rows], 0.0)
        groups = by_cycle(learned)
        common = np.hypot(learned * common, rounding)
        moves, prior = _in_common(bins, rows, [common, *mismatches], unsure)
        sigma = _level_sigmas(evidence, cycles)
        if len(sigma):  # no unknown of the bins moves the levels
            groups.append(np.diag(sigma**2) + _common_levels(evidence, cycles))
            moves = np.concatenate([moves, np.zeros((len(sigma), moves.shape[1]))])
        shown = np.array([cycle for cycle, _ in _shown(evidence, cycles)], np.int64)
        factored = parts.CoupledCovariance.of(groups, moves, prior)
        return ResidualWhitener(tuple(cycles), rows, factored, usual, unmeasured, sigma, shown)

    def _of_cycle(self, rows: Ints, alone: Floats, scatter: Floats, leftover: float) -> Floats:
        """Covariance (mbar²) between bins of a cycle by differences from cycle to cycle."""
        bins, healthy = self.evidence.bins, self.evidence.healthy
        reading = Reading(self.evidence.noise, healthy.rounding_mbar)
        breakpoints = parts.low_rank(scatter[:, BREAK_COLUMNS], bins.stretch[rows])
        moves = np.delete(scatter, BREAK_COLUMNS, axis=1)
        persistent = lasting(bins, rows, alone) + breakpoints
        return from_cycle_to_cycle(bins, rows, persistent, moves, reading, leftover)


def _runs(number: Ints) -> list[slice]:
    """Slices of equal numbers."""
    ends = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(number)]
    return [slice(*pair) for pair in pairwise(ends) if pair[0] < pair[1]]


def _in_common(
    bins: Bins, rows: Ints, errors: Sequence[Floats], unsure: Floats
) -> tuple[Floats, Floats]:
    """Responses of bins (mbar) to errors common to all cycles, and the covariance of these errors.

    Common errors are those of the model (``errors``, one sigma) at each time since a stretch began,
    and the responses ``unsure`` to uncertainties of the data set.
    """
    _, first, place = np.unique(
        (bins.kind[rows] << 32) + bins.since[rows], return_index=True, return_inverse=True
    )
    at = rows[first]
    fading = parts.fading(np.ones(len(first)), bins.time[at], bins.kind[at])
    shares = np.eye(len(first))[place]
    moves = [shares * error[:, None] for error in errors if error.any()]
    prior = block_diag(*[fading] * len(moves), np.eye(unsure.shape[1]))
    return np.hstack([*moves, unsure]), prior


def _row_rms(variance: Floats, count: Ints, noise: float) -> float:
    """Rms (mbar) over rows by the variance of bins' means, whose noise is smaller."""
    rows = variance + noise**2 * (1.0 - 1.0 / count)
    return float(np.sqrt(np.average(rows, weights=count))) if len(count) else 0.0


def covariance(
    evidence: Evidence, about: Hypothesis = HEALTHY, *, both_ways: bool = True
) -> Covariance:
    """Covariance of residuals about a hypothesis.

    If the data set is not varied ``both_ways``, its uncertainty counts to first order only. That
    takes half the time, and suffices to compare hypotheses.
    """
    days = _another_day(evidence, _farthest_ambient(evidence, about))
    uncertain = [(shift.up, shift.down) for shift in evidence.uncertain]
    off, moves, opened = moved(
        evidence, about, scatter(evidence), [*uncertain, *days], both_ways=both_ways
    )
    is_day = np.tile(np.arange(len(uncertain) + len(days)) >= len(uncertain), 1 + both_ways)
    parameter_sensitivity, beyond = split_sensitivity(
        evidence, opened[:, ~is_day], both_ways=both_ways
    )
    (healthy,) = evidence.off([HEALTHY]).T
    of_weather = any(cause.effect == WEATHER for cause in about)
    exact = Covariance(
        evidence,
        mismatch=MISMATCH * np.abs(healthy - off),
        moves=moves,
        parameter_sensitivity=parameter_sensitivity,
        beyond=beyond,
        another_day=opened[:, is_day],
        day_mismatch=np.zeros_like(off),
        of_weather=of_weather,
    )
    return replace(exact, day_mismatch=MISMATCH * explained_by_day(exact, off))


def split_sensitivity(
    evidence: Evidence, opened: Floats, *, both_ways: bool = True
) -> tuple[Floats, Floats]:
    """Responses to the data set's uncertainties: the part that healthy cycles show, and the rest.

    ``opened`` are responses (mbar) to whole sigmas. The uncertainties are correlated by the
    calibration's record. The model is nonlinear, so a whole sigma would contradict that record.
    Hence the twin without causes varies by its linear response, and its response to a whole sigma
    is subtracted.
    """
    tied = np.array([shift.tied for shift in evidence.uncertain], bool)
    nearby, up, down = evidence.parameter_sensitivity
    healthy = np.hstack(central(up, down) if both_ways else (up,))
    return nearby * tied, opened - healthy * np.tile(tied, 1 + both_ways)


def explained_by_day(residual_covariance: Covariance, off: Floats) -> Floats:
    """Expected part (mbar) of the residual ``off`` that the log's day explains, in each bin."""
    days, evidence = residual_covariance.another_day, residual_covariance.evidence
    weights = replace(residual_covariance, another_day=days[:, :0]).of(evidence.judged)
    white = weights.white(np.column_stack([off, days]))
    information = white[:, 1:].T @ white[:, 1:] + np.eye(days.shape[1])
    explained: Floats = days @ np.linalg.solve(information, white[:, 1:].T @ white[:, 0])
    return explained


def _farthest_ambient(evidence: Evidence, about: Hypothesis) -> float:
    """Ambient pressure (Pa) under a hypothesis at its largest distance from the calibration's."""
    calibrated = float(evidence.calibrated[c.AMBIENT])
    if not evidence.another_day:
        return calibrated
    ambient = [float(theta[c.AMBIENT]) for _, theta in evidence.course(about)]
    return max(ambient, key=lambda pressure: abs(pressure - calibrated))


def _another_day(evidence: Evidence, ambient: float) -> list[tuple[Theta, Theta]]:
    """Uncertainties of the log's day, at its ambient pressure."""
    if not evidence.another_day:
        return []
    return list(unsure(evidence.calibrated, evidence.theta, ambient, evidence.told))


def moved(
    evidence: Evidence,
    about: Hypothesis,
    sizes: Mapping[str, tuple[str, float]],
    uncertain: Sequence[tuple[Theta, Theta]] = (),
    *,
    both_ways: bool = True,
) -> tuple[Floats, Floats, Floats]:
    """Deviation of a hypothesis (mbar), and its changes by scatter and by uncertainty, (bins, ·).

    Changes by scatter are in this order: each effect in ``sizes``; one sigma of the times at which
    valves close, of the breakpoints, and of contact with the part; the second order of such times.
    A time is varied by at least half a row, since the response of an edge is nonlinear within it.
    Changes by uncertainty are those of the ``uncertain`` data sets, first and second order. Without
    ``both_ways`` only the first of each pair counts.
    """
    steady = [(*about, Cause(name, {key: size})) for name, (key, size) in sizes.items()]
    delays = [(_OPENS[name], size) for name, (_, size) in sizes.items() if name in _OPENS]
    closing = max(CLOSING_MS, evidence.least_time_ms)
    times = [*delays, *((closes, closing) for closes in _CLOSES)]
    break_column = len(times)
    if comes_on_part(evidence.theta):
        times.append((c.CONTACT, evidence.healthy.meets_ms))
    steps = [max(sigma, ROW * evidence.least_time_ms) for _, sigma in times]
    shares = np.insert(
        [sigma / step for (_, sigma), step in zip(times, steps, strict=True)], break_column, 1
    )
    steady = steady[: len(steady) - len(delays)]
    break_shift = max(round(evidence.detector.window / BREAK_WINDOWS), 1)
    variants = []
    for sign in (1, -1):
        of_times = [
            (_at_another_time(evidence.theta, coefficient, sign * step), 0)
            for (coefficient, _), step in zip(times, steps, strict=True)
        ]
        variants += [
            *of_times[:break_column],
            (evidence.theta, sign * break_shift),
            *of_times[break_column:],
        ]
    variants += [(up, 0) for up, _ in uncertain]
    variants += [(down, 0) for _, down in uncertain if both_ways]
    unchanged_count = len(steady) + 1
    off = evidence.off(
        [about, *steady, *[about] * len(variants)],
        [*[evidence.theta] * unchanged_count, *(theta for theta, _ in variants)],
        [*[0] * unchanged_count, *(rows for _, rows in variants)],
    )
    ends = np.cumsum([len(steady), *[len(times) + 1] * 2, len(uncertain)])
    deviation, changes = derivatives(off)
    linear, sooner, later, up, down = np.split(changes, ends, axis=1)
    first, second = central(sooner, later)
    never = np.zeros((len(deviation), _TIMES - len(shares)))
    moves = np.hstack([linear, first * shares, never, second * shares**2, never])
    parameter_sensitivity = central(up, down) if both_ways else (up,)
    return deviation, moves, np.hstack(parameter_sensitivity)


def _at_another_time(theta: Theta, coefficient: int, later_ms: float) -> Theta:
    """Coefficients with one time later by ``later_ms``."""
    moved = theta.copy()
    moved[coefficient] += later_ms * MS
    if coefficient == c.CONTACT:
        moved[coefficient] = max(moved[coefficient], np.finfo(float).eps)  # cups still meet it
    return moved


def scatter(evidence: Evidence) -> dict[str, tuple[str, float]]:
    """Parameter and sigma of each scattering effect."""
    learned = evidence.healthy.scatter
    sizes = {}
    for name, p in SCATTERING.items():
        least = evidence.least_time_ms if p.is_time else 0.0
        sizes[name] = p.name, max(learned.get(name, p.healthy_sigma), least)
    return sizes


# --- levels: one row for each that a cycle shows --------------------------------------------------


def levels(evidence: Evidence, cycles: Sequence[int], hypotheses: Sequence[Hypothesis]) -> Floats:
    """Measured minus expected switching levels (mbar) of cycles, (levels, hypotheses).

    The switching is simulated from a cold start. So what depends on the time in the log is left
    out there: a rhythm, and a sensor that warms up. What this reads more at each switching is
    added.
    """
    shown = _shown(evidence, cycles)
    at = np.array(
        [evidence.switching_row(cycle, _INTO[number]) for cycle, number in shown], np.int64
    )
    drifts = [_drift(evidence, at, hypothesis) for hypothesis in hypotheses]
    hypotheses = [
        tuple(cause for cause in hypothesis if mechanism_of(cause.effect) not in OF_THE_LOG)
        for hypothesis in hypotheses
    ]
    nodes = [_nodes(evidence, at, hypothesis) for hypothesis in hypotheses]
    thetas = [
        [_coefficients_at(course, row) for row in rows]
        for course, rows in zip(map(evidence.course, hypotheses), nodes, strict=True)
    ]
    evidence.look(theta for thetas_of_hypothesis in thetas for theta in thetas_of_hypothesis)
    number = np.array([number for _, number in shown], np.int64)
    relative = np.array([_relative_level(evidence, *level) for level in shown])
    deviations = np.empty((len(shown), len(hypotheses)))
    for i, (rows, thetas_of_hypothesis) in enumerate(zip(nodes, thetas, strict=True)):
        seen = np.array(
            [evidence.detected_switching(theta).levels for theta in thetas_of_hypothesis]
        )
        for level_number in np.unique(number):
            of_level = number == level_number
            deviations[of_level, i] = relative[of_level] - np.interp(
                at[of_level], rows, seen[:, level_number]
            )
        deviations[:, i] += drifts[i]
    return deviations


def _drift(evidence: Evidence, at: Ints, hypothesis: Hypothesis) -> Floats:
    """What a sensor that warms up reads more (mbar) in the rows ``at``.

    A control that acts on the same sensor switches at the same reading: then it is nothing.
    """
    drift = np.zeros(len(at))
    apart = evidence.theta[c.CONTROL_SENSOR] == c.OWN
    for cause in hypothesis:
        if not apart or mechanism_of(cause.effect) != WARMING_SENSOR:
            continue
        neutral = {p.name: p.neutral(evidence.theta) for p in effect_of(cause.effect).parameters}
        acted = np.cumsum(np.diff(evidence.clock, prepend=0.0) * _acting(evidence, cause))
        for i, row in enumerate(at):
            second, cycle = float(evidence.seconds[row]), int(evidence.cycle_of_row[row])
            values = {**neutral, **cause.at(evidence.theta, second, cycle)}
            drift[i] += values["offset"] * (1.0 - math.exp(-acted[row] / values["sets_in"]))
    return drift


def _acting(evidence: Evidence, cause: Cause) -> npt.NDArray[np.bool_]:
    """Rows in which a cause acts."""
    if cause.course == Course.INTERMITTENT:
        return np.isin(evidence.cycle_of_row, list(cause.cycles))
    return (cause.course == Course.CONSTANT) | (evidence.seconds >= cause.onset_s)


def _nodes(evidence: Evidence, at: Ints, hypothesis: Hypothesis) -> Ints:
    """Rows at which the switching of a hypothesis is simulated; rows ``at`` are interpolated.

    A ramp needs its middle and its ends.
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
    """Cycle and index into LEVELS of each measured level."""
    return [
        (cycle, number)
        for cycle in cycles
        for number, name in enumerate(LEVELS)
        if name in evidence.figures[cycle]
    ]


def _coefficients_at(course: Schedule, row: int) -> Theta:
    """The coefficients at a row."""
    return course[bisect_right(course, row, key=lambda change: change[0]) - 1][1]


def _relative_level(evidence: Evidence, cycle: int, number: int) -> float:
    """Measured level (mbar), less the offset of healthy levels from the calibrated twin's."""
    measured = evidence.figures[cycle][LEVELS[number]]
    healthy = evidence.healthy.figures.get(LEVELS[number])
    if healthy is None:
        return measured
    return measured - (healthy.mean - evidence.detected_switching(evidence.theta).levels[number])


def _level_sigmas(evidence: Evidence, cycles: Sequence[int]) -> Floats:
    sigmas = []
    for _, number in _shown(evidence, cycles):
        healthy = evidence.healthy.figures.get(LEVELS[number])
        sigmas.append(healthy.sigma if healthy else UNSEEN_LEVEL_MBAR)
    return np.array(sigmas)


def _common_levels(evidence: Evidence, cycles: Sequence[int]) -> Floats:
    """Covariance (mbar²) of levels by errors common to all cycles."""
    number = np.array([number for _, number in _shown(evidence, cycles)])
    is_learned = np.array([LEVELS[n] in evidence.healthy.figures for n in number], bool)
    sigma = np.where(is_learned, LEVEL_MBAR, evidence.healthy.unseen_level_mbar)
    common: Floats = np.outer(sigma, sigma) * (number[:, None] == number)
    return common
