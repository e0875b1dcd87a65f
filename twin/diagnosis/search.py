"""The search for causes: every effect with every course, alone and together, fitted and ranked.

Forward: the best candidates of the linear model are fitted in the non-linear one. Singles and pairs
compete, because the members of a true pair may each look poor alone. The best is kept if its gain
exceeds its penalty, and the search starts again about it. Backward: each cause must still exceed
its penalty beside the others. Last, each must predict held-out cycles; if the first one does not,
the search starts again with the next.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations

import numpy as np

from twin.diagnosis.evidence import (
    HEALTHY,
    Evidence,
    Hypothesis,
    LogCycles,
    at_once,
)
from twin.diagnosis.fit import Fitted, fit, interval, profiled, white
from twin.diagnosis.held_out import reduces
from twin.diagnosis.hypotheses import (
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
    linear_gains,
    pairs,
    signatures,
)
from twin.diagnosis.onset import onset_interval, sharp_onset, with_fine_onsets, with_times
from twin.diagnosis.residual_covariance import Covariance, ResidualWhitener, covariance
from twin.inference.levels import CHI2_95, CHI2_999, SIGMAS_95
from twin.model.catalogue import has_room
from twin.model.courses import Cause, Course
from twin.model.effects import WEATHER
from twin.monitor.bins import Floats

MOST_CAUSES = 3
MOST_ROUNDS = 4  # of adding and pruning
SIGNIFICANT = 20.0  # chi-square that a named cause must gain beyond its penalty
SHARE = 0.005  # least gain of one more cause over what is explained: else it corrects the model
# Of an effect's typical size: a smaller one is within the uncertainty of the calibration, or beside
# another cause corrects the model's error of that.
SMALLEST, SMALLEST_MORE = 0.2, 0.4
LEAST_UNSEEN = (
    1.0  # lower limit of the chi-square gained on held-out cycles: a size gains it by chance
)
TRIED_FIRST = 3  # single causes to start from, until one is confirmed on held-out cycles
TRIED_ALONE = 5  # hypotheses that are compared with weights about themselves
NEAR = 2.5  # times the least score, up to which they are
QUIET = 1.2  # leftover (sigmas) below which no comparison is needed
HOPEFUL = 5.0  # least gain (chi-square) of one more cause in the linear model
TRIED_PAIRS, TRIED_MORE = 12, 8
# Leftover (sigmas) of the best single cause above which sizes are too large for a linear model to
# tell courses apart. Chosen: in pairs of the second world's batteries one leaves up to 4. A delay
# is far from linear: its courses are told apart by fits wherever more than noise is left.
GREAT = 10.0
SECOND = 0.5  # of the best gain, above which an effect's second course is fitted as well
NEARLY = 0.3  # of the best gain, above which an effect may turn out to be a rival
START = np.array([0.4, 1.4, 4.0])  # typical sizes from which a fit starts
# The same for times, up to the 400 ms to which they are bounded: a step to the next one is less
# than half of it, since an edge that moves by more than it lasts has no slope towards its place.
START_OF_TIMES = np.geomspace(0.4, 40.0, 13)

Progress = Callable[[str], None]
_NO_SIZES = np.empty(0), np.empty(0)
_NO_GAIN = 0.0, 0.0


@dataclass(frozen=True)
class Search:
    """Result of the search: the causes with their rivals, judged by the same weights."""

    known: Covariance  # about what was found
    healthy: float  # chi-square without any cause, of the fitted cycles
    found: Fitted | None
    ranking: list[Fitted]  # of all single causes, and of what was found
    rivals: list[list[Fitted]]  # of each cause: hypotheses with another in its place
    ends: tuple[Floats, Floats]  # of the 95 % interval of each size found
    onsets: list[tuple[float, float]]  # 95 % interval of each cause's onset


def search(
    evidence: Evidence, fitted: Sequence[int], healthy_covariance: Covariance, progress: Progress
) -> Search:
    """Find up to three causes; sizes and ranking of effects from the ``fitted`` cycles only.

    Times of causes (course, onset, cycles) come from all judged cycles, as others do not show
    them. ``healthy_covariance`` is about the healthy twin.
    """
    progress("screening all effects and courses")
    judged, weights = healthy_covariance.of(evidence.judged), healthy_covariance.of(fitted)
    alone = signatures(evidence, evidence.judged)
    tried = _fit_singles(evidence, judged, weights, alone, progress)
    singles = _ranked(evidence, judged, tried)
    healthy = _healthy(evidence, weights)
    if not any(_worth(evidence, healthy, healthy, 0.0, candidate) for candidate in singles):
        return Search(healthy_covariance, healthy, None, singles, [], _NO_SIZES, [])
    firsts = _likeliest(evidence, fitted, tried, singles, progress)[:TRIED_FIRST]
    fallback: tuple[_Found, list[Fitted], Fitted] | None = None
    chi2_without = healthy + weights.volume
    for first in firsts:
        current, ranked = _grown(evidence, fitted, first, singles, alone, progress)
        progress("asking cycles that nothing was fitted to")
        confirmed = _confirmed(evidence, fitted, current)
        if confirmed and _beats(evidence, chi2_without, confirmed, current.weights.volume):
            break
        confirmed = _confirmed(evidence, fitted, current, by_own_weights=True)
        if confirmed and _beats(evidence, chi2_without, confirmed, current.weights.volume):
            fallback = fallback or (current, ranked, confirmed)
    else:
        if fallback is None:
            return Search(healthy_covariance, healthy, None, singles, [], _NO_SIZES, [])
        current, ranked, confirmed = fallback
    singles = ranked
    if confirmed is not current.found:
        current = _about(evidence, fitted, confirmed.hypothesis)
    progress("looking for what the log cannot tell apart")
    with_rivals = _beside_rivals(evidence, fitted, current, singles)
    if with_rivals is None:
        return Search(healthy_covariance, healthy, None, singles, [], _NO_SIZES, [])
    current, rivals = with_rivals
    found = current.found
    onsets = [
        onset_interval(evidence, current.judged, found.hypothesis, number, found.leftover)
        for number in range(len(found.hypothesis))
    ]
    ends = _size_intervals(evidence, current.weights, found)
    return Search(current.known, current.healthy, found, singles, rivals, ends, onsets)


@dataclass(frozen=True)
class _Found:
    """Causes with their best sizes, by weights about themselves."""

    found: Fitted
    known: Covariance
    judged: ResidualWhitener  # of all judged cycles
    weights: ResidualWhitener  # of the fitted ones
    healthy: float  # chi-square without any cause


def _about(evidence: Evidence, fitted: Sequence[int], hypothesis: Hypothesis) -> _Found:
    """A hypothesis refitted with the covariance about itself."""
    residual_covariance = covariance(evidence, hypothesis)
    weights = residual_covariance.of(fitted)
    (found,) = fit(evidence, weights, [hypothesis])
    return _Found(
        found,
        residual_covariance,
        residual_covariance.of(evidence.judged),
        weights,
        _healthy(evidence, weights),
    )


def _grown(
    evidence: Evidence,
    fitted: Sequence[int],
    first: Fitted,
    singles: Sequence[Fitted],
    alone: Signatures,
    progress: Progress,
) -> tuple[_Found, list[Fitted]]:
    """A single cause with those found beside it, and all single causes by the weights about it."""
    current = _about(evidence, fitted, first.hypothesis)
    alternatives = [
        candidate.hypothesis for candidate in singles if candidate.effects != first.effects
    ]
    refitted = fit(evidence, current.weights, alternatives, best_only=True)
    ranked = [current.found, *sorted(refitted, key=lambda candidate: candidate.score)]
    return _added(evidence, fitted, current, ranked, alone, progress), ranked


def _added(
    evidence: Evidence,
    fitted: Sequence[int],
    current: _Found,
    singles: Sequence[Fitted],
    alone: Signatures,
    progress: Progress,
) -> _Found:
    """Add causes while one more exceeds its penalty, and prune those that no longer do."""
    visited: set[frozenset[tuple[str, Course]]] = set()
    for _ in range(MOST_ROUNDS):
        found = current.found
        # With other weights a pruned cause may come back: then the search would go in circles.
        if len(found.hypothesis) == MOST_CAUSES or found.kind in visited:
            break
        visited.add(found.kind)
        progress(f"looking for what else there is beside {', '.join(found.effects)}")
        addition = _best_addition(evidence, current, singles, alone)
        if addition is None:
            break
        current = _by_best_law(evidence, fitted, _about(evidence, fitted, addition.hypothesis))
        current = replace(current, found=_pruned(evidence, fitted, current))
    return current


def _by_best_law(evidence: Evidence, fitted: Sequence[int], current: _Found) -> _Found:
    """What was found with another law of one cause, if that is clearly better by both weights.

    A cause has the law that was best alone, where another cause may have been part of it.
    """
    found = current.found
    others = [
        by_law
        for number in range(len(found.hypothesis))
        for by_law in by_each_law(found.hypothesis, number)
        if [cause.law() for cause in by_law] != [cause.law() for cause in found.hypothesis]
    ]
    if not others:
        return current
    best = min(
        fit(evidence, current.weights, others, best_only=True),
        key=lambda candidate: candidate.score,
    )
    if not _is_clearly_better(best, found):
        return current
    candidate, by_own_weights = _by_own_weights(evidence, fitted, current, best)
    return candidate if _is_clearly_better(by_own_weights, found) else current


def _beside_rivals(
    evidence: Evidence, fitted: Sequence[int], current: _Found, singles: list[Fitted]
) -> tuple[_Found, list[list[Fitted]]] | None:
    """What was found and, for each of its causes, the rivals that fit in its place.

    A rival that is likelier replaces what was found, if it is confirmed on held-out cycles and
    likelier by weights about itself as well: those about what was found are one picture. If it is
    clearly better by both and not confirmed, no listed effect acts there, and both are dropped; so
    are they if it is weather, which is within what a healthy twin allows. None if no cause remains.

    A rival that is likelier by what weights leave open alone is none. A single cause that was
    replaced remains a rival where the weights about it could not reject it.
    """
    visited, replaced = set[frozenset[tuple[str, Course]]](), list[tuple[Fitted, float]]()
    while True:
        current = _with_fine_steps(evidence, current)
        visited.add(current.found.kind)
        rivals = _rivals(evidence, current.judged, current.weights, current.found, singles)
        if _is_weather_alone(current.found):
            return _weather_or_rival(evidence, fitted, current, rivals[0])
        rivals = [_without_wide(evidence, fitted, current.found, of_cause) for of_cause in rivals]
        rivals[0] += _still_rivals(current.found, rivals[0], replaced)
        better = _likelier(evidence, current.found, rivals)
        if better is None:
            return current, rivals
        if better.kind in visited:  # what was found took its place, by weights about itself
            return current, _by_two_pictures(evidence, fitted, current, rivals)
        residual_covariance = covariance(evidence, better.hypothesis)
        confirmed = _confirmed(
            evidence, fitted, replace(current, found=better, known=residual_covariance)
        )
        candidate, by_own_weights = _by_own_weights(evidence, fitted, current, better)
        clearly = _is_clearly_better(better, current.found)
        if confirmed is better and (
            clearly or _likelier(evidence, current.found, [[by_own_weights]])
        ):
            replaced.append((current.found, current.found.score - better.score))
            current = candidate
            continue
        clearly &= _is_clearly_better(by_own_weights, current.found)
        if confirmed is better or not (clearly or _is_weather_alone(better)):
            return current, _by_two_pictures(evidence, fitted, current, rivals)
        if confirmed and stranger(better, current.found) in confirmed.effects:
            return current, rivals
        remaining = tuple(
            cause
            for cause, of_cause in zip(current.found.hypothesis, rivals, strict=True)
            if not _has(of_cause, better)
        )
        if not remaining:
            return None
        current = _about(evidence, fitted, remaining)


def _weather_or_rival(
    evidence: Evidence, fitted: Sequence[int], weather: _Found, rivals: Sequence[Fitted]
) -> tuple[_Found, list[list[Fitted]]]:
    """The best of weather and its rivals, and those of the others that the log cannot reject.

    Weather may be first by its prior alone. A rival must be better than weather by two pictures:
    with weights about each of them, and with those about the rival for both. By those about
    weather, which are wide, a rival would share in what only weather leaves open; and that width
    must not be all that speaks against weather. Nor may it be all the evidence of weather that
    changes within a log: where a rival is nearer to the log, the weights about the rival decide.
    A rival must be confirmed on held-out cycles, as weather was.
    """
    changes = weather.found.hypothesis[0].course != Course.CONSTANT

    def compared(rival: Fitted) -> tuple[_Found, float]:
        """The rival refitted, and its score less that of weather."""
        candidate = _about(evidence, fitted, rival.hypothesis)
        found = candidate.found
        (there,) = fit(evidence, candidate.weights, [weather.found.hypothesis])
        if changes and _is_nearer(evidence, fitted, found, weather.found):
            return candidate, found.score - there.score
        own = found.score + candidate.weights.volume
        own -= weather.found.score + weather.weights.volume
        return candidate, max(own, found.score - there.score)

    def tempered(entry: tuple[_Found, float]) -> float:
        candidate, behind = entry
        return score_with_tempered_prior(evidence, behind, candidate.found.hypothesis)

    compared_rivals = sorted([(weather, 0.0), *at_once(compared, rivals)], key=tempered)
    best, least = next(
        (candidate, behind)
        for candidate, behind in compared_rivals
        if candidate is weather or _confirmed(evidence, fitted, candidate) is candidate.found
    )
    worst = score_without_prior(evidence, best.found.score, best.found.hypothesis)
    worst += CHI2_999 * max(best.found.leftover**2, 1.0)
    comparable = [
        replace(candidate.found, score=best.found.score + behind - least)
        for candidate, behind in compared_rivals
        if candidate is not best
    ]
    return best, [
        [
            other
            for other in comparable
            if score_without_prior(evidence, other.score, other.hypothesis) < worst
        ]
    ]


def _is_nearer(evidence: Evidence, fitted: Sequence[int], candidate: Fitted, than: Fitted) -> bool:
    """Whether a fit leaves but noise, and less in millibars than another of the same courses.

    In sigmas a poorer one can come out ahead, as weights about it leave open what it is off. Where
    courses differ, so does how much their times were fitted.
    """
    if candidate.leftover >= QUIET or candidate.courses != than.courses:
        return False
    return reduces(evidence, fitted, than.hypothesis, candidate.hypothesis)


def _without_wide(
    evidence: Evidence, fitted: Sequence[int], found: Fitted, rivals: Sequence[Fitted]
) -> list[Fitted]:
    """Rivals without those that are likelier than what was found, which is nearer to the log."""
    return [
        rival
        for rival in rivals
        if _likelier(evidence, found, [[rival]]) is None
        or not _is_nearer(evidence, fitted, found, rival)
    ]


def _still_rivals(
    found: Fitted, rivals: Sequence[Fitted], replaced: Sequence[tuple[Fitted, float]]
) -> list[Fitted]:
    """Single causes that were replaced, and that the log could not reject by weights about them.

    Each comes with its score less that of what took its place.
    """
    present = {found.effects, *(rival.effects for rival in rivals)}
    return [
        replace(earlier, score=found.score + behind)
        for earlier, behind in replaced
        if len(found.hypothesis) == len(earlier.hypothesis) == 1
        and earlier.effects not in present
        and behind < CHI2_999 * max(earlier.leftover**2, 1.0)
    ]


def _has(fits: Sequence[Fitted], candidate: Fitted) -> bool:
    return any(element is candidate for element in fits)


def stranger(rival: Fitted, found: Fitted) -> str:
    """The effect of a rival that is not among those found."""
    return next(effect for effect in rival.effects if effect not in found.effects)


def _size_intervals(
    evidence: Evidence, weights: ResidualWhitener, found: Fitted
) -> tuple[Floats, Floats]:
    """95 % interval of each size, over all laws of a cause that the log cannot reject."""
    low, high = interval(evidence, weights, found)
    alternatives = [
        alternative
        for number in range(len(found.hypothesis))
        for alternative in by_each_law(found.hypothesis, number)
        if alternative != found.hypothesis
    ]
    worst = found.chi2 + CHI2_95 * max(found.leftover**2, 1.0)
    for alternative in fit(evidence, weights, alternatives) if alternatives else []:
        if alternative.chi2 < worst:
            alternative_ends = interval(evidence, weights, alternative)
            low, high = np.minimum(low, alternative_ends[0]), np.maximum(high, alternative_ends[1])
    return low, high


def _healthy(evidence: Evidence, weights: ResidualWhitener) -> float:
    residual = white(evidence, weights, [HEALTHY])
    return float(np.sum(residual**2))


def _ranked(evidence: Evidence, judged: ResidualWhitener, found: Sequence[Fitted]) -> list[Fitted]:
    """The best course of each set of effects, the best first.

    All judged cycles choose the course, as the fitted ones do not show in which an effect acts.
    """
    residual = white(evidence, judged, [candidate.hypothesis for candidate in found])
    best: dict[tuple[str, ...], tuple[float, Fitted]] = {}
    for candidate, chi2 in zip(found, np.sum(residual**2, axis=0), strict=True):
        key, score = (
            tuple(sorted(candidate.effects)),
            float(chi2) + candidate.score - candidate.chi2,
        )
        if key not in best or score < best[key][0]:
            best[key] = score, candidate
    return sorted(
        (candidate for _, candidate in best.values()), key=lambda candidate: candidate.score
    )


def _fit_singles(
    evidence: Evidence,
    judged: ResidualWhitener,
    weights: ResidualWhitener,
    alone: Signatures,
    progress: Progress,
) -> list[Fitted]:
    """Fit every effect with its most promising courses."""
    linear = columns(evidence, judged, alone)
    screened = linear_gains(evidence, judged, linear, each=2)
    first = {candidate.hypothesis[0].effect: candidate for candidate in reversed(screened)}
    hypotheses = [
        candidate.hypothesis
        for candidate in screened
        if candidate is first[candidate.hypothesis[0].effect]
        or candidate.gain > SECOND * screened[0].gain
    ]
    progress("fitting single causes")
    started = _started(evidence, judged, hypotheses)
    tried = fit(evidence, weights, with_times(evidence, judged, started))
    least = min(candidate.leftover for candidate in tried)
    if least < QUIET:
        return tried
    progress("more than noise is left: fitting causes with other courses")
    others = [
        candidate.hypothesis
        for candidate in linear_gains(evidence, judged, linear, each=len(Course))
        if candidate.hypothesis not in hypotheses
        and (least > GREAT or parameters(candidate.hypothesis)[0].is_time)
    ]
    if not others:
        return tried
    started = _started(evidence, judged, others)
    return tried + fit(evidence, weights, with_times(evidence, judged, started))


def _likeliest(
    evidence: Evidence,
    fitted: Sequence[int],
    tried: Sequence[Fitted],
    singles: Sequence[Fitted],
    progress: Progress,
) -> list[Fitted]:
    """Single causes, the likeliest first, each with weights about itself and their log-determinant.

    Scatter moves with the causes: a valve's half millisecond acts where a delay of ten has put the
    edge. All judged cycles choose the course, the fitted ones the effect. One that is nearer to the
    log than the likeliest comes first. So does weather if the log cannot reject it against the
    best: it changes every week.
    """
    if not (singles[0].leftover > QUIET or _weather(evidence, singles)):
        return list(singles)
    progress("comparing the best, each with its own weights")
    ranked = sorted(tried, key=lambda candidate: candidate.score)
    nearest = [candidate for candidate in ranked if candidate.score < NEAR * ranked[0].score][
        :TRIED_ALONE
    ]
    weather_fits = _weather(evidence, ranked)
    compared = [candidate.hypothesis for candidate in nearest if not _has(weather_fits, candidate)]
    compared += [
        _with_weather_weights(evidence, fitted, candidate.hypothesis) for candidate in weather_fits
    ]

    def alone(first: Hypothesis) -> tuple[float, float, Fitted]:
        residual_covariance = covariance(evidence, first, both_ways=False)
        judged, weights = residual_covariance.of(evidence.judged), residual_covariance.of(fitted)
        (candidate,) = fit(evidence, weights, [first])
        chi2 = float(np.sum(white(evidence, judged, [candidate.hypothesis]) ** 2))
        price = candidate.score - candidate.chi2
        return chi2 + judged.volume + price, candidate.score + weights.volume, candidate

    best: dict[tuple[str, ...], tuple[float, float, Fitted]] = {}
    for entry in at_once(alone, compared):
        score, _, candidate = entry
        if candidate.effects not in best or score < best[candidate.effects][0]:
            best[candidate.effects] = entry
    _, least, best_fit = min(best.values(), key=lambda entry: entry[1])
    order = [candidate for *_, candidate in sorted(best.values(), key=lambda entry: entry[1])]
    for weather in _weather(evidence, order):
        if best[weather.effects][1] < least + CHI2_999 * max(best_fit.leftover**2, 1.0):
            return [weather, *(candidate for candidate in order if candidate is not weather)]
    first = order[0]
    for candidate in order[1:]:
        if _is_nearer(evidence, fitted, candidate, first):
            first = candidate
    return [first, *(candidate for candidate in order if candidate is not first)]


def _with_weather_weights(
    evidence: Evidence, fitted: Sequence[int], weather: Hypothesis
) -> Hypothesis:
    """Weather with the law and the size that fit best by weights about typical weather.

    By those of the calibration's day its response counts as exact, and a fit ends where it is.
    """
    starts = [
        sized(evidence, by_law, np.array([steps]))
        for by_law in by_each_law(weather, 0)
        for steps in (1.0, -1.0)
    ]
    weights = covariance(evidence, starts[0], both_ways=False).of(fitted)
    return min(fit(evidence, weights, starts), key=lambda candidate: candidate.score).hypothesis


def _is_weather_alone(fitted: Fitted) -> bool:
    """Whether another ambient pressure is the only cause."""
    return fitted.effects == (WEATHER,)


def _weather(evidence: Evidence, ranked: Sequence[Fitted]) -> list[Fitted]:
    """Fits by another ambient pressure, if that is not measured.

    Its response is uncertain. So they are compared with weights about themselves, though they look
    poor by those of the calibration's day.
    """
    if "ambient" in evidence.told:
        return []
    return [candidate for candidate in ranked if _is_weather_alone(candidate)]


def _started(
    evidence: Evidence, judged: ResidualWhitener, hypotheses: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Hypotheses with the last cause at the best of some sizes, by each law that it may act by.

    A delay shifts edges: far from its true size, a step towards it does not reduce the misfit.
    """
    tried = [
        _at_some_sizes(evidence, by_law)
        for hypothesis in hypotheses
        for by_law in by_each_law(hypothesis, len(hypothesis) - 1)
    ]
    all_variants = [variant for variants in tried for variant in variants]
    chi2 = np.sum(white(evidence, judged, all_variants) ** 2, axis=0)
    best, first = [], 0
    for variants in tried:
        best.append(variants[int(np.argmin(chi2[first : first + len(variants)]))])
        first += len(variants)
    return best


