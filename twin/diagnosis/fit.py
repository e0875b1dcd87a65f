"""Fits of many hypotheses at once, with one run of the bank for each step."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.hypotheses import bounds, price, sized, sizes
from twin.diagnosis.residual_covariance import ResidualWhitener, levels
from twin.inference.gauss_newton import Descent, descend, information
from twin.inference.levels import CHI2_95
from twin.inference.profile import profile_interval
from twin.inference.sensitivities import derivatives, inside, points
from twin.model.courses import Course
from twin.monitor.bins import Floats

HOPELESS = 3.0  # a fit is given up after some rounds if it has so many times the best chi-square
# If only the best is wanted: the gain that a fit may still have, over that of its last step, and
# the distance to the best, in the best's chi-square per residual, beyond which it is given up.
PACE, FAR = 3.0, 60.0


@dataclass(frozen=True)
class Fitted:
    """A hypothesis with the sizes that fit the evidence best."""

    hypothesis: Hypothesis
    x: Floats  # sizes
    covariance: Floats  # of the sizes
    chi2: float
    score: float  # chi-square with the log-prior penalty of the hypothesis: the least is the best
    count: int  # of residuals

    @property
    def leftover(self) -> float:
        """Rms of the whitened residuals; 1 is healthy."""
        return float(np.sqrt(self.chi2 / max(self.count, 1)))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its effects."""
        return tuple(cause.effect for cause in self.hypothesis)

    @property
    def courses(self) -> tuple[Course, ...]:
        """Courses of its causes."""
        return tuple(cause.course for cause in self.hypothesis)

    @property
    def kind(self) -> frozenset[tuple[str, Course]]:
        """Its effects with their courses, whatever their sizes and times."""
        return frozenset((cause.effect, cause.course) for cause in self.hypothesis)


@dataclass(kw_only=True)
class _Trial(Descent):
    """A fit of a hypothesis in progress."""

    hypothesis: Hypothesis

    @property
    def kind(self) -> frozenset[object]:
        """Its hypothesis without sizes."""
        return frozenset(
            (c.effect, *c.law().values(), c.course, c.onset_s, c.cycles) for c in self.hypothesis
        )


def white(
    evidence: Evidence, weights: ResidualWhitener, hypotheses: Sequence[Hypothesis]
) -> Floats:
    """Whitened residuals of hypotheses, (residuals, hypotheses)."""
    return weights.white(evidence.off(hypotheses), levels(evidence, weights.cycles, hypotheses))


def fit(
    evidence: Evidence,
    weights: ResidualWhitener,
    hypotheses: Sequence[Hypothesis],
    *,
    best_only: bool = False,
) -> list[Fitted]:
    """Fit the sizes of hypotheses, starting from those they have.

    A fit that is given up keeps its best point: its score is an upper bound. With ``best_only``,
    fits that will not come near the best are given up as well.
    """
    trials = [_trial(evidence, hypothesis) for hypothesis in hypotheses]

    def residuals(requests: Sequence[tuple[_Trial, Floats]]) -> Floats:
        return white(
            evidence, weights, [sized(evidence, trial.hypothesis, x) for trial, x in requests]
        )

    descend(trials, residuals, partial(_give_up, trials, best_only=best_only))
    return [_fitted(evidence, trial) for trial in trials]


def profiled(
    evidence: Evidence, weights: ResidualWhitener, hypotheses: Sequence[Hypothesis]
) -> Floats:
    """Chi-square of hypotheses after one Gauss-Newton step of their sizes, linearised."""
    hypotheses_at, moves = list[Hypothesis](), list[Floats]()
    for hypothesis in hypotheses:
        x, (_, high) = sizes(evidence, hypothesis), bounds(evidence, hypothesis)
        moves.append(inside(x, high))
        hypotheses_at += [sized(evidence, hypothesis, point) for point in points(x, moves[-1]).T]
    ends = np.cumsum([1 + len(steps) for steps in moves])[:-1]
    misfits = []
    for block, steps in zip(
        np.split(white(evidence, weights, hypotheses_at), ends, axis=1), moves, strict=True
    ):
        residual, jacobian = derivatives(block, steps)
        gradient = jacobian.T @ residual
        explained = gradient @ np.linalg.solve(information(jacobian), gradient)
        misfits.append(float(residual @ residual - explained))
    return np.array(misfits)


def interval(
    evidence: Evidence, weights: ResidualWhitener, fitted: Fitted
) -> tuple[Floats, Floats]:
    """95 % profile-likelihood interval of each size, low and high.

    Residuals larger than noise widen it.
    """

    def misfit(points: Floats) -> Floats:
        hypotheses = [sized(evidence, fitted.hypothesis, point) for point in points]
        chi2: Floats = np.sum(white(evidence, weights, hypotheses) ** 2, axis=0)
        return chi2

    rise = CHI2_95 * max(fitted.leftover**2, 1.0)
    limits = bounds(evidence, fitted.hypothesis)
    return profile_interval(misfit, fitted.x, fitted.covariance, limits, rise)


def _give_up(trials: Sequence[_Trial], round_number: int, *, best_only: bool) -> None:
    """From the third round on, give up hopeless fits, and those that will not be the best."""
    if round_number < 2:
        return
    best = min(trial.chi2 for trial in trials)
    for trial in trials:
        trial.done = trial.done or trial.chi2 > HOPELESS * best + HOPELESS * len(trial.residual)
    if best_only:
        _give_up_behind(trials)


def _give_up_behind(trials: Sequence[_Trial]) -> None:
    """Give up fits that will not come near the best, and those behind another of their kind."""
    trials = sorted(trials, key=lambda trial: trial.chi2)
    near, ahead = trials[0].chi2 + FAR * trials[0].scale, set[frozenset[object]]()
    for trial in trials:
        trial.done |= trial.chi2 - PACE * trial.gained > near or trial.kind in ahead
        ahead.add(trial.kind)


def _trial(evidence: Evidence, hypothesis: Hypothesis) -> _Trial:
    low, high = bounds(evidence, hypothesis)
    return _Trial(low, high, sizes(evidence, hypothesis), hypothesis=hypothesis)


def _fitted(evidence: Evidence, trial: _Trial) -> Fitted:
    hypothesis = sized(evidence, trial.hypothesis, trial.x)
    covariance = np.asarray(np.linalg.inv(trial.information), np.float64)
    cost = price(evidence, hypothesis)
    return Fitted(
        hypothesis, trial.x, covariance, trial.chi2, trial.chi2 + cost, len(trial.residual)
    )
