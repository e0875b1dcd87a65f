"""The search for causes: every effect with every course, alone and together, fitted and ranked.

Forward: what the linear model promises is fitted in the non-linear one, singles and pairs side by
side, because the members of a true pair may each look poor alone. What explains most is kept if it
is worth its price, then the search begins anew about it. Backward: each cause must still be worth
its price beside the others. Last, each must predict cycles that no size was fitted to; where the
first one does not, the search begins again with the next.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations

import numpy as np

from twin.diagnosis.covariance import Covariance, Weights, covariance
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis, at_once, thinned
from twin.diagnosis.fit import Fitted, fit, interval, profiled, white
from twin.diagnosis.hypotheses import (
    WEATHER,
    bounds,
    by_each_law,
    parameters,
    score_with_tempered_prior,
    score_without_prior,
    sized,
    sizes,
)
from twin.diagnosis.linear_screening import (
    Columns,
    Signatures,
    columns,
    pairs,
    promises,
    signatures,
)
from twin.inference.levels import CHI2_95, CHI2_999, SIGMAS_95
from twin.model.catalogue import has_room
from twin.model.courses import Cause, Course
from twin.monitor.bins import Floats
from twin.signals import MS

MOST_CAUSES = 3
MOST_ROUNDS = 4  # of adding and pruning
SIGNIFICANT = 20.0  # chi-square, beyond its price, that a cause must gain before it is named
SHARE = (
    0.005  # of what is explained already, that one more cause must gain: else it mends the model
)
# Of an effect's typical size: less is within what calibration leaves, or beside another cause mends
# what the model gets wrong about that.
SMALLEST, SMALLEST_MORE = 0.2, 0.4
LEAST_UNSEEN = (
    1.0  # chi-square that it must surely gain on unseen cycles: what a size gains by chance
)
TRIED_FIRST = 3  # single causes to begin with, until one holds in cycles it was not fitted to
TRIED_ALONE = 5  # hypotheses that are compared with weights about themselves
NEAR = 2.5  # times the least score, up to which they are
QUIET = 1.2  # sigmas left, below which there is nothing to compare
HOPEFUL = 5.0  # chi-square that the linear model must promise of one more cause
TRIED_PAIRS, TRIED_MORE, TRIED_TIMES = 12, 8, 6
# Sigmas that the best single cause leaves, above which sizes are so great that a linear model does
# not tell courses apart. Chosen: in pairs of the second world's batteries one leaves up to 4.
GREAT = 10.0
SECOND = 0.5  # of the best gain, above which an effect's second course is fitted as well
NEARLY = 0.3  # of the best gain, above which an effect may turn out to be a rival
START = np.array([0.4, 1.4, 4.0])  # typical sizes to begin a fit from
START_OF_TIMES = np.array([0.4, 1.0, 1.7, 2.5, 3.5, 5.0])  # what moves an edge is far from linear
MOST_FLIPS = 3  # rounds of looking for the cycles that something comes in
WORTH_FLIPPING = 5.0  # chi-square that another set of cycles must gain
ONSETS, MANY_ONSETS = 16, 64  # in a round of looking for when a step began
ONSET_S = 0.01  # to which it is found at first
FARTHEST_S = 4.0  # from an onset, that its interval may reach

Progress = Callable[[str], None]
_NO_SIZES = np.empty(0), np.empty(0)


@dataclass(frozen=True)
class Search:
    """What the search found: the causes with their rivals, judged alike."""

    known: Covariance  # about what was found
    healthy: float  # chi-square without any cause, of the fitted cycles
    found: Fitted | None
    ranking: list[Fitted]  # of all single causes, and of what was found
    rivals: list[list[Fitted]]  # of each cause: what could stand in its place
    ends: tuple[Floats, Floats]  # of the 95 % interval of each size found
    onsets: list[tuple[float, float]]  # 95 % interval of each cause's onset


def search(
    evidence: Evidence, fitted: Sequence[int], known: Covariance, progress: Progress
) -> Search:
    """Find up to three causes; sizes and ranking of effects from the ``fitted`` cycles only.

    When a cause acts (course, onset, which cycles) is taken from all of them: no other shows it.
    ``known`` is about the healthy twin.
    """
    progress("screening all effects and courses")
    judged, weights = known.of(evidence.judged), known.of(fitted)
    alone = signatures(evidence, evidence.judged)
    tried = _fit_singles(evidence, judged, weights, alone, progress)
    singles = _ranked(evidence, judged, tried)
    healthy = _healthy(evidence, weights)
    if not any(_worth(healthy, healthy, 0.0, one) for one in singles):
        return Search(known, healthy, None, singles, [], _NO_SIZES, [])
    firsts = _likeliest(evidence, fitted, tried, singles, progress)[:TRIED_FIRST]
    for first in firsts:
        here = _about(evidence, fitted, first.hypothesis)
        others = [one.hypothesis for one in singles if one.effects != first.effects]
        rest = fit(evidence, here.weights, others, best_only=True)
        ranked = [here.found, *sorted(rest, key=lambda one: one.score)]
        here = _added(evidence, fitted, here, ranked, alone, progress)
        progress("asking cycles that nothing was fitted to")
        confirmed = _confirmed(evidence, fitted, here)
        none = healthy + weights.volume
        if confirmed and _beats(none, confirmed, here.weights.volume):
            break
    else:
        return Search(known, healthy, None, singles, [], _NO_SIZES, [])
    singles = ranked
    if confirmed is not here.found:
        here = _about(evidence, fitted, confirmed.hypothesis)
    progress("looking for what the log cannot tell apart")
    beside = _beside_rivals(evidence, fitted, here, singles)
    if beside is None:
        return Search(known, healthy, None, singles, [], _NO_SIZES, [])
    here, rivals = beside
    found = here.found
    onsets = [
        _onset_interval(evidence, here.judged, found.hypothesis, number, found.leftover)
        for number in range(len(found.hypothesis))
    ]
    ends = _ends(evidence, here.weights, found)
    return Search(here.known, here.healthy, found, singles, rivals, ends, onsets)


@dataclass(frozen=True)
class _Found:
    """Causes with the sizes that suit them best by weights about themselves."""

    found: Fitted
    known: Covariance
    judged: Weights  # of all judged cycles
    weights: Weights  # of the fitted ones
    healthy: float  # chi-square without any cause


def _about(evidence: Evidence, fitted: Sequence[int], hypothesis: Hypothesis) -> _Found:
    """A hypothesis fitted anew, weighed by what scatters and is uncertain about it."""
    known = covariance(evidence, hypothesis)
    weights = known.of(fitted)
    (found,) = fit(evidence, weights, [hypothesis])
    return _Found(found, known, known.of(evidence.judged), weights, _healthy(evidence, weights))


def _added(
    evidence: Evidence,
    fitted: Sequence[int],
    here: _Found,
    singles: Sequence[Fitted],
    alone: Signatures,
    progress: Progress,
) -> _Found:
    """With more causes, while one more is worth its price; less those that no longer are."""
    before: set[frozenset[tuple[str, Course]]] = set()
    for _ in range(MOST_ROUNDS):
        found = here.found
        # With other weights what was pruned comes back: then the search goes round.
        if len(found.hypothesis) == MOST_CAUSES or found.kind in before:
            break
        before.add(found.kind)
        progress(f"looking for what else there is beside {', '.join(found.effects)}")
        more = _best_addition(evidence, here, singles, alone)
        if more is None:
            break
        here = _about(evidence, fitted, more.hypothesis)
        pruned = _pruned(evidence, here.weights, here.found, here.healthy)
        here = replace(here, found=pruned)
    return here


def _beside_rivals(
    evidence: Evidence, fitted: Sequence[int], here: _Found, singles: list[Fitted]
) -> tuple[_Found, list[list[Fitted]]] | None:
    """What was found and, for each of its causes, what could stand in its place.

    Where that is clearly better, the way there led past it: it takes the place of what was found.
    Where that in turn does not hold in cycles that it was not fitted to, nothing listed is what
    acts there, and neither stays. None if no cause does.
    """
    looked = set[frozenset[tuple[str, Course]]]()
    while True:
        if any(cause.course == Course.STEP for cause in here.found.hypothesis):
            timed = _finely_timed(evidence, here.judged, here.found.hypothesis)
            (found,) = fit(evidence, here.weights, [timed])
            here = replace(here, found=found)
        looked.add(here.found.kind)
        rivals = _rivals(evidence, here.judged, here.weights, here.found, singles)
        better = _overtaking(here.found, rivals)
        if better is None or better.kind in looked:
            break
        known = covariance(evidence, better.hypothesis)
        confirmed = _confirmed(evidence, fitted, replace(here, found=better, known=known))
        if confirmed is better:
            here = _about(evidence, fitted, better.hypothesis)
            continue
        if confirmed and stranger(better, here.found) in confirmed.effects:
            break
        place = next(number for number, some in enumerate(rivals) if _has(some, better))
        others = here.found.hypothesis[:place] + here.found.hypothesis[place + 1 :]
        if not others:
            return None
        here = _about(evidence, fitted, others)
    if here.found.effects == (WEATHER,):  # it may have come first by its prior alone
        found, *rivals[0] = sorted(
            [here.found, *rivals[0]],
            key=lambda one: score_with_tempered_prior(evidence, one.score, one.hypothesis),
        )
        if found is not here.found:
            here = replace(here, found=found, known=covariance(evidence, found.hypothesis))
    return here, rivals


def _has(some: Sequence[Fitted], one: Fitted) -> bool:
    return any(other is one for other in some)


def stranger(rival: Fitted, found: Fitted) -> str:
    """The effect of a rival that is not among those found."""
    return next(one for one in rival.effects if one not in found.effects)


def _ends(evidence: Evidence, weights: Weights, found: Fitted) -> tuple[Floats, Floats]:
    """95 % interval of each size, by whichever law of a cause the log cannot reject."""
    low, high = interval(evidence, weights, found)
    others = [
        other
        for place in range(len(found.hypothesis))
        for other in by_each_law(found.hypothesis, place)
        if other != found.hypothesis
    ]
    worst = found.chi2 + CHI2_95 * max(found.leftover**2, 1.0)
    for other in fit(evidence, weights, others) if others else []:
        if other.chi2 < worst:
            also = interval(evidence, weights, other)
            low, high = np.minimum(low, also[0]), np.maximum(high, also[1])
    return low, high


def _healthy(evidence: Evidence, weights: Weights) -> float:
    residual = white(evidence, weights, [HEALTHY])
    return float(np.sum(residual**2))


def _ranked(evidence: Evidence, judged: Weights, found: Sequence[Fitted]) -> list[Fitted]:
    """The best course of each set of effects, the best first.

    All cycles choose the course: in which of them an effect acts does not show in the fitted ones.
    """
    residual = white(evidence, judged, [one.hypothesis for one in found])
    best: dict[tuple[str, ...], tuple[float, Fitted]] = {}
    for one, chi2 in zip(found, np.sum(residual**2, axis=0), strict=True):
        key, score = tuple(sorted(one.effects)), float(chi2) + one.score - one.chi2
        if key not in best or score < best[key][0]:
            best[key] = score, one
    return sorted((one for _, one in best.values()), key=lambda one: one.score)


def _fit_singles(
    evidence: Evidence, judged: Weights, weights: Weights, alone: Signatures, progress: Progress
) -> list[Fitted]:
    """Fit every effect with its most promising courses."""
    linear = columns(evidence, judged, alone)
    promised = promises(evidence, judged, linear, each=2)
    first = {one.hypothesis[0].effect: one for one in reversed(promised)}
    hypotheses = [
        one.hypothesis
        for one in promised
        if one is first[one.hypothesis[0].effect] or one.gain > SECOND * promised[0].gain
    ]
    progress("fitting single causes")
    started = _started(evidence, judged, hypotheses)
    tried = fit(evidence, weights, _timed(evidence, judged, started))
    if min(one.leftover for one in tried) < GREAT:
        return tried
    progress("what acts is great: fitting each cause with every course")
    more = [one.hypothesis for one in promises(evidence, judged, linear, each=len(Course))]
    started = _started(evidence, judged, [one for one in more if one not in hypotheses])
    return tried + fit(evidence, weights, _timed(evidence, judged, started))


def _likeliest(
    evidence: Evidence,
    fitted: Sequence[int],
    tried: Sequence[Fitted],
    singles: Sequence[Fitted],
    progress: Progress,
) -> list[Fitted]:
    """Single causes, the likeliest first, each with weights about itself; wide ones cost.

    What scatters moves with the causes: about the healthy twin, a valve's half millisecond is not
    where a delay of ten has put its edge. All cycles choose the course, the fitted ones the effect.
    Weather that the log cannot reject beside the best comes first: it changes every week.
    """
    if not (singles[0].leftover > QUIET or _weather(evidence, singles)):
        return list(singles)
    progress("comparing the best, each with its own weights")
    ranked = sorted(tried, key=lambda one: one.score)
    near = [one for one in ranked if one.score < NEAR * ranked[0].score][:TRIED_ALONE]
    near += [one for one in _weather(evidence, ranked) if not _has(near, one)]

    def alone(first: Fitted) -> tuple[float, float, Fitted]:
        known = covariance(evidence, first.hypothesis, both_ways=False)
        judged, weights = known.of(evidence.judged), known.of(fitted)
        (one,) = fit(evidence, weights, [first.hypothesis])
        chi2 = float(np.sum(white(evidence, judged, [one.hypothesis]) ** 2))
        price = one.score - one.chi2
        return chi2 + judged.volume + price, one.score + weights.volume, one

    best: dict[tuple[str, ...], tuple[float, float, Fitted]] = {}
    for each in at_once(alone, near):
        everywhere, _, one = each
        if one.effects not in best or everywhere < best[one.effects][0]:
            best[one.effects] = each
    _, least, found = min(best.values(), key=lambda each: each[1])
    order = [one for *_, one in sorted(best.values(), key=lambda each: each[1])]
    for weather in _weather(evidence, order):
        if best[weather.effects][1] < least + CHI2_999 * max(found.leftover**2, 1.0):
            return [weather, *(one for one in order if one is not weather)]
    return order


def _weather(evidence: Evidence, ranked: Sequence[Fitted]) -> list[Fitted]:
    """Of fits, those by another ambient pressure, where nobody measures it.

    What ejectors do in it is not known well. So they are compared with weights about themselves,
    though they look poor by those of the calibration's day.
    """
    if "ambient" in evidence.told:
        return []
    return [one for one in ranked if one.effects == (WEATHER,)]


def _started(
    evidence: Evidence, judged: Weights, hypotheses: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """The same with the last cause at the best of some sizes, by each law that it may act by.

    A delay moves what is sharp: from far away a step towards its true size does not seem to help.
    """
    tried: list[list[Hypothesis]] = []
    for hypothesis in chain.from_iterable(by_each_law(one, len(one) - 1) for one in hypotheses):
        low, high = bounds(evidence, hypothesis)
        x = sizes(evidence, hypothesis)
        last = len(x) - len(parameters(hypothesis[-1:]))
        around = [x]
        tried_sizes = START_OF_TIMES if parameters(hypothesis[-1:])[0].unit == "ms" else START
        for size in (*-tried_sizes, *tried_sizes):
            if low[last] < size < high[last]:
                around.append(np.concatenate([x[:last], [size], x[last + 1 :]]))
        tried.append([sized(evidence, hypothesis, one) for one in around])
    every = [one for some in tried for one in some]
    chi2 = np.sum(white(evidence, judged, every) ** 2, axis=0)
    best, first = [], 0
    for some in tried:
        best.append(some[int(np.argmin(chi2[first : first + len(some)]))])
        first += len(some)
    return best


def _best_addition(
    evidence: Evidence, here: _Found, singles: Sequence[Fitted], alone: Signatures
) -> Fitted | None:
    """What is found with one more cause, or a pair in its place; None if not worth it."""
    found, judged, weights = here.found, here.judged, here.weights
    about = found.hypothesis
    beside = signatures(evidence, judged.cycles, about)
    promised = promises(evidence, judged, columns(evidence, judged, beside), each=2)
    new = [one for one in promised if _can_join(evidence, one.hypothesis[0], about)]
    new = [one for one in new[:TRIED_MORE] if one.gain > HOPEFUL]
    candidates = _started(evidence, judged, [(*about, *one.hypothesis) for one in new])
    if len(about) == 1:
        candidates += _linear_pairs(evidence, judged, columns(evidence, judged, alone))
        candidates += _fitted_pairs(evidence, weights, singles[:TRIED_PAIRS], found)
    candidates = _timed(evidence, judged, candidates)
    tried = _ranked(evidence, judged, fit(evidence, weights, candidates, best_only=True))
    for one in tried:
        if _worth(here.healthy, found.chi2, found.chi2 - found.score, one):
            return one
    return None


def _can_join(evidence: Evidence, cause: Cause, others: Hypothesis) -> bool:
    """Whether a cause can act beside others: another one, and the model has room for it."""
    names = [one.effect for one in others]
    return cause.effect not in names and has_room(evidence.theta, (*names, cause.effect))


def _linear_pairs(evidence: Evidence, judged: Weights, alone: Columns) -> list[Hypothesis]:
    """Pairs that explain more than any single cause in the linear model."""
    singles = promises(evidence, judged, alone, each=2)
    two = pairs(evidence, judged, alone, singles)[:TRIED_PAIRS]
    return [one.hypothesis for one in two if one.gain > singles[0].gain + HOPEFUL]


def _fitted_pairs(
    evidence: Evidence, weights: Weights, singles: Sequence[Fitted], found: Fitted
) -> list[Hypothesis]:
    """Pairs of single causes, each as it was fitted: delays are far from linear."""
    both = [
        (*one.hypothesis, *two.hypothesis)
        for one, two in combinations(singles, 2)
        if has_room(evidence.theta, (*one.effects, *two.effects))
    ]
    chi2 = np.sum(white(evidence, weights, both) ** 2, axis=0)
    best = np.argsort(chi2)[:TRIED_MORE]
    return [both[i] for i in best if chi2[i] < found.chi2]


def _worth(healthy: float, chi2: float, paid: float, fitted: Fitted) -> bool:
    """Whether a hypothesis gains enough over a smaller one, and all its causes are big enough."""
    scale = max(fitted.leftover**2, 1.0)
    gain = (chi2 - fitted.chi2) / scale - (fitted.score - fitted.chi2 + paid)
    enough = max(SIGNIFICANT, SHARE * (healthy - chi2) / scale)
    least = SMALLEST if len(fitted.hypothesis) == 1 else SMALLEST_MORE
    return gain > enough and _smallest(fitted) >= least


def _beats(alone: float, found: Fitted, volume: float) -> bool:
    """Whether causes are big enough and explain more than none, each by weights about itself.

    ``alone`` is the chi-square without any, with the volume of its weights.
    """
    gain = (alone - found.chi2 - volume) / max(found.leftover**2, 1.0)
    return gain - (found.score - found.chi2) > SIGNIFICANT and _smallest(found) >= SMALLEST


def _smallest(fitted: Fitted) -> float:
    """The size of the smallest cause, in typical ones."""
    return min(_sizes_of_causes(fitted))


def _sizes_of_causes(fitted: Fitted) -> list[float]:
    """The size of each cause, in typical ones: of the parameter that is farthest from neutral."""
    first, sizes = 0, []
    for cause in fitted.hypothesis:
        own = parameters((cause,))
        much = [not one.shapes for one in own]
        sizes.append(float(np.abs(fitted.x[first : first + len(own)][much]).max()))
        first += len(own)
    return sizes


def _pruned(evidence: Evidence, weights: Weights, found: Fitted, healthy: float) -> Fitted:
    """Without the causes that are not worth their price beside the others."""
    while len(found.hypothesis) > 1:
        without = [
            tuple(c for i, c in enumerate(found.hypothesis) if i != left)
            for left in range(len(found.hypothesis))
        ]
        best = min(fit(evidence, weights, without), key=lambda one: one.score)
        if _worth(healthy, best.chi2, best.chi2 - best.score, found):
            break
        found = best
    return found


def _confirmed(evidence: Evidence, fitted: Sequence[int], here: _Found) -> Fitted | None:
    """Without causes that are too small or do not predict cycles they were not fitted to.

    None if none is left. Each is left out in turn and the others are fitted anew. The least certain
    goes first.
    """
    held_out = [one for one in evidence.judged if one not in fitted]
    found, weights, known = here.found, here.weights, here.known
    while True:
        unseen = known.of(held_out)
        without = [
            tuple(c for i, c in enumerate(found.hypothesis) if i != left)
            for left in range(len(found.hypothesis))
        ]
        others = fit(evidence, weights, without) if without[0] else []
        without = [one.hypothesis for one in others] or [HEALTHY]
        gains = [held_out_gain(evidence, unseen, one, found.hypothesis) for one in without]
        least = min(range(len(gains)), key=lambda left: gains[left][0])
        sizes_found = _sizes_of_causes(found)
        if others and min(sizes_found) < SMALLEST_MORE:  # beside the others it became too small
            least = sizes_found.index(min(sizes_found))
        elif gains[least][0] > LEAST_UNSEEN:
            return found
        if not others:
            return None
        found = others[least]
        known = covariance(evidence, found.hypothesis)


def held_out_gain(
    evidence: Evidence, unseen: Weights, without: Hypothesis, hypothesis: Hypothesis
) -> tuple[float, float]:
    """95 % interval of the chi-square that a hypothesis takes away from another on unseen cycles.

    Where both predict r and r + d, |r + d|² − |r|² = |d|² + 2·d·r, and d·r scatters by |d| times
    the sigmas that are left: that holds with one cycle as well.
    """
    before, after = white(evidence, unseen, [without, hypothesis]).T
    left = max(float(np.sqrt(np.mean(after**2))), 1.0)
    gain = float(before @ before - after @ after)
    reach = SIGMAS_95 * 2.0 * float(np.linalg.norm(before - after)) * left
    return gain - reach, gain + reach


def _overtaking(found: Fitted, rivals: Sequence[Sequence[Fitted]]) -> Fitted | None:
    """What stands better in place of a cause found; the way there did not lead past it."""
    best = min(chain.from_iterable(rivals), key=lambda one: one.score, default=found)
    return best if best.score < found.score - CHI2_999 * max(best.leftover**2, 1.0) else None


def _rivals(
    evidence: Evidence, judged: Weights, weights: Weights, found: Fitted, singles: list[Fitted]
) -> list[list[Fitted]]:
    """For each cause: what fits as well in its place, re-fitted with the others.

    A log rejects a rival by what it shows, not by how seldom that comes.
    """
    worst = score_without_prior(evidence, found.score, found.hypothesis)
    worst += CHI2_999 * max(found.leftover**2, 1.0)

    def instead_of(left: int) -> list[Fitted]:
        others = tuple(c for i, c in enumerate(found.hypothesis) if i != left)
        if others:
            beside = columns(evidence, judged, signatures(evidence, judged.cycles, others))
            promised = promises(evidence, judged, beside, each=1)
            tried = [
                (*others, *one.hypothesis)
                for one in promised
                if one.hypothesis[0].effect not in found.effects
                and _can_join(evidence, one.hypothesis[0], others)
                and one.gain > NEARLY * promised[0].gain
            ][:TRIED_PAIRS]
            timed = _timed(evidence, judged, tried)
            fitted = _ranked(evidence, judged, fit(evidence, weights, timed))
        else:
            fitted = [one for one in singles if one.effects != found.effects]
        return [
            one
            for one in fitted
            if score_without_prior(evidence, one.score, one.hypothesis) < worst
        ]

    return at_once(instead_of, range(len(found.hypothesis)))


# --- when -----------------------------------------------------------------------------------------


def _timed(
    evidence: Evidence, judged: Weights, hypotheses: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """The same; of the first few the onset within its cycle, or the cycles, where they fit best."""
    result, timed = [], 0
    for hypothesis in hypotheses:
        place = _PLACED.get(hypothesis[-1].course)
        if place is not None and timed < TRIED_TIMES:
            result.append(place(evidence, judged, hypothesis))
            timed += 1
        else:
            result.append(hypothesis)
    return result


def _with_onset(evidence: Evidence, judged: Weights, hypothesis: Hypothesis) -> Hypothesis:
    """The last cause's onset where it explains most, about a cycle about where it is."""
    *others, cause = hypothesis
    return (*others, _begun(evidence, judged, tuple(others), cause, ONSETS, ONSET_S))