def _at_some_sizes(evidence: Evidence, hypothesis: Hypothesis) -> list[Hypothesis]:
    """A hypothesis as it is, and with its last cause at each size from which a fit may start."""
    low, high = bounds(evidence, hypothesis)
    x = sizes(evidence, hypothesis)
    last = len(x) - len(parameters(hypothesis[-1:]))
    around = [x]
    tried_sizes = START_OF_TIMES if parameters(hypothesis[-1:])[0].is_time else START
    for size in (*-tried_sizes, *tried_sizes):
        if low[last] < size < high[last]:
            around.append(np.concatenate([x[:last], [size], x[last + 1 :]]))
    return [sized(evidence, hypothesis, point) for point in around]


def _best_addition(
    evidence: Evidence, current: _Found, singles: Sequence[Fitted], alone: Signatures
) -> Fitted | None:
    """The best hypothesis with one more cause, or a pair in its place; None if none is worth it."""
    found, judged, weights = current.found, current.judged, current.weights
    hypothesis = found.hypothesis
    moved = signatures(evidence, judged.cycles, hypothesis)
    screened = linear_gains(evidence, judged, columns(evidence, judged, moved), each=2)
    new = [
        candidate
        for candidate in screened
        if _can_join(evidence, candidate.hypothesis[0], hypothesis)
    ]
    new = [candidate for candidate in new[:TRIED_MORE] if candidate.gain > HOPEFUL]
    candidates = _started(
        evidence, judged, [(*hypothesis, *candidate.hypothesis) for candidate in new]
    )
    if found.leftover > QUIET:
        candidates += _far_additions(evidence, weights, found)
    if len(hypothesis) == 1:
        candidates += _linear_pairs(evidence, judged, columns(evidence, judged, alone))
        candidates += _fitted_pairs(evidence, weights, singles[:TRIED_PAIRS], found)
    candidates = with_times(evidence, judged, candidates)
    tried = _ranked(evidence, judged, fit(evidence, weights, candidates, best_only=True))
    for candidate in tried:
        if _worth(evidence, current.healthy, found.chi2, found.chi2 - found.score, candidate):
            return candidate
    return None


