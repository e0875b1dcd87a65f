"""Hypotheses as points: sizes of causes in multiples of typical ones, bounds, and priors."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.inference.priors import PRIOR_TEMPER, by_gauge
from twin.model import theta as c
from twin.model.courses import HOUR, Cause, Course
from twin.model.effects import EFFECTS, Parameter, effect_of
from twin.monitor.bins import Floats
from twin.signals import BAR

LOCAL_ONSETS = 20  # onsets in a cycle that can be told apart


def parameters(hypothesis: Hypothesis) -> list[Parameter]:
    """Parameters of the causes of a hypothesis, in order."""
    return [parameter for cause in hypothesis for parameter in effect_of(cause.effect).parameters]


def by_each_law(hypothesis: Hypothesis, number: int) -> list[Hypothesis]:
    """A hypothesis with one of its causes by each law that it may act by."""
    cause = hypothesis[number]
    causes = [
        replace(cause, values={**cause.values, **law}) for law in effect_of(cause.effect).laws()
    ]
    return [(*hypothesis[:number], varied, *hypothesis[number + 1 :]) for varied in causes]


def bounds(evidence: Evidence, hypothesis: Hypothesis) -> tuple[Floats, Floats]:
    """Bounds of the sizes, in typical ones from neutral."""
    table, theta = parameters(hypothesis), evidence.theta
    low = np.array([p.steps_to(p.low, theta) for p in table])
    high = np.array([p.steps_to(p.high, theta) for p in table])
    return low, high


def sized(evidence: Evidence, hypothesis: Hypothesis, x: Floats) -> Hypothesis:
    """The hypothesis with sizes ``x``, in typical ones from neutral, kept within bounds.

    A ramp's size is its value at the end of the log.
    """
    x = np.clip(x, *bounds(evidence, hypothesis))
    sizes = iter(x)
    return tuple(_sized(evidence, cause, sizes) for cause in hypothesis)


def _sized(evidence: Evidence, cause: Cause, sizes: Iterator[float]) -> Cause:
    values = cause.law()
    for p in effect_of(cause.effect).parameters:
        size = float(next(sizes))
        if cause.course == Course.RAMP and not p.shapes:
            values[p.name] = size * p.typical / hours(evidence, cause)
        else:
            values[p.name] = float(np.clip(p.after(size, evidence.theta), p.low, p.high))
    return replace(cause, values=values)


def sizes(evidence: Evidence, hypothesis: Hypothesis) -> Floats:
    """The sizes of a hypothesis: the inverse of ``sized``."""
    values = []
    for cause in hypothesis:
        for p in effect_of(cause.effect).parameters:
            if cause.course == Course.RAMP and not p.shapes:
                change = cause.values.get(p.name, 0.0) * hours(evidence, cause)
                values.append(change / p.typical)
            else:
                value = cause.values.get(p.name, p.neutral(evidence.theta))
                values.append(p.steps_to(value, evidence.theta))
    return np.array(values)


def hours(evidence: Evidence, cause: Cause) -> float:
    """Duration of a ramp until the end of the log (h)."""
    return max(float(evidence.seconds[-1]) - cause.onset_s, 1e-3) / HOUR


def price(evidence: Evidence, hypothesis: Hypothesis) -> float:
    """Log-prior penalty (chi-square) of a hypothesis: its sizes, and the number of alternatives.

    A gauge of the supply is evidence of one supply pressure and against others.
    """
    prices = sum(_price(evidence, cause) for cause in hypothesis)
    if any(c.SUPPLY in effect_of(cause.effect).touches for cause in hypothesis):
        prices += _price_by_gauge(evidence, hypothesis)
    return prices


def _price_by_gauge(evidence: Evidence, hypothesis: Hypothesis) -> float:
    """Mean over the cycles of what the gauge says, as it is one gauge; 0 without one."""
    course, cycles = evidence.course(hypothesis), evidence.judged
    begins = [row for row, _ in course]
    at = np.searchsorted(begins, [evidence.nozzle_on[cycle] for cycle in cycles], "right") - 1
    drops = np.array([evidence.theta[c.SUPPLY] - course[number][1][c.SUPPLY] for number in at])
    return float(np.mean(by_gauge(drops / BAR, evidence.supply_drops[cycles])))


def often(evidence: Evidence, cause: Cause) -> float:
    """Prior frequency of a cause, over that of wear; weather seldom changes within one log."""
    effect = effect_of(cause.effect)
    usual = effect.frequency(ambient_is_measured="ambient" in evidence.told)
    return min(usual, 1.0) if effect.is_weather and cause.course != Course.CONSTANT else usual


def rarity(evidence: Evidence, hypothesis: Hypothesis) -> float:
    """Part of the penalty that comes from the prior frequency of its effects."""
    return sum(-2.0 * math.log(often(evidence, cause)) for cause in hypothesis)


def score_without_prior(evidence: Evidence, score: float, hypothesis: Hypothesis) -> float:
    """A score by the log alone, without the prior frequency of the effects."""
    return score - rarity(evidence, hypothesis)


def score_with_tempered_prior(evidence: Evidence, score: float, hypothesis: Hypothesis) -> float:
    """A score for a probability: the prior frequency is tempered, as it is only roughly known."""
    return score - (1.0 - PRIOR_TEMPER) * rarity(evidence, hypothesis)


def _price(evidence: Evidence, cause: Cause) -> float:
    effect, cycles = effect_of(cause.effect), len(evidence.judged)
    alternatives = len(EFFECTS) * len(effect.laws()) / often(evidence, cause)
    if cause.course == Course.STEP:
        alternatives *= LOCAL_ONSETS * cycles
    elif cause.course == Course.RAMP:
        alternatives *= 2.0 if cause.onset_s <= 0.0 else 2.0 * cycles
    elif cause.course == Course.INTERMITTENT:
        acting_cycles = sum(
            int(evidence.numbers[position]) in cause.cycles for position in evidence.judged
        )
        alternatives *= 2.0 * math.comb(cycles, acting_cycles)
    cost = 2.0 * len(effect.parameters) + 2.0 * math.log(alternatives)
    return cost + float(sizes(evidence, (cause,))[0]) ** 2 if effect.is_weather else cost