def _with_cycles(evidence: Evidence, judged: Weights, hypothesis: Hypothesis) -> Hypothesis:
    """The last cause in those cycles in which it explains most: each tried in or out.

    Also those that are not judged: what acts there shows in the gas of the one after.
    """
    *others, cause = hypothesis
    units = tried_in_or_out(evidence)
    cause = replace(cause, cycles=_union(one for one in units if max(one) in cause.cycles))
    for _ in range(MOST_FLIPS):
        tried = [cause, *(replace(cause, cycles=cause.cycles ^ one) for one in units)]
        chi2 = np.sum(white(evidence, judged, [(*others, one) for one in tried]) ** 2, axis=0)
        gains = chi2[0] - chi2[1:]
        better = _union(
            one for one, gain in zip(units, gains, strict=True) if gain > WORTH_FLIPPING
        )
        if not better:
            break
        together = replace(cause, cycles=cause.cycles ^ better)
        both = [together, tried[int(np.argmin(chi2))]]
        chi2 = np.sum(white(evidence, judged, [(*others, one) for one in both]) ** 2, axis=0)
        cause = both[int(np.argmin(chi2))]
    return (*others, cause)


def tried_in_or_out(evidence: Evidence) -> list[frozenset[int]]:
    """Each cycle; in part of a log with the one before it, in which the model only swings in."""
    numbers = [int(number) for number in evidence.numbers]
    units, before = [], frozenset[int]()
    for place, number in enumerate(numbers):
        follows_a_gap = place > 0 and number > numbers[place - 1] + 1
        if follows_a_gap and place not in evidence.judged:
            before = frozenset({number})
        else:
            units.append(before | {number})
            before = frozenset()
    return units