def _far_additions(
    evidence: Evidence, weights: ResidualWhitener, found: Fitted
) -> list[Hypothesis]:
    """What was found with one more cause throughout the log that lets the sizes found change much.

    A cause that makes up for half of another hides in the other's size: where that fits best alone,
    none of the second gains anything. So each effect is tried at several sizes, and all sizes move
    by one step.
    """
    tried: list[Hypothesis] = []
    for effect in evidence.effects:
        together = (*found.hypothesis, Cause(effect.name, {}))
        if _can_join(evidence, together[-1], found.hypothesis):
            for by_law in by_each_law(together, len(together) - 1):
                tried += _at_some_sizes(evidence, by_law)[1:]
    chi2 = profiled(evidence, weights, tried)
    best: dict[str, Hypothesis] = {}
    for number in np.argsort(chi2):
        if chi2[number] < found.chi2 - HOPEFUL:
            best.setdefault(tried[number][-1].effect, tried[number])
    return list(best.values())[:TRIED_MORE]


def _can_join(evidence: Evidence, cause: Cause, others: Hypothesis) -> bool:
    """Whether a cause can be added to others: it is a new one, and the model has room for it."""
    names = [other.effect for other in others]
    return cause.effect not in names and has_room(evidence.theta, (*names, cause.effect))


