"""When causes act: onsets of steps and ramps, and cycles of intermittent causes."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from twin.diagnosis.evidence import Evidence, Hypothesis, LogCycles, thinned
from twin.diagnosis.fit import Fitted, profiled, white
from twin.diagnosis.residual_covariance import ResidualWhitener, covariance
from twin.inference.levels import CHI2_95
from twin.model.courses import Cause, Course
from twin.model.effects import effect_of
from twin.monitor.bins import Floats
from twin.signals import MS

TRIED_TIMES = 6  # hypotheses of a course whose times are searched, the most promising ones
MOST_FLIPS = 3  # rounds of a search for the cycles of an intermittent cause
WORTH_FLIPPING = 5.0  # chi-square that another set of cycles must gain
ONSETS, MANY_ONSETS = 16, 64  # tried in a round of a search for an onset
ONSET_S = 0.01  # resolution of the first search for an onset
FARTHEST_S = 4.0  # largest distance of an onset's interval from it


def with_times(
    evidence: Evidence, judged: ResidualWhitener, hypotheses: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Hypotheses; the first few of each course have their onset or their cycles searched."""
    result, timed = [], Counter[Course]()
    for hypothesis in hypotheses:
        course = hypothesis[-1].course
        adjust = _PLACED.get(course)
        if adjust is not None and timed[course] < TRIED_TIMES:
            result.append(adjust(evidence, judged, hypothesis))
            timed[course] += 1
        else:
            result.append(hypothesis)
    return result


def _with_onset(evidence: Evidence, judged: ResidualWhitener, hypothesis: Hypothesis) -> Hypothesis:
    """A hypothesis with the best onset of its last cause, within a cycle of the present one."""
    *others, cause = hypothesis
    return (*others, _with_best_onset(evidence, judged, tuple(others), cause, ONSETS, ONSET_S))


def _with_cycles(
    evidence: Evidence, judged: ResidualWhitener, hypothesis: Hypothesis
) -> Hypothesis:
    """A hypothesis with the best cycles of its last cause: each is tried in and out.

    Unjudged cycles are tried as well: a cause in them affects the gas of the next cycle.
    """
    *others, cause = hypothesis
    units = tried_in_or_out(evidence)
    cause = replace(cause, cycles=_union(unit for unit in units if max(unit) in cause.cycles))
    for _ in range(MOST_FLIPS):
        tried = [cause, *(replace(cause, cycles=cause.cycles ^ unit) for unit in units)]
        chi2 = np.sum(white(evidence, judged, [(*others, trial) for trial in tried]) ** 2, axis=0)
        gains = chi2[0] - chi2[1:]
        better = _union(
            unit for unit, gain in zip(units, gains, strict=True) if gain > WORTH_FLIPPING
        )
        if not better:
            break
        combined = replace(cause, cycles=cause.cycles ^ better)
        finalists = [combined, tried[int(np.argmin(chi2))]]
        chi2 = np.sum(
            white(evidence, judged, [(*others, finalist) for finalist in finalists]) ** 2, axis=0
        )
        cause = finalists[int(np.argmin(chi2))]
    return (*others, cause)


def tried_in_or_out(evidence: Evidence) -> list[frozenset[int]]:
    """Sets of cycles to flip: each cycle, after a gap with the one in which the model settles."""
    numbers = [int(number) for number in evidence.numbers]
    units, before = [], frozenset[int]()
    for position, number in enumerate(numbers):
        follows_a_gap = position > 0 and number > numbers[position - 1] + 1
        if follows_a_gap and position not in evidence.judged:
            before = frozenset({number})
        else:
            units.append(before | {number})
            before = frozenset()
    return units


def _union(cycles: Iterable[frozenset[int]]) -> frozenset[int]:
    return frozenset[int]().union(*cycles)


def _with_begin(evidence: Evidence, judged: ResidualWhitener, hypothesis: Hypothesis) -> Hypothesis:
    """A hypothesis whose last cause, a ramp, grows from the best cycle to the size it reaches.

    The linear model chose the cycle: of a delay that grows large, it chooses a wrong one.
    """
    *others, cause = hypothesis
    starts = evidence.seconds[evidence.starts[np.array(judged.cycles)[1:]]]
    tried = [cause, *(_grown_from(evidence, cause, float(onset)) for onset in (0.0, *starts))]
    chi2 = np.sum(white(evidence, judged, [(*others, trial) for trial in tried]) ** 2, axis=0)
    return (*others, tried[int(np.argmin(chi2))])


def _grown_from(evidence: Evidence, ramp: Cause, onset: float) -> Cause:
    """A ramp from another onset (s) that reaches the same size in the last row."""
    last = float(evidence.seconds[-1])
    faster = (last - ramp.onset_s) / (last - onset)
    shaping = {p.name for p in effect_of(ramp.effect).parameters if p.shapes} | {*ramp.law()}
    values = {
        name: value if name in shaping else value * faster for name, value in ramp.values.items()
    }
    return replace(ramp, onset_s=onset, values=values)


