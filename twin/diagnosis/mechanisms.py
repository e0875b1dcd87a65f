"""Mechanisms for something unlisted: where it acts on the plant, when and how.

Each combination of place, condition and speed is tried in the same model as the listed effects,
alone and beside the causes. A linear screening with a small size ranks them. The best are fitted
with all their parameters and compared by misfit plus penalty. Held-out cycles are not used.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.diagnosis.fit import Fitted, fit, interval, white
from twin.diagnosis.mechanism_share import in_bins
from twin.diagnosis.residual_covariance import ResidualWhitener, covariance
from twin.diagnosis.rhythms import rhythmic_starts
from twin.inference.levels import CHI2_999
from twin.inference.unmodelled import MISMATCH
from twin.model import theta as c
from twin.model.catalogue import has_room
from twin.model.courses import Cause
from twin.model.effects import effect_of
from twin.model.mechanism import ABOVE, ALWAYS, MECHANISMS, RHYTHMIC, Mechanism
from twin.model.theta import Theta
from twin.monitor.bins import Floats

Progress = Callable[[str], None]

TRIED_LARGER, FITTED = 40, 8  # starts tried at their linear size; mechanisms fitted
# Sizes of the linear screening, in typical ones. The larger one is added if the deviation exceeds
# GROSS sigmas (rms), since the response is then far from linear.
PROBES, GROSS = (1.0, 5.0), 5.0
AROUND = (0.5, 1.0, 2.0)  # sizes tried, over that of the linear screening
# Largest share of the squared deviation beyond healthy cycles, in sigmas and in mbar, that a
# mechanism may leave on fitted cycles. Chosen: effects of the second world leave up to a tenth.
MOST_LEFT = 0.3
# A mechanism that leaves less than NEARLY_ALL in sigmas may leave HALF in mbar: if the law from
# supply to end pressure is uncertain, it causes most of these mbar. Chosen: a swinging supply,
# found to 0.3 % in size and period, leaves 0.02 in sigmas and 0.37 in mbar. The other way round,
# steep edges are most of the sigmas: a second ejector on a big tank, found to 0.1 % in period and
# duty, leaves 0.45 in sigmas and 0.08 in mbar.
NEARLY_ALL = 0.1
# A mechanism alone replaces listed causes if its mean square residual is below this share of theirs
# (mbar², beyond healthy cycles). Chosen: icing has 0.53 of the residual of end vacuum loss with a
# porous leak, which mimic it.
DISPLACES = 0.6
# If the residual of listed causes is healthy, a mechanism replaces them only if its chi-square
# (with its own weights) is lower by LIKELIER and its residual is below HALF of theirs (mbar²).
# Chosen: a lifting lip is 115 better than the porous leak that mimics it, at 0.24 of its residual.
LIKELIER, HALF = 30.0, 0.5
# Share of the usual deviation (mbar rms) by which mechanisms must differ to be told apart. Chosen
# on a lifting lip: an opening above some vacuum is 0.26 from seepage and 0.35 from an inflow above
# it, and 0.54 to 0.6 from one that gathers. Calibrations differ in whether opening or seepage wins.
APART = 0.5
# A threshold is crossed between two rows, so the misfit is a step function of it, and a fit stops
# at a step. Changes of thresholds (in typical sizes) that are tried from there, and rounds of it.
AFAR, LEAPS = (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0), 4
# A mechanism hardly varies if its least share is above so much of its largest. That is two sigmas
# of what the law of a listed effect is off by: no law is known better.
STEADY = 1.0 - 2.0 * MISMATCH
# Groups of coefficients with the same meaning for a plant: inflows, and resistances of the line.
ALIKE = ({c.LEAK, c.LAMINAR_LEAK, c.INFLOW}, {c.NEAR_RESISTANCE, c.RESISTANCE})


@dataclass(frozen=True)
class Explained:
    """A mechanism that explains the deviation better than listed effects, and causes beside it."""

    fitted: Fitted  # the causes beside it, then the mechanism
    ends: tuple[Floats, Floats]  # low and high ends of the 95 % interval of each size
    rivals: tuple[Cause, ...]  # other mechanisms that the log cannot tell from it

    @property
    def cause(self) -> Cause:
        """The mechanism with its fitted sizes."""
        return self.fitted.hypothesis[-1]

    @property
    def beside(self) -> Hypothesis:
        """The listed causes that act beside the mechanism."""
        return self.fitted.hypothesis[:-1]


def explain(
    evidence: Evidence, fitted: Sequence[int], causes: Hypothesis, progress: Progress
) -> Explained | None:
    """The best mechanism for the ``fitted`` cycles, by itself or beside the listed ``causes``.

    Causes stand unless a mechanism alone leaves far less than they do: then they only mimic it.
    None if no mechanism explains most of the deviation, or most of what the causes leave.
    """
    by_itself = explain_alone(evidence, fitted, causes, progress)
    names = [cause.effect for cause in causes]
    if by_itself or not causes or not has_room(evidence.theta, names, more=1):
        return by_itself
    ranked = _best(evidence, fitted, causes, progress)
    if _is_listed(evidence, fitted, ranked[0].hypothesis, causes):
        return None  # it mends the law of the cause beside which it stands
    return _explained(evidence, fitted, causes, ranked)


def explain_alone(
    evidence: Evidence, fitted: Sequence[int], causes: Hypothesis, progress: Progress
) -> Explained | None:
    """The best mechanism by itself; None if it does not displace the ``causes``."""
    if not has_room(evidence.theta, (), more=1):
        return None
    progress("trying mechanisms")
    ranked = _best(evidence, fitted, HEALTHY, progress)
    if _is_listed(evidence, fitted, ranked[0].hypothesis, causes):
        return None
    by_itself = _explained(evidence, fitted, HEALTHY, ranked)
    displaces = by_itself and (not causes or _displaces(evidence, fitted, by_itself, causes))
    return by_itself if displaces else None


def _is_listed(
    evidence: Evidence, fitted: Sequence[int], hypothesis: Hypothesis, causes: Hypothesis
) -> bool:
    """Whether a mechanism, which ends a hypothesis, is one of some listed causes.

    It acts where the cause does. It only warms up: then it is the cause with another course. Or it
    hardly varies, and there is no other cause: then it is the cause by another law.
    """
    mechanism = hypothesis[-1]
    if not any(acts_where(evidence.theta, mechanism, cause) for cause in causes):
        return False
    if MECHANISMS[mechanism.effect].when.code == ALWAYS:
        return True
    return len(causes) == 1 and hardly_varies(evidence, fitted, hypothesis)


def acts_where(theta: Theta, mechanism: Cause, cause: Cause) -> bool:
    """Whether a mechanism acts on coefficients that a listed cause acts on.

    Those of a group of ALIKE count as the same.
    """
    effect = effect_of(cause.effect)
    moved = theta.copy()
    effect.act(moved, *(p.after(1.0, theta) for p in effect.parameters))
    changed = set(np.flatnonzero(moved != theta).tolist())
    similar = set(MECHANISMS[mechanism.effect].place.coefficients)
    for group in ALIKE:
        similar |= group if similar & group else set()
    return not changed.isdisjoint(similar)


def hardly_varies(evidence: Evidence, cycles: Sequence[int], hypothesis: Hypothesis) -> bool:
    """Whether a mechanism, which ends a hypothesis, acts nearly evenly throughout ``cycles``."""
    share = in_bins(evidence, hypothesis).share[np.isin(evidence.bins.cycle, cycles)]
    return bool(share.min() > STEADY * share.max())


def _displaces(
    evidence: Evidence, fitted: Sequence[int], single: Explained, causes: Hypothesis
) -> bool:
    """Whether a mechanism's residual is so much smaller that the causes only mimic it.

    Residuals are compared in mbar. If that of the causes is healthy, likelihoods are compared too.
    One mechanism also replaces several causes if its residual is smaller and it is likelier.
    """
    weights, mechanism = covariance(evidence, both_ways=False).of(fitted), single.fitted.hypothesis
    before, after = _squares(evidence, weights, causes, mechanism)
    most = HALF * before
    if before > weights.usual**2:
        if _left_in_mbar(before, after, weights.usual**2) < DISPLACES:
            return True
        most = before if len(causes) > 1 else 0.0
    return after < most and _unlikely(evidence, fitted, mechanism) + LIKELIER < _unlikely(
        evidence, fitted, causes
    )


def _unlikely(evidence: Evidence, fitted: Sequence[int], hypothesis: Hypothesis) -> float:
    """Penalised chi-square of a hypothesis, with its own weights and their log-determinant."""
    weights = covariance(evidence, hypothesis).of(fitted)
    (best,) = fit(evidence, weights, [hypothesis])
    return best.score + weights.volume


def _best(
    evidence: Evidence, fitted: Sequence[int], causes: Hypothesis, progress: Progress
) -> list[Fitted]:
    """Mechanisms beside some causes, the best first, fitted with the weights of the best one."""
    weights = covariance(evidence, causes, both_ways=False).of(fitted)
    starts = _promising(evidence, weights, causes)
    progress(f"fitting {len(starts)} mechanisms")
    ranked = _ranked(fit(evidence, weights, starts, best_only=True))
    weights_about_best = covariance(evidence, ranked[0].hypothesis, both_ways=False).of(fitted)
    hypotheses = [
        candidate.hypothesis for candidate in ranked if candidate.score < 2.0 * ranked[0].score
    ]
    return _ranked(_fit_with_leaps(evidence, weights_about_best, hypotheses))


def _fit_with_leaps(
    evidence: Evidence, weights: ResidualWhitener, hypotheses: Sequence[Hypothesis]
) -> list[Fitted]:
    """Fit hypotheses that end with a mechanism; refit from leaps of its levels while that helps."""
    finished, improving = list[Fitted](), fit(evidence, weights, hypotheses)
    for _ in range(LEAPS):
        if not improving:
            break
        leaps = _farther_off(evidence, weights, improving)
        finished += [
            candidate for candidate, leap in zip(improving, leaps, strict=True) if leap is None
        ]
        refitted = fit(evidence, weights, [leap for leap in leaps if leap is not None])
        before = [
            candidate for candidate, leap in zip(improving, leaps, strict=True) if leap is not None
        ]
        improving = [
            min(pair, key=lambda candidate: candidate.score)
            for pair in zip(before, refitted, strict=True)
        ]
    return finished + improving


def _farther_off(
    evidence: Evidence, weights: ResidualWhitener, fits: Sequence[Fitted]
) -> list[Hypothesis | None]:
    """The best leap from each fit; None if no leap improves on the fit."""
    leaps = [list(_leaps(evidence, candidate.hypothesis)) for candidate in fits]
    all_leaps = [leap for own_leaps in leaps for leap in own_leaps]
    chi2 = np.sum(white(evidence, weights, all_leaps) ** 2, axis=0) if all_leaps else np.empty(0)
    ends, best = np.cumsum([len(own_leaps) for own_leaps in leaps])[:-1], list[Hypothesis | None]()
    for candidate, own_leaps, misfits in zip(fits, leaps, np.split(chi2, ends), strict=True):
        index = int(np.argmin(misfits)) if own_leaps else 0
        best.append(own_leaps[index] if own_leaps and misfits[index] < candidate.chi2 else None)
    return best


def _leaps(evidence: Evidence, hypothesis: Hypothesis) -> Iterator[Hypothesis]:
    """Variants of a hypothesis with one level of its mechanism changed by a step of AFAR."""
    *beside, last = hypothesis
    when = MECHANISMS[last.effect].when
    for p in when.parameters if when.code == ABOVE else ():
        for steps in AFAR:
            value = p.after(p.steps_to(last.values[p.name], evidence.theta) + steps, evidence.theta)
            if p.low <= value <= p.high:
                yield (*beside, replace(last, values={**last.values, p.name: value}))


def _ranked(fits: Sequence[Fitted]) -> list[Fitted]:
    return sorted(fits, key=lambda candidate: candidate.score)


def _promising(
    evidence: Evidence, weights: ResidualWhitener, causes: Hypothesis
) -> list[Hypothesis]:
    """One start, with sizes, for each of the FITTED mechanisms with the lowest misfit."""
    residuals = white(evidence, weights, [causes])[:, 0]
    starts = [
        _Start(mechanism, shape)
        for mechanism in MECHANISMS.values()
        if mechanism.when.code not in RHYTHMIC
        for shape in mechanism.when.starts
    ]
    starts += [_Start(*start) for start in rhythmic_starts(evidence, weights, causes)]
    probes = PROBES if float(np.mean(residuals**2)) > GROSS**2 else PROBES[:1]
    gains, sizes = _linear(evidence, weights, residuals, causes, starts * len(probes), probes)
    starts *= len(probes)
    order = np.argsort(-gains)[:TRIED_LARGER]
    tried = [(*causes, starts[i].cause(times * sizes[i])) for i in order for times in AROUND]
    chi2 = np.sum(white(evidence, weights, tried) ** 2, axis=0)
    best: dict[str, tuple[float, Hypothesis]] = {}
    for hypothesis, misfit in zip(tried, chi2, strict=True):
        name = hypothesis[-1].effect
        if name not in best or misfit < best[name][0]:
            best[name] = float(misfit), hypothesis
    return [
        hypothesis for _, hypothesis in sorted(best.values(), key=lambda entry: entry[0])[:FITTED]
    ]


@dataclass(frozen=True)
class _Start:
    """A mechanism with values of its parameters other than sizes."""

    mechanism: Mechanism
    shape: tuple[float, ...]

    def cause(self, sizes: Floats) -> Cause:
        """The mechanism with ``sizes`` (in typical ones), clipped to their bounds."""
        place, when = self.mechanism.place, self.mechanism.when
        values = {
            parameter.name: float(np.clip(size * parameter.typical, parameter.low, parameter.high))
            for parameter, size in zip(place.parameters, sizes, strict=True)
        }
        shape = zip((parameter.name for parameter in when.parameters), self.shape, strict=True)
        return Cause(self.mechanism.name, values | dict(shape))


def _linear(
    evidence: Evidence,
    weights: ResidualWhitener,
    residuals: Floats,
    causes: Hypothesis,
    starts: Sequence[_Start],
    probes: Sequence[float],
) -> tuple[Floats, list[Floats]]:
    """Gain in chi-square of each start in a linear model, and its sizes there.

    The response to a size is a secant of as many typical sizes as the start's value of ``probes``.
    """
    start_probes = np.repeat(probes, len(starts) // len(probes))
    units = [
        probe * np.eye(len(start.mechanism.place.parameters))
        for start, probe in zip(starts, start_probes, strict=True)
    ]
    tried = [
        (*causes, start.cause(unit))
        for start, start_units in zip(starts, units, strict=True)
        for unit in start_units
    ]
    moves = white(evidence, weights, tried) - residuals[:, None]
    ends = np.cumsum([len(start_units) for start_units in units])[:-1]
    gains, sizes = [], []
    for start, probe, secants in zip(
        starts, start_probes, np.split(moves, ends, axis=1), strict=True
    ):
        table = start.mechanism.place.parameters
        low = np.array([parameter.low / parameter.typical for parameter in table]) / probe
        high = np.array([parameter.high / parameter.typical for parameter in table]) / probe
        size = lsq_linear(secants, -residuals, (low, high)).x
        sizes.append(size * probe)
        gains.append(float(residuals @ residuals - np.sum((residuals + secants @ size) ** 2)))
    return np.array(gains), sizes


def _explained(
    evidence: Evidence, fitted: Sequence[int], causes: Hypothesis, ranked: Sequence[Fitted]
) -> Explained | None:
    """The best mechanism beside some causes; None if it leaves too much of their residual."""
    best = ranked[0]
    best_covariance = covariance(evidence, best.hypothesis)
    weights = best_covariance.of(fitted)
    (best,) = fit(evidence, weights, [best.hypothesis])
    before = float(np.sum(white(evidence, weights, [causes]) ** 2))
    share_left = (best.chi2 - best.count) / max(before - best.count, 1.0)
    in_mbar, usual = _squares(evidence, weights, causes, best.hypothesis), weights.usual**2
    left_in_mbar = _left_in_mbar(*in_mbar, usual)
    nearly_all = share_left < NEARLY_ALL or (in_mbar[0] > usual and left_in_mbar < NEARLY_ALL)
    most_left = HALF if nearly_all else MOST_LEFT
    if max(share_left, left_in_mbar) > most_left:
        return None
    rivals = tuple(
        candidate.hypothesis[-1] for candidate in _not_told_from(evidence, weights, ranked)
    )
    return Explained(best, interval(evidence, weights, best), rivals)


def _not_told_from(
    evidence: Evidence, weights: ResidualWhitener, ranked: Sequence[Fitted]
) -> Iterator[Fitted]:
    """Fits that are about as likely as the best one, or nearly equal to it in mbar.

    A fit that differs from the best by far less than the healthy deviation may be the true one:
    the twin's own error decides the order of both.
    """
    best, *rivals = ranked
    limit = best.score + CHI2_999 * max(best.leftover**2, 1.0)
    deviations = evidence.off([candidate.hypothesis for candidate in ranked])[weights.bins]
    count = evidence.bins.count[weights.bins]
    apart = np.average((deviations - deviations[:, :1]) ** 2, axis=0, weights=count)
    for candidate, square in zip(rivals, apart[1:], strict=True):
        if candidate.score < limit or square < (APART * weights.usual) ** 2:
            yield candidate


def _left_in_mbar(before: float, after: float, usual: float) -> float:
    """Mean square deviation ``after`` over that ``before`` (mbar²), both less the ``usual`` one.

    If the residual before is no more than usual, the ratio is undefined, since steep edges dominate
    it: then 0 if less is left after, else 1.
    """
    if before > usual:
        return (after - usual) / max(before - usual, 1e-9)
    return float(after >= before)


def _squares(
    evidence: Evidence, weights: ResidualWhitener, causes: Hypothesis, hypothesis: Hypothesis
) -> tuple[float, float]:
    """Mean square deviation (mbar²) of two hypotheses."""
    deviations = evidence.off([causes, hypothesis])[weights.bins]
    before, after = np.average(deviations**2, axis=0, weights=evidence.bins.count[weights.bins])
    return float(before), float(after)