def _linear_pairs(evidence: Evidence, judged: ResidualWhitener, alone: Columns) -> list[Hypothesis]:
    """Pairs that explain more than any single cause in the linear model."""
    singles = linear_gains(evidence, judged, alone, each=2)
    best_pairs = pairs(evidence, judged, alone, singles)[:TRIED_PAIRS]
    return [
        candidate.hypothesis
        for candidate in best_pairs
        if candidate.gain > singles[0].gain + HOPEFUL
    ]


def _fitted_pairs(
    evidence: Evidence, weights: ResidualWhitener, singles: Sequence[Fitted], found: Fitted
) -> list[Hypothesis]:
    """Pairs of single causes as they were fitted: delays are far from linear."""
    combined = [
        (*first.hypothesis, *second.hypothesis)
        for first, second in combinations(singles, 2)
        if has_room(evidence.theta, (*first.effects, *second.effects))
    ]
    chi2 = np.sum(white(evidence, weights, combined) ** 2, axis=0)
    best = np.argsort(chi2)[:TRIED_MORE]
    return [combined[i] for i in best if chi2[i] < found.chi2]


def _worth(evidence: Evidence, healthy: float, chi2: float, paid: float, fitted: Fitted) -> bool:
    """Whether a hypothesis gains enough over a smaller one, and all its causes are large enough."""
    scale = max(fitted.leftover**2, 1.0)
    gain = (chi2 - fitted.chi2) / scale - (fitted.score - fitted.chi2 + paid)
    enough = max(SIGNIFICANT, SHARE * (healthy - chi2) / scale)
    least = SMALLEST if len(fitted.hypothesis) == 1 else SMALLEST_MORE
    return gain > enough and _smallest_size(evidence, fitted) >= least


