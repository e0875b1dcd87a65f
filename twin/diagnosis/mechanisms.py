"""What nobody listed, as physics: where it acts on the plant, when and how, fitted and compared.

Every mechanism that can be made of a place and a way of acting is tried in the same model as the
listed effects, alone and beside the causes that were found. A small size of each tells how well it
suits; the best are fitted with all that they leave open and compared by what they leave and how
much they need for it. Nothing here has seen the held-out cycles.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from twin.diagnosis.covariance import Weights, covariance
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.diagnosis.fit import Fitted, fit, interval, white
from twin.inference.levels import CHI2_999
from twin.model import theta as c
from twin.model.catalogue import has_room
from twin.model.courses import Cause
from twin.model.effects import effect_of
from twin.model.mechanism import ABOVE, ALWAYS, MECHANISMS, Mechanism
from twin.model.theta import Theta
from twin.monitor.bins import Floats

Progress = Callable[[str], None]

TRIED_LARGER, FITTED = 40, 8  # starts that are tried at their size, mechanisms that are fitted
# Typical sizes that a start is run with; the larger one where the twin is off by more than so many
# sigmas, as what acts there is far from linear.
PROBES, GROSS = (1.0, 5.0), 5.0
AROUND = (0.5, 1.0, 2.0)  # times the size that the linear model promises
# Of what is off beyond healthy cycles, in sigmas and in mbar (squares), on the cycles that it is
# fitted to: a mechanism that leaves more is not what acts. Chosen: effects of the other world leave
# up to a tenth of their own.
MOST_LEFT = 0.3
# Of what listed causes leave (mbar, squares), below which a mechanism alone takes their place.
# Chosen: icing leaves 0.53 of what an end vacuum loss with a porous leak does that mimic it.
DISPLACES = 0.6
# Chi-square, by weights about each, and share of mbar (squares): by so much a mechanism must do
# better where listed causes leave no more than healthy cycles have, and it is told from how it
# does. Chosen: a lip that lifts is 115 better than the porous leak that mimics it, with 0.24.
LIKELIER, HALF = 30.0, 0.5
# Of the usual deviation (mbar rms), by which mechanisms must differ to be told apart. Chosen: of a
# lip that lifts, an opening above some vacuum is 0.26 and 0.35 from seepage and an inflow above it,
# and 0.54 to 0.6 from one that gathers; one calibration has the opening first, another the seepage.
APART = 0.5
# A level is passed between two rows, so that the misfit over it has steps, and a fit ends at one.
# Typical changes of levels that are tried from there, and how often.
AFAR, LEAPS = (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0), 4
# Coefficients that say the same of a plant: what flows in, and what narrows its line.
ALIKE = ({c.LEAK, c.LAMINAR_LEAK, c.INFLOW}, {c.NEAR_RESISTANCE, c.RESISTANCE})


@dataclass(frozen=True)
class Explained:
    """A mechanism that explains what no listed effect does, with the causes that stand beside."""

    fitted: Fitted  # the causes beside it, then the mechanism
    ends: tuple[Floats, Floats]  # 95 % interval of each of its sizes
    rivals: tuple[Cause, ...]  # other mechanisms that the log does not tell from it

    @property
    def cause(self) -> Cause:
        """The mechanism with what was found of it."""
        return self.fitted.hypothesis[-1]

    @property
    def beside(self) -> Hypothesis:
        """The listed causes that act as well."""
        return self.fitted.hypothesis[:-1]


def explain(
    evidence: Evidence, fitted: Sequence[int], found: Hypothesis, progress: Progress
) -> Explained | None:
    """The mechanism that suits the ``fitted`` cycles best, by itself or beside what was ``found``.

    Listed causes stand unless a mechanism alone leaves far less than they do: then they mimic it.
    None where none explains most of what is off, beside them of what they leave.
    """
    alone = explain_alone(evidence, fitted, found, progress)
    names = [cause.effect for cause in found]
    if alone or not found or not has_room(evidence.theta, names, more=1):
        return alone
    return _explained(evidence, fitted, found, _best(evidence, fitted, found, progress))


def explain_alone(
    evidence: Evidence, fitted: Sequence[int], found: Hypothesis, progress: Progress
) -> Explained | None:
    """The mechanism that suits best by itself; None if it does not displace what was ``found``."""
    if not has_room(evidence.theta, (), more=1):
        return None
    progress("trying mechanisms")
    ranked = _best(evidence, fitted, HEALTHY, progress)
    if any(is_a_course_of(evidence.theta, ranked[0].hypothesis[-1], cause) for cause in found):
        return None
    alone = _explained(evidence, fitted, HEALTHY, ranked)
    displaces = alone and (not found or _displaces(evidence, fitted, alone, found))
    return alone if displaces else None


def is_a_course_of(theta: Theta, mechanism: Cause, cause: Cause) -> bool:
    """Whether a mechanism is a listed cause that only comes in another way as time goes on.

    It acts at all times, on what that cause acts on. What flows in is one, and so is a line.
    """
    known, effect = MECHANISMS[mechanism.effect], effect_of(cause.effect)
    if known.when.code != ALWAYS:
        return False
    moved = theta.copy()
    effect.act(moved, *(p.after(1.0, theta) for p in effect.parameters))
    changed = set(np.flatnonzero(moved != theta).tolist())
    alike = set(known.place.coefficients)
    for some in ALIKE:
        alike |= some if alike & some else set()
    return not changed.isdisjoint(alike)


def _displaces(
    evidence: Evidence, fitted: Sequence[int], alone: Explained, found: Hypothesis
) -> bool:
    """Whether a mechanism leaves so much less than causes that they mimic it.

    In mbar, or where that is no more than healthy cycles have, in how likely the log is.
    """
    weights, mechanism = covariance(evidence, both_ways=False).of(fitted), alone.fitted.hypothesis
    before, after = _squares(evidence, weights, found, mechanism)
    if before > weights.usual**2:
        return _left_in_mbar(evidence, weights, found, mechanism) < DISPLACES
    return after < HALF * before and _unlikely(evidence, fitted, mechanism) + LIKELIER < _unlikely(
        evidence, fitted, found
    )


def _unlikely(evidence: Evidence, fitted: Sequence[int], hypothesis: Hypothesis) -> float:
    """Chi-square of a hypothesis with its price, by weights about itself; wide ones cost."""
    weights = covariance(evidence, hypothesis).of(fitted)
    (found,) = fit(evidence, weights, [hypothesis])
    return found.score + weights.volume


def _best(
    evidence: Evidence, fitted: Sequence[int], causes: Hypothesis, progress: Progress
) -> list[Fitted]:
    """Mechanisms beside some causes, the best first: fitted with weights about what is best."""
    weights = covariance(evidence, causes, both_ways=False).of(fitted)
    starts = _promising(evidence, weights, causes)
    progress(f"fitting {len(starts)} mechanisms")
    ranked = _ranked(fit(evidence, weights, starts, best_only=True))
    known = covariance(evidence, ranked[0].hypothesis, both_ways=False).of(fitted)
    again = [one.hypothesis for one in ranked if one.score < 2.0 * ranked[0].score]
    return _ranked(_fit_with_leaps(evidence, known, again))


def _fit_with_leaps(
    evidence: Evidence, weights: Weights, hypotheses: Sequence[Hypothesis]
) -> list[Fitted]:
    """Fit hypotheses that end with a mechanism, again from farther off while that is better."""
    done, going = list[Fitted](), fit(evidence, weights, hypotheses)
    for _ in range(LEAPS):
        if not going:
            break
        better = _farther_off(evidence, weights, going)
        done += [one for one, leap in zip(going, better, strict=True) if leap is None]
        again = fit(evidence, weights, [leap for leap in better if leap is not None])
        before = [one for one, leap in zip(going, better, strict=True) if leap is not None]
        going = [min(pair, key=lambda one: one.score) for pair in zip(before, again, strict=True)]
    return done + going


def _farther_off(
    evidence: Evidence, weights: Weights, fits: Sequence[Fitted]
) -> list[Hypothesis | None]:
    """The best leap from each fit; None where all are worse than the fit."""
    leaps = [list(_leaps(evidence, one.hypothesis)) for one in fits]
    every = [leap for some in leaps for leap in some]
    chi2 = np.sum(white(evidence, weights, every) ** 2, axis=0) if every else np.empty(0)
    ends, found = np.cumsum([len(some) for some in leaps])[:-1], list[Hypothesis | None]()
    for one, some, misfits in zip(fits, leaps, np.split(chi2, ends), strict=True):
        least = int(np.argmin(misfits)) if some else 0
        found.append(some[least] if some and misfits[least] < one.chi2 else None)
    return found


def _leaps(evidence: Evidence, hypothesis: Hypothesis) -> Iterator[Hypothesis]:
    """The same with the levels at which its mechanism begins and ends changed by much."""
    *beside, last = hypothesis
    when = MECHANISMS[last.effect].when
    for p in when.parameters if when.code == ABOVE else ():
        for steps in AFAR:
            value = p.after(p.steps_to(last.values[p.name], evidence.theta) + steps, evidence.theta)
            if p.low <= value <= p.high:
                yield (*beside, replace(last, values={**last.values, p.name: value}))


def _ranked(fits: Sequence[Fitted]) -> list[Fitted]:
    return sorted(fits, key=lambda one: one.score)


def _promising(evidence: Evidence, weights: Weights, causes: Hypothesis) -> list[Hypothesis]:
    """One start of each of the mechanisms that promise most, at its sizes."""
    starts = [_Start(one, shape) for one in MECHANISMS.values() for shape in one.when.starts]
    left = white(evidence, weights, [causes])[:, 0]
    probes = PROBES if float(np.mean(left**2)) > GROSS**2 else PROBES[:1]
    gains, sizes = _linear(evidence, weights, left, causes, starts * len(probes), probes)
    starts *= len(probes)
    order = np.argsort(-gains)[:TRIED_LARGER]
    tried = [(*causes, starts[i].cause(times * sizes[i])) for i in order for times in AROUND]
    chi2 = np.sum(white(evidence, weights, tried) ** 2, axis=0)
    best: dict[str, tuple[float, Hypothesis]] = {}
    for hypothesis, misfit in zip(tried, chi2, strict=True):
        name = hypothesis[-1].effect
        if name not in best or misfit < best[name][0]:
            best[name] = float(misfit), hypothesis
    return [one for _, one in sorted(best.values(), key=lambda some: some[0])[:FITTED]]


@dataclass(frozen=True)
class _Start:
    """A mechanism with values of what is to be known beside its sizes."""

    mechanism: Mechanism
    shape: tuple[float, ...]

    def cause(self, sizes: Floats) -> Cause:
        """The same with its ``sizes``, in typical ones, kept within their bounds."""
        place, when = self.mechanism.place, self.mechanism.when
        values = {
            one.name: float(np.clip(size * one.typical, one.low, one.high))
            for one, size in zip(place.parameters, sizes, strict=True)
        }
        shape = zip((one.name for one in when.parameters), self.shape, strict=True)
        return Cause(self.mechanism.name, values | dict(shape))


def _linear(
    evidence: Evidence,
    weights: Weights,
    left: Floats,
    causes: Hypothesis,
    starts: Sequence[_Start],
    probes: Sequence[float],
) -> tuple[Floats, list[Floats]]:
    """Chi-square that each start would gain were it linear in its sizes, and these sizes.

    How it moves the pressure is a secant to so many typical sizes as its part of ``probes``.
    """
    each = np.repeat(probes, len(starts) // len(probes))
    units = [
        probe * np.eye(len(one.mechanism.place.parameters))
        for one, probe in zip(starts, each, strict=True)
    ]
    tried = [
        (*causes, one.cause(unit)) for one, some in zip(starts, units, strict=True) for unit in some
    ]
    moves = white(evidence, weights, tried) - left[:, None]
    ends = np.cumsum([len(some) for some in units])[:-1]
    gains, sizes = [], []
    for start, probe, some in zip(starts, each, np.split(moves, ends, axis=1), strict=True):
        table = start.mechanism.place.parameters
        low = np.array([one.low / one.typical for one in table]) / probe
        high = np.array([one.high / one.typical for one in table]) / probe
        size = lsq_linear(some, -left, (low, high)).x
        sizes.append(size * probe)
        gains.append(float(left @ left - np.sum((left + some @ size) ** 2)))
    return np.array(gains), sizes


def _explained(
    evidence: Evidence, fitted: Sequence[int], causes: Hypothesis, ranked: Sequence[Fitted]
) -> Explained | None:
    """The best mechanism beside some causes, where it takes most of what they leave."""
    best = ranked[0]
    known = covariance(evidence, best.hypothesis)
    weights = known.of(fitted)
    (best,) = fit(evidence, weights, [best.hypothesis])
    before = float(np.sum(white(evidence, weights, [causes]) ** 2))
    left = (best.chi2 - best.count) / max(before - best.count, 1.0)
    left = max(left, _left_in_mbar(evidence, weights, causes, best.hypothesis))
    if left > MOST_LEFT:
        return None
    rivals = tuple(one.hypothesis[-1] for one in _not_told_from(evidence, weights, ranked))
    return Explained(best, interval(evidence, weights, best), rivals)


def _not_told_from(
    evidence: Evidence, weights: Weights, ranked: Sequence[Fitted]
) -> Iterator[Fitted]:
    """Those that suit as well as the best, or go where it goes.

    What differs from it by far less than the twin is off in healthy cycles (mbar) may be what acts,
    as the order of both hangs on what the twin is off by.
    """
    best, *others = ranked
    near = best.score + CHI2_999 * max(best.leftover**2, 1.0)
    off = evidence.off([one.hypothesis for one in ranked])[weights.bins]
    count = evidence.bins.count[weights.bins]
    apart = np.average((off - off[:, :1]) ** 2, axis=0, weights=count)
    for one, square in zip(others, apart[1:], strict=True):
        if one.score < near or square < (APART * weights.usual) ** 2:
            yield one


def _left_in_mbar(
    evidence: Evidence, weights: Weights, causes: Hypothesis, hypothesis: Hypothesis
) -> float:
    """Share of the mean square deviation of causes, beyond healthy cycles', that another leaves."""
    before, after = _squares(evidence, weights, causes, hypothesis)
    usual = weights.usual**2
    return float((after - usual) / max(before - usual, 1e-9)) if before > usual else 1.0


def _squares(
    evidence: Evidence, weights: Weights, causes: Hypothesis, hypothesis: Hypothesis
) -> tuple[float, float]:
    """Mean square deviation (mbar²) of two hypotheses."""
    off = evidence.off([causes, hypothesis])[weights.bins]
    before, after = np.average(off**2, axis=0, weights=evidence.bins.count[weights.bins])
    return float(before), float(after)