_PLACED = {
    Course.STEP: _with_onset,
    Course.RAMP: _with_begin,
    Course.INTERMITTENT: _with_cycles,
}


def with_fine_onsets(
    evidence: Evidence, judged: ResidualWhitener, hypothesis: Hypothesis
) -> Hypothesis:
    """A hypothesis with the onset of every step searched to the row, with known sizes."""
    for number, cause in enumerate(hypothesis):
        if cause.course == Course.STEP:
            others = (*hypothesis[:number], *hypothesis[number + 1 :])
            begun = _with_best_onset(evidence, judged, others, cause, MANY_ONSETS, MS)
            hypothesis = (*hypothesis[:number], begun, *hypothesis[number + 1 :])
    return hypothesis


def _with_best_onset(
    evidence: Evidence,
    judged: ResidualWhitener,
    others: Hypothesis,
    cause: Cause,
    count: int,
    fine: float,
) -> Cause:
    """A cause with its best onset, within a cycle of the present one; ``count`` in round one."""
    cycle = float(np.median(np.diff(evidence.seconds[evidence.starts[:-1]])))
    low, high = cause.onset_s - cycle, cause.onset_s + cycle
    while (high - low) / count > fine:
        onsets = np.linspace(low, high, count)
        best = onsets[int(np.argmin(_misfits(evidence, judged, others, cause, onsets)))]
        cause = replace(cause, onset_s=float(best))
        reach, count = 1.5 * (high - low) / count, ONSETS
        low, high = best - reach, best + reach
    return cause


def sharp_onset(
    whole: LogCycles, part: Evidence, found: Fitted, number: int
) -> tuple[Hypothesis, tuple[float, float]]:
    """A hypothesis with the best onset of one of its causes, and the onset's interval."""
    cause, hypothesis = found.hypothesis[number], found.hypothesis
    others = (*hypothesis[:number], *hypothesis[number + 1 :])
    begins = whole.begins
    cycle_starts = part.seconds[part.starts[part.judged]]
    index = int(np.searchsorted(cycle_starts, cause.onset_s))
    low = cycle_starts[index - 2] if index >= 2 else begins[whole.judged[0]]
    high = cycle_starts[index + 1] if index + 1 < len(cycle_starts) else np.inf
    while True:
        inside = [cycle for cycle in whole.judged if low <= begins[cycle] <= high]
        selected = thinned(whole, inside, ONSETS)
        judged = covariance(selected, (*others, cause)).of(selected.judged)
        tried = selected.seconds[selected.starts[selected.judged]]
        best = int(np.argmin(_misfits(selected, judged, others, cause, tried)))
        cause = replace(cause, onset_s=float(tried[best]))
        if len(inside) <= ONSETS:
            break
        low, high = tried[max(best - 2, 0)], tried[min(best + 2, len(tried) - 1)]
    cause = _with_onset(selected, judged, (*others, cause))[-1]
    hypothesis = (*hypothesis[:number], cause, *hypothesis[number + 1 :])
    return hypothesis, onset_interval(selected, judged, hypothesis, number, found.leftover)


def _misfits(
    evidence: Evidence, judged: ResidualWhitener, others: Hypothesis, cause: Cause, onsets: Floats
) -> Floats:
    tried = [(*others, replace(cause, onset_s=float(onset))) for onset in onsets]
    chi2: Floats = np.sum(white(evidence, judged, tried) ** 2, axis=0)
    return chi2


def onset_interval(
    evidence: Evidence,
    judged: ResidualWhitener,
    hypothesis: Hypothesis,
    number: int,
    leftover: float,
) -> tuple[float, float]:
    """95 % profile-likelihood interval (s) of a step's onset.

    Sizes are fitted for each onset.
    """
    cause = hypothesis[number]
    if cause.course != Course.STEP:
        return cause.onset_s, cause.onset_s
    sampled = float(np.median(np.diff(evidence.seconds)))
    reach = np.geomspace(max(ONSET_S, sampled), FARTHEST_S, 10)
    onsets = cause.onset_s + np.concatenate([-reach[::-1], [0.0], reach])
    begun = [
        (*hypothesis[:number], replace(cause, onset_s=float(onset)), *hypothesis[number + 1 :])
        for onset in onsets
    ]
    misfit = profiled(evidence, judged, begun)
    inside = np.flatnonzero(misfit < misfit.min() + CHI2_95 * max(leftover**2, 1.0))
    inside = np.union1d(inside, len(reach))  # the onset itself
    last = len(onsets) - 1  # the first that is rejected bounds it
    return float(onsets[max(inside[0] - 1, 0)]), float(onsets[min(inside[-1] + 1, last)])