def _beats(evidence: Evidence, alone: float, found: Fitted, volume: float) -> bool:
    """Whether causes are large enough and explain more than none, each by its own weights.

    ``alone`` is the chi-square without causes, with the log-determinant of its weights.
    """
    gain = (alone - found.chi2 - volume) / max(found.leftover**2, 1.0)
    return (
        gain - (found.score - found.chi2) > SIGNIFICANT
        and _smallest_size(evidence, found) >= SMALLEST
    )


def _smallest_size(evidence: Evidence, fitted: Fitted) -> float:
    """The size of the smallest cause, in typical ones of this unit."""
    return min(_sizes_of_causes(evidence, fitted))


def _sizes_of_causes(evidence: Evidence, fitted: Fitted) -> list[float]:
    """The size of each cause, in typical ones of this unit: that farthest from neutral."""
    first, sizes = 0, []
    for cause in fitted.hypothesis:
        table = parameters((cause,))
        of_cause = zip(table, fitted.x[first : first + len(table)], strict=True)
        sizes.append(
            max(
                abs(float(x)) * p.typical / p.typical_on(evidence.theta)
                for p, x in of_cause
                if not p.shapes
            )
        )
        first += len(table)
    return sizes


def _pruned(evidence: Evidence, fitted: Sequence[int], current: _Found) -> Fitted:
    """What was found without the causes that do not exceed their penalty beside the others.

    A cause is kept as well if the others leave more than noise by weights about themselves, and are
    clearly poorer. Weights about all causes are wide by what each may be off: one can hide in the
    width of another.
    """
    found, weights = current.found, current.weights
    while len(found.hypothesis) > 1:
        without = [
            tuple(c for i, c in enumerate(found.hypothesis) if i != left_out)
            for left_out in range(len(found.hypothesis))
        ]
        best = min(fit(evidence, weights, without), key=lambda candidate: candidate.score)
        if _worth(evidence, current.healthy, best.chi2, best.chi2 - best.score, found):
            break
        if _smallest_size(evidence, found) >= SMALLEST_MORE:
            _, by_own_weights = _by_own_weights(evidence, fitted, current, best)
            if by_own_weights.leftover > QUIET and _is_clearly_better(
                found, by_own_weights, SIGNIFICANT
            ):
                break
        found = best
    return found


