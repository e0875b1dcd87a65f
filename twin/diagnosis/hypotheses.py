"""Hypotheses as points: sizes of causes in multiples of what is worth an alarm, with bounds."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.model.courses import HOUR, Cause, Course
from twin.model.effects import EFFECTS, Effect, Parameter, effect_of
from twin.monitor.bins import Floats

WEATHER = "ambient_pressure"  # its typical size is one sigma of what the weather does
# Of the logarithm of how often effects come: a thousandfold prior is known to be tenfold, as sites
# differ. Chosen.
PRIOR_TEMPER = 1.0 / 3.0
LOCAL_ONSETS = 20  # as many onsets in a cycle can be told apart


def parameters(hypothesis: Hypothesis) -> list[Parameter]:
    """What can be sized in a hypothesis, in order."""
    return [one for cause in hypothesis for one in effect_of(cause.effect).parameters]


def by_each_law(hypothesis: Hypothesis, place: int) -> list[Hypothesis]:
    """A hypothesis with one of its causes acting by each law that it may act by."""
    cause = hypothesis[place]
    causes = [
        replace(cause, values={**cause.values, **law}) for law in effect_of(cause.effect).laws()
    ]
    return [(*hypothesis[:place], one, *hypothesis[place + 1 :]) for one in causes]


def bounds(evidence: Evidence, hypothesis: Hypothesis) -> tuple[Floats, Floats]:
    """Least and greatest sizes, in typical ones away from neutral."""
    table, theta = parameters(hypothesis), evidence.theta
    low = np.array([p.steps_to(p.low, theta) for p in table])
    high = np.array([p.steps_to(p.high, theta) for p in table])
    return low, high


def sized(evidence: Evidence, hypothesis: Hypothesis, x: Floats) -> Hypothesis:
    """The hypothesis with sizes ``x``, in typical ones away from neutral, kept within bounds.

    A ramp's size is what it has come to at the end of the log.
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
    found = []
    for cause in hypothesis:
        for p in effect_of(cause.effect).parameters:
            if cause.course == Course.RAMP and not p.shapes:
                change = cause.values.get(p.name, 0.0) * hours(evidence, cause)
                found.append(change / p.typical)
            else:
                value = cause.values.get(p.name, p.neutral(evidence.theta))
                found.append(p.steps_to(value, evidence.theta))
    return np.array(found)


def hours(evidence: Evidence, cause: Cause) -> float:
    """How long a ramp has gone on at the end of the log."""
    return max(float(evidence.seconds[-1]) - cause.onset_s, 1e-3) / HOUR


def price(evidence: Evidence, hypothesis: Hypothesis) -> float:
    """Chi-square a hypothesis must be worth: its sizes, and how many like it there are."""
    return sum(_price(evidence, cause) for cause in hypothesis)


def often(evidence: Evidence, effect: Effect) -> float:
    """How often an effect comes; weather that somebody measures is followed, and no cause."""
    followed = effect.name == WEATHER and "ambient" in evidence.told
    return min(effect.often, 1.0) if followed else effect.often


def rarity(evidence: Evidence, hypothesis: Hypothesis) -> float:
    """What of a price is how seldom its effects come, beside what wears; the log says the rest."""
    return sum(-2.0 * math.log(often(evidence, effect_of(cause.effect))) for cause in hypothesis)


def score_without_prior(evidence: Evidence, score: float, hypothesis: Hypothesis) -> float:
    """A score by what the log shows: how seldom the effects come is left out."""
    return score - rarity(evidence, hypothesis)


def score_with_tempered_prior(evidence: Evidence, score: float, hypothesis: Hypothesis) -> float:
    """A score for a probability: how seldom effects come is known roughly, and counts as much."""
    return score - (1.0 - PRIOR_TEMPER) * rarity(evidence, hypothesis)


def _price(evidence: Evidence, cause: Cause) -> float:
    effect, cycles = effect_of(cause.effect), len(evidence.judged)
    ways = len(EFFECTS) * len(effect.laws()) / often(evidence, effect)
    if cause.course == Course.STEP:
        ways *= LOCAL_ONSETS * cycles
    elif cause.course == Course.RAMP:
        ways *= 2.0 if cause.onset_s <= 0.0 else 2.0 * cycles
    elif cause.course == Course.INTERMITTENT:
        acts = sum(int(evidence.numbers[one]) in cause.cycles for one in evidence.judged)
        ways *= 2.0 * math.comb(cycles, acts)
    cost = 2.0 * len(effect.parameters) + 2.0 * math.log(ways)
    return cost + float(sizes(evidence, (cause,))[0]) ** 2 if effect.name == WEATHER else cost
