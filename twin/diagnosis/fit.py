"""Many hypotheses fitted at once, all of them in one run of the bank for each step."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from twin.diagnosis.covariance import Weights, levels
from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.hypotheses import bounds, price, sized, sizes
from twin.inference.gauss_newton import Descent, descend, information
from twin.inference.levels import CHI2_95
from twin.inference.profile import profile_interval
from twin.inference.sensitivities import derivatives, inside, points
from twin.model.courses import Course
from twin.monitor.bins import Floats

HOPELESS = 3.0  # times the chi-square of the best, after some rounds: not worth going on
# Where only the best is asked for: what a fit may still gain, in times its last step's gain, and
# how far above the best, in chi-square per residual of that, it need not go on from there.
PACE, FAR = 3.0, 60.0


@dataclass(frozen=True)
class Fitted:
    """A hypothesis with the sizes that suit the evidence best."""

    hypothesis: Hypothesis
    x: Floats  # sizes
    covariance: Floats  # of the sizes
    chi2: float
    score: float  # chi-square with the price of the hypothesis: the least is the best
    count: int  # of residuals

    @property
    def leftover(self) -> float:
        """Sigmas left; 1 is healthy."""
        return float(np.sqrt(self.chi2 / max(self.count, 1)))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects in it."""
        return tuple(cause.effect for cause in self.hypothesis)

    @property
    def kind(self) -> frozenset[tuple[str, Course]]:
        """Its effects with their courses, whatever their sizes and times."""
        return frozenset((cause.effect, cause.course) for cause in self.hypothesis)


@dataclass(kw_only=True)
class _Trial(Descent):
    """The fit of a hypothesis on its way."""

    hypothesis: Hypothesis

    @property
    def kind(self) -> frozenset[object]:
        """What it is a fit of, whatever the sizes."""
        return frozenset(
            (c.effect, *c.law().values(), c.course, c.onset_s, c.cycles) for c in self.hypothesis
        )


def white(evidence: Evidence, weights: Weights, hypotheses: Sequence[Hypothesis]) -> Floats:
    """Residuals of hypotheses in sigmas, (residuals, hypotheses)."""
    return weights.white(evidence.off(hypotheses), levels(evidence, weights.cycles, hypotheses))


def fit(
    evidence: Evidence,
    weights: Weights,
    hypotheses: Sequence[Hypothesis],
    *,
    best_only: bool = False,
) -> list[Fitted]:
    """Fit the sizes of hypotheses, from those they have.

    What is given up on the way keeps its best point: its score is at least that of its best fit.
    Where only the best is asked for, what will not come near it is given up as well.
    """
    trials = [_trial(evidence, hypothesis) for hypothesis in hypotheses]

    def residuals(asked: Sequence[tuple[_Trial, Floats]]) -> Floats:
        return white(evidence, weights, [sized(evidence, one.hypothesis, x) for one, x in asked])

    descend(trials, residuals, partial(_give_up, trials, best_only=best_only))
    return [_fitted(evidence, trial) for trial in trials]


def profiled(evidence: Evidence, weights: Weights, hypotheses: Sequence[Hypothesis]) -> Floats:
    """Chi-square of hypotheses, each with the sizes near its own that suit it best: one step."""
    asked, moves = list[Hypothesis](), list[Floats]()
    for hypothesis in hypotheses:
        x, (_, high) = sizes(evidence, hypothesis), bounds(evidence, hypothesis)
        moves.append(inside(x, high))
        asked += [sized(evidence, hypothesis, point) for point in points(x, moves[-1]).T]
    ends = np.cumsum([1 + len(steps) for steps in moves])[:-1]
    misfits = []
    for found, steps in zip(
        np.split(white(evidence, weights, asked), ends, axis=1), moves, strict=True
    ):
        residual, jacobian = derivatives(found, steps)
        pull = jacobian.T @ residual
        explained = pull @ np.linalg.solve(information(jacobian), pull)
        misfits.append(float(residual @ residual - explained))
    return np.array(misfits)


def interval(evidence: Evidence, weights: Weights, fitted: Fitted) -> tuple[Floats, Floats]:
    """95 % interval of each size, low and high, from how the misfit grows about them.

    What is left beside noise widens it.
    """

    def misfit(points: Floats) -> Floats:
        asked = [sized(evidence, fitted.hypothesis, point) for point in points]
        chi2: Floats = np.sum(white(evidence, weights, asked) ** 2, axis=0)
        return chi2

    rise = CHI2_95 * max(fitted.leftover**2, 1.0)
    limits = bounds(evidence, fitted.hypothesis)
    return profile_interval(misfit, fitted.x, fitted.covariance, limits, rise)


def _give_up(trials: Sequence[_Trial], turn: int, *, best_only: bool) -> None:
    """From the third round on, give up what is hopeless, and what will not be the best."""
    if turn < 2:
        return
    best = min(trial.chi2 for trial in trials)
    for trial in trials:
        trial.done = trial.done or trial.chi2 > HOPELESS * best + HOPELESS * len(trial.residual)
    if best_only:
        _give_up_behind(trials)


def _give_up_behind(trials: Sequence[_Trial]) -> None:
    """Give up what will not come near the best, and what is behind another fit of its kind."""
    trials = sorted(trials, key=lambda one: one.chi2)
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