def _confirmed(
    evidence: Evidence, fitted: Sequence[int], current: _Found, *, by_own_weights: bool = False
) -> Fitted | None:
    """Causes without those that are too small or do not predict held-out cycles.

    None if none is left. Each is left out in turn, and the others are refitted. The least certain
    is dropped first. ``by_own_weights`` says how a single cause may gain.
    """
    held_out = [cycle for cycle in evidence.judged if cycle not in fitted]
    found, weights, residual_covariance = current.found, current.weights, current.known
    while True:
        unseen = residual_covariance.of(held_out)
        without = [
            tuple(c for i, c in enumerate(found.hypothesis) if i != left_out)
            for left_out in range(len(found.hypothesis))
        ]
        alternatives = fit(evidence, weights, without) if without[0] else []
        without = [alternative.hypothesis for alternative in alternatives]
        if alternatives:
            gains = [held_out_gain(evidence, unseen, fewer, found.hypothesis) for fewer in without]
        else:
            gains = [_gain_alone(evidence, unseen, found, by_own_weights=by_own_weights)]
        weakest = min(range(len(gains)), key=lambda left_out: gains[left_out][0])
        sizes_found = _sizes_of_causes(evidence, found)
        if min(sizes_found) < (SMALLEST_MORE if alternatives else SMALLEST):
            weakest = sizes_found.index(min(sizes_found))
        elif gains[weakest][0] > LEAST_UNSEEN:
            return found
        if not alternatives:
            return None
        found = alternatives[weakest]
        residual_covariance = covariance(evidence, found.hypothesis)


