"""Many hypotheses fitted at once: damped Gauss-Newton, all of them in one run of the bank."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear

from twin.diagnosis.covariance import Weights, levels
from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.hypotheses import bounds, price, sized, sizes
from twin.inference.levels import CHI2_95
from twin.inference.profile import profile_interval
from twin.inference.sensitivities import derivatives, inside, points
from twin.model.courses import Course
from twin.monitor.bins import Floats

MOST_ROUNDS = 10
LONGEST = 6.0  # typical sizes that one round may move
CONVERGED = 0.05  # chi-square that one more round would gain, in times what a residual has
HOPELESS = 3.0  # times the chi-square of the best, after some rounds: not worth going on
# Where only the best is asked for: what a fit may still gain, in times its last step's gain, and
# how far above the best, in chi-square per residual of that, it need not go on from there.
PACE, FAR = 3.0, 60.0
BACK = 0.3  # of a step that made it worse


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


@dataclass
class _Trial:
    """One fit on its way: the best point so far, and the one to look at next."""

    hypothesis: Hypothesis
    low: Floats
    high: Floats
    x: Floats
    chi2: float = np.inf
    residual: Floats = field(default_factory=lambda: np.empty(0))
    jacobian: Floats = field(default_factory=lambda: np.empty((0, 0)))
    next: Floats = field(default_factory=lambda: np.empty(0))
    gained: float = np.inf  # in chi-square, by the last step that helped
    done: bool = False

    @property
    def scale(self) -> float:
        """Chi-square per residual, 1 where it is less: what is left is as wide as that."""
        return max(self.chi2 / max(len(self.residual), 1), 1.0)

    @property
    def kind(self) -> frozenset[object]:
        """What it is a fit of, whatever the sizes."""
        return frozenset(
            (c.effect, *c.law().values(), c.course, c.onset_s, c.cycles) for c in self.hypothesis
        )

    def moves(self) -> Floats:
        """Steps for derivatives at the next point, one per size, away from the nearer bound."""
        return inside(self.next, self.high)

    def take(self, white: Floats) -> None:
        """Take the residuals at the next point and beside it; choose the point after it."""
        residual, jacobian = derivatives(white, self.moves())
        chi2 = float(residual @ residual)
        if not chi2 < self.chi2:
            back = self.x + BACK * (self.next - self.x)
            self.done = bool(np.abs(self.next - self.x).max(initial=0.0) < 0.01)
            self.next = back
            return
        self.gained = self.chi2 - chi2
        self.x, self.chi2, self.residual, self.jacobian = self.next, chi2, residual, jacobian
        q, r = np.linalg.qr(self.jacobian)
        pull = q.T @ residual
        low = np.maximum(self.low - self.x, -LONGEST) - 1e-9
        high = np.minimum(self.high - self.x, LONGEST) + 1e-9
        r = np.concatenate([r, 1e-4 * np.eye(len(low))])  # where nothing holds a size, it stays
        step = lsq_linear(r, -np.concatenate([pull, np.zeros(len(low))]), (low, high)).x
        gain = float(pull @ pull - np.sum((pull + r[: len(low)] @ step) ** 2))
        self.next = np.clip(self.x + step, self.low, self.high)
        self.done = gain < CONVERGED * self.scale


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
    trials = [_trial(evidence, one) for one in hypotheses]
    for turn in range(MOST_ROUNDS):
        if turn >= 2:
            _give_up(trials)
            if best_only:
                _give_up_behind(trials)
        going = [trial for trial in trials if not trial.done]
        if not going:
            break
        around = [points(trial.next, trial.moves()).T for trial in going]
        asked = [
            sized(evidence, trial.hypothesis, point)
            for trial, some in zip(going, around, strict=True)
            for point in some
        ]
        ends = np.cumsum([len(some) for some in around])[:-1]
        found = np.split(white(evidence, weights, asked), ends, axis=1)
        for trial, some in zip(going, found, strict=True):
            trial.take(some)
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
        explained = pull @ np.linalg.solve(_information(jacobian), pull)
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


def _give_up(trials: Sequence[_Trial]) -> None:
    best = min(trial.chi2 for trial in trials)
    for trial in trials:
        trial.done = trial.done or trial.chi2 > HOPELESS * best + HOPELESS * len(trial.residual)


def _give_up_behind(trials: Sequence[_Trial]) -> None:
    """Give up what will not come near the best, and what is behind another fit of its kind."""
    trials = sorted(trials, key=lambda one: one.chi2)
    near, ahead = trials[0].chi2 + FAR * trials[0].scale, set[frozenset[object]]()
    for trial in trials:
        trial.done |= trial.chi2 - PACE * trial.gained > near or trial.kind in ahead
        ahead.add(trial.kind)


def _information(jacobian: Floats) -> Floats:
    """Fisher's information of the sizes; a little where nothing depends on one."""
    information: Floats = jacobian.T @ jacobian + 1e-6 * np.eye(jacobian.shape[1])
    return information


def _trial(evidence: Evidence, hypothesis: Hypothesis) -> _Trial:
    low, high = bounds(evidence, hypothesis)
    x = np.clip(sizes(evidence, hypothesis), low, high)
    return _Trial(hypothesis, low, high, x, next=x, done=not len(x))


def _fitted(evidence: Evidence, trial: _Trial) -> Fitted:
    hypothesis = sized(evidence, trial.hypothesis, trial.x)
    covariance = np.asarray(np.linalg.inv(_information(trial.jacobian)), np.float64)
    cost = price(evidence, hypothesis)
    return Fitted(
        hypothesis, trial.x, covariance, trial.chi2, trial.chi2 + cost, len(trial.residual)
    )