def _union(cycles: Iterable[frozenset[int]]) -> frozenset[int]:
    return frozenset[int]().union(*cycles)


_PLACED = {Course.STEP: _with_onset, Course.INTERMITTENT: _with_cycles}


def _finely_timed(evidence: Evidence, judged: Weights, hypothesis: Hypothesis) -> Hypothesis:
    """The onset of every step to the row, looked for anew now that the sizes are known."""
    for number, cause in enumerate(hypothesis):
        if cause.course == Course.STEP:
            others = (*hypothesis[:number], *hypothesis[number + 1 :])
            begun = _begun(evidence, judged, others, cause, MANY_ONSETS, MS)
            hypothesis = (*hypothesis[:number], begun, *hypothesis[number + 1 :])
    return hypothesis


def _begun(
    evidence: Evidence, judged: Weights, others: Hypothesis, cause: Cause, count: int, fine: float
) -> Cause:
    """A cause with its onset where it explains most, within a cycle: ``count`` tried at first."""
    cycle = float(np.median(np.diff(evidence.seconds[evidence.starts[:-1]])))
    low, high = cause.onset_s - cycle, cause.onset_s + cycle
    while (high - low) / count > fine:
        onsets = np.linspace(low, high, count)
        best = onsets[int(np.argmin(_misfits(evidence, judged, others, cause, onsets)))]
        cause = replace(cause, onset_s=float(best))
        reach, count = 1.5 * (high - low) / count, ONSETS
        low, high = best - reach, best + reach
    return cause