def held_out_gain(
    evidence: Evidence, unseen: ResidualWhitener, without: Hypothesis, hypothesis: Hypothesis
) -> tuple[float, float]:
    """95 % interval of the chi-square that a hypothesis gains over another on unseen cycles.

    The residuals are r and r + d: |r + d|² − |r|² = |d|² + 2·d·r. The sigma of d·r is |d| times
    that of the residuals. This holds with a single cycle as well.
    """
    before, after = white(evidence, unseen, [without, hypothesis]).T
    sigma = max(float(np.sqrt(np.mean(after**2))), 1.0)
    gain = float(before @ before - after @ after)
    reach = SIGMAS_95 * 2.0 * float(np.linalg.norm(before - after)) * sigma
    return gain - reach, gain + reach


def _gain_alone(
    evidence: Evidence, unseen: ResidualWhitener, found: Fitted, *, by_own_weights: bool
) -> tuple[float, float]:
    """``held_out_gain`` of a single cause over the twin without any.

    Weights about a great cause, or about weather, are wide by what its waveform may be off. By them
    much of the deviation would count as left open without any cause. So weather, or a cause
    ``by_own_weights``, must reduce millibars. Then the twin without any has the weights about
    itself.
    """
    if not (by_own_weights or _is_weather_alone(found)):
        return held_out_gain(evidence, unseen, HEALTHY, found.hypothesis)
    if not reduces(evidence, unseen.cycles, HEALTHY, found.hypothesis):
        return _NO_GAIN
    return _gain_by_own_weights(evidence, unseen, found.hypothesis)


def _gain_by_own_weights(
    evidence: Evidence, unseen: ResidualWhitener, hypothesis: Hypothesis
) -> tuple[float, float]:
    """``held_out_gain``, where the healthy twin has the weights about itself.

    A gain of |d|² has a sigma of 2 |d|.
    """
    healthy = covariance(evidence).of(unseen.cycles)
    before = float(np.sum(white(evidence, healthy, [HEALTHY]) ** 2)) + healthy.volume
    after = white(evidence, unseen, [hypothesis])
    gain = before - float(np.sum(after**2)) - unseen.volume
    sigma = max(float(np.sqrt(np.mean(after**2))), 1.0)
    reach = SIGMAS_95 * 2.0 * math.sqrt(max(gain, 0.0)) * sigma
    return gain - reach, gain + reach


def _likelier(
    evidence: Evidence, found: Fitted, rivals: Sequence[Sequence[Fitted]]
) -> Fitted | None:
    """The likeliest rival if it is likelier than what was found, as probabilities count them."""

    def tempered(fitted: Fitted) -> float:
        return score_with_tempered_prior(evidence, fitted.score, fitted.hypothesis)

    best = min(chain((found,), *rivals), key=tempered)
    return None if best is found else best


def _with_fine_steps(evidence: Evidence, current: _Found) -> _Found:
    """The same with the onset of every step searched to the row."""
    if not any(cause.course == Course.STEP for cause in current.found.hypothesis):
        return current
    timed = with_fine_onsets(evidence, current.judged, current.found.hypothesis)
    (found,) = fit(evidence, current.weights, [timed])
    return replace(current, found=found)


def _by_own_weights(
    evidence: Evidence, fitted: Sequence[int], current: _Found, rival: Fitted
) -> tuple[_Found, Fitted]:
    """A rival refitted by weights about itself, and that fit with a score beside ``current``.

    Each has its own weights, which differ in their volume as well.
    """
    candidate = _about(evidence, fitted, rival.hypothesis)
    own = candidate.found.score + candidate.weights.volume
    return candidate, replace(candidate.found, score=own - current.weights.volume)


def _by_two_pictures(
    evidence: Evidence, fitted: Sequence[int], current: _Found, rivals: Sequence[Sequence[Fitted]]
) -> list[list[Fitted]]:
    """The rivals; one that is likelier than what was found counts by the poorer of two scores.

    These are by the weights of what was found, and by its own.
    """

    def judged(rival: Fitted) -> Fitted:
        if _likelier(evidence, current.found, [[rival]]) is None:
            return rival
        _, by_own_weights = _by_own_weights(evidence, fitted, current, rival)
        return max(rival, by_own_weights, key=lambda candidate: candidate.score)

    return [at_once(judged, of_cause) for of_cause in rivals]


def _is_clearly_better(rival: Fitted, found: Fitted, by: float = CHI2_999) -> bool:
    """Whether a rival's score is lower by so much, in its chi-square per residual."""
    return rival.score < found.score - by * max(rival.leftover**2, 1.0)


def _rivals(
    evidence: Evidence,
    judged: ResidualWhitener,
    weights: ResidualWhitener,
    found: Fitted,
    singles: list[Fitted],
) -> list[list[Fitted]]:
    """For each cause: rivals that fit as well in its place, refitted with the others.

    A rival is rejected by the log alone, without the prior frequency of its effects.
    """
    worst = score_without_prior(evidence, found.score, found.hypothesis)
    worst += CHI2_999 * max(found.leftover**2, 1.0)

    def instead_of(left_out: int) -> list[Fitted]:
        remaining = tuple(c for i, c in enumerate(found.hypothesis) if i != left_out)
        if remaining:
            linear = columns(evidence, judged, signatures(evidence, judged.cycles, remaining))
            screened = linear_gains(evidence, judged, linear, each=1)
            tried = [
                (*remaining, *candidate.hypothesis)
                for candidate in screened
                if candidate.hypothesis[0].effect not in found.effects
                and _can_join(evidence, candidate.hypothesis[0], remaining)
                and candidate.gain > NEARLY * screened[0].gain
            ][:TRIED_PAIRS]
            timed = with_times(evidence, judged, tried)
            fitted = _ranked(evidence, judged, fit(evidence, weights, timed))
        else:  # they were fitted with other weights
            others = [candidate for candidate in singles if candidate.effects != found.effects]
            alone = [found.hypothesis, *(candidate.hypothesis for candidate in others)]
            _, *fitted = fit(evidence, weights, alone, best_only=True)
            fitted.sort(key=lambda candidate: candidate.score)
        return [
            candidate
            for candidate in fitted
            if score_without_prior(evidence, candidate.score, candidate.hypothesis) < worst
        ]

    return at_once(instead_of, range(len(found.hypothesis)))


def sharpened(whole: LogCycles, part: Evidence, searched: Search) -> Search:
    """The result for ``part`` of a log, with onsets of steps from all its cycles."""
    found, onsets = searched.found, list(searched.onsets)
    assert found is not None
    for number, cause in enumerate(found.hypothesis):
        if cause.course == Course.STEP:
            hypothesis, onsets[number] = sharp_onset(whole, part, found, number)
            found = replace(found, hypothesis=hypothesis)
    residual_covariance = covariance(part, found.hypothesis)
    return replace(searched, known=residual_covariance, found=found, onsets=onsets)