def sharpened(whole: Evidence, part: Evidence, searched: Search) -> Search:
    """What was found in ``part`` of a log with the onsets of steps as all of its cycles tell."""
    found, onsets = searched.found, list(searched.onsets)
    assert found is not None
    for number, cause in enumerate(found.hypothesis):
        if cause.course == Course.STEP:
            hypothesis, onsets[number] = _sharp_onset(whole, part, found, number)
            found = replace(found, hypothesis=hypothesis)
    known = covariance(part, found.hypothesis)
    return replace(searched, known=known, found=found, onsets=onsets)


def _sharp_onset(
    whole: Evidence, part: Evidence, found: Fitted, number: int
) -> tuple[Hypothesis, tuple[float, float]]:
    """A hypothesis with the onset of one of its causes looked for, and its interval."""
    cause, hypothesis = found.hypothesis[number], found.hypothesis
    others = (*hypothesis[:number], *hypothesis[number + 1 :])
    begins = whole.seconds[whole.starts[:-1]]
    near = part.seconds[part.starts[part.judged]]
    here = int(np.searchsorted(near, cause.onset_s))
    low = near[here - 2] if here >= 2 else begins[whole.judged[0]]
    high = near[here + 1] if here + 1 < len(near) else np.inf
    while True:
        inside = [one for one in whole.judged if low <= begins[one] <= high]
        looked = thinned(whole, inside, ONSETS)
        judged = covariance(looked, (*others, cause)).of(looked.judged)
        tried = looked.seconds[looked.starts[looked.judged]]
        best = int(np.argmin(_misfits(looked, judged, others, cause, tried)))
        cause = replace(cause, onset_s=float(tried[best]))
        if len(inside) <= ONSETS:
            break
        low, high = tried[max(best - 2, 0)], tried[min(best + 2, len(tried) - 1)]
    cause = _with_onset(looked, judged, (*others, cause))[-1]
    hypothesis = (*hypothesis[:number], cause, *hypothesis[number + 1 :])
    return hypothesis, _onset_interval(looked, judged, hypothesis, number, found.leftover)


def _misfits(
    evidence: Evidence, judged: Weights, others: Hypothesis, cause: Cause, onsets: Floats
) -> Floats:
    tried = [(*others, replace(cause, onset_s=float(onset))) for onset in onsets]
    found: Floats = np.sum(white(evidence, judged, tried) ** 2, axis=0)
    return found


def _onset_interval(
    evidence: Evidence, judged: Weights, hypothesis: Hypothesis, number: int, leftover: float
) -> tuple[float, float]:
    """95 % interval (s) of a step's onset, from how the misfit grows about it.

    Each onset has the sizes that suit it best.
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
