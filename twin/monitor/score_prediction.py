"""Prediction of a healthy unit's next scores from those so far, and scores as normal values.

Air pressure, temperature and supply of a real rig wander, and its scores wander with them. Sums
over cycles would take that for a change. So several models predict each score at once: a constant
mean with independent scatter, or a mean that wanders beside it. How fast it wanders, and its share
of the variance, differ among the models (an Ornstein-Uhlenbeck process beside white noise). Each
model is a Kalman filter of unknown sigma (West and Harrison, Bayesian Forecasting and Dynamic
Models, 4.5), and has a probability by how well it has predicted. The constant mean alone is
Hawkins' self-starting method.

By the mixture of these predictions a new score is a standard normal value, independent of those
before. That holds from the third cycle on, as far as the prior suits the rig.
"""

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri, stdtr

from twin.monitor.change_detection import ALIKE, MOST

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

FARTHEST = 30.0  # sigmas; the probability beyond underflows
TIMES = (1.0, 4.0, 16.0, 64.0, 256.0, 1024.0, 4096.0)  # s, time constants of a wander, to an hour
SHARES = (0.3, 0.6, 0.9)  # of the score's variance
# Prior probability that air pressure or a sensor's zero wanders: it does in some halls and not in
# others. Chosen.
WANDERS = 0.5
# Least log odds of a model by what it has predicted, and least ones of a wander over those of the
# constant mean: air may begin to wander after long calm, and become calm again.
FORGOTTEN, CALM = -20.0, -7.0
FEW = 10  # scores, from which their sigma is known well enough to call one odd
_MODELS = [(1.0, 0.0), *itertools.product(TIMES, SHARES)]  # the first is the constant mean
_TIME, _SHARE = np.array(_MODELS).T[:, :, None]


class _Prediction(NamedTuple):
    """Of the next scores, by each model; variances are over that of a single score."""

    wander: Floats
    wander_variance: Floats
    covariance: Floats  # of wander and mean
    variance: Floats  # of the score
    off: Floats  # the score less its prediction


class ScorePredictor:
    """Predicts the scores of several suspects from the learned cycles.

    Its arrays are (models, suspects). Variances are over that of a single score.
    """

    def __init__(self, suspects: int) -> None:
        shape = (len(_MODELS), suspects)
        self.count = np.zeros(suspects)  # learned scores of each suspect
        self._at = np.zeros(suspects)  # s, time of the newest of them
        self._mean, self._wander, self._squares = np.zeros((3, *shape))
        self._mean_variance, self._wander_variance, self._covariance = np.zeros((3, *shape))
        self._log_odds = np.zeros(shape)  # of each model, by what it has predicted
        self.expect_wander(np.zeros(suspects))

    def expect_wander(self, cosines: Floats) -> None:
        """Set the prior of each suspect by its cosine with the air pressure or the zero.

        Other scores hardly wander beforehand: a wander would pass for a slow change.
        """
        wanders = WANDERS * np.abs(cosines) ** ALIKE
        each = np.repeat(wanders[None] / (len(_MODELS) - 1), len(_MODELS) - 1, axis=0)
        self._prior = np.concatenate([1.0 - wanders[None], each])

    @property
    def mean(self) -> Floats:
        """Mean of each suspect's scores; 0 while none is known."""
        mean: Floats = np.sum(self._probability() * self._mean, axis=0)
        return mean

    def normal(self, scores: Floats, seconds: float, doubt: Floats | float = 0.0) -> Floats:
        """Scores of a cycle as standard normal values, by their predicted distribution.

        ``seconds`` is the time of the cycle. Scores within ``doubt`` of a prediction are not off,
        others are off by as much less. NaN without a score, or while fewer than two are known of
        the suspect, or if these were equal.
        """
        known = self._predict(scores, seconds)
        is_known, freedom = self._freedom()
        off = np.sign(known.off) * np.maximum(np.abs(known.off) - doubt, 0.0)
        probability, t = self._probability(), off / self._sigmas(known)
        below, above = (np.sum(probability * stdtr(freedom, side), axis=0) for side in (t, -t))
        far = np.minimum(-ndtri(np.minimum(below, above)), FARTHEST)
        return np.where(is_known, np.where(below < above, -far, far), np.nan)

    def sigma(self, seconds: float) -> Floats:
        """Sigma of each suspect's score in a cycle at a time; 1 while none is known."""
        known = self._predict(np.zeros(len(self.count)), seconds)
        variance: Floats = np.sum(self._probability() * self._sigmas(known) ** 2, axis=0)
        return np.sqrt(variance)

    def learn(self, scores: Floats, seconds: float) -> None:
        """Learn the scores of a healthy cycle; NaN changes nothing.

        Once FEW are known, a score farther off than MOST sigmas counts as so far: a single odd
        cycle must not hide later changes.
        """
        is_shown = np.isfinite(scores)
        is_first = is_shown & (self.count == 0.0)
        self._begin(is_first, scores)
        again = is_shown & ~is_first
        known = self._predict(np.where(again, scores, 0.0), seconds)
        most = np.where(self.count >= FEW, MOST * self._sigmas(known), np.inf)
        known = known._replace(off=np.clip(known.off, -most, most))
        self._weigh(again, known)
        self._filter(again, known)
        self._squares = self._squares + np.where(again, known.off**2 / known.variance, 0.0)
        self.count = self.count + is_shown
        self._at = np.where(is_shown, seconds, self._at)

    def follow(self, scores: Floats, seconds: float) -> None:
        """Follow the wander of a cycle that is not learned: sigma and the constant mean stay.

        Without it the next prediction would be as far off as this one.
        """
        is_shown = np.isfinite(scores) & (self.count > 0.0)
        known = self._predict(np.where(is_shown, scores, 0.0), seconds)
        self._weigh(is_shown, known)
        self._filter(is_shown & (_SHARE > 0.0), known)
        self._at = np.where(is_shown, seconds, self._at)

    def _sigmas(self, known: _Prediction) -> Floats:
        """Sigma of the score by each model; 1 while it is not known."""
        is_known, freedom = self._freedom()
        sigmas: Floats = np.where(
            is_known, np.sqrt(np.maximum(known.variance * self._squares, 0.0) / freedom), 1.0
        )
        return sigmas

    def _freedom(self) -> tuple[Bools, Floats]:
        """Whether the sigma of a suspect is known, and its degrees of freedom (1 if not)."""
        is_known = (self.count >= 2.0) & (self._squares[0] > 0.0)
        return is_known, np.where(is_known, self.count - 1.0, 1.0)

    def _begin(self, first: Bools, scores: Floats) -> None:
        """A first score shows only the sum of mean, wander and scatter."""
        self._mean = np.where(first, scores, self._mean)
        self._mean_variance = np.where(first, 1.0, self._mean_variance)
        self._wander_variance = np.where(first, _SHARE, self._wander_variance)
        self._covariance = np.where(first, -_SHARE, self._covariance)

    def _filter(self, shown: Bools, known: _Prediction) -> None:
        """Update mean and wander (Kalman filter) where a score is ``shown``."""
        to_mean = (self._mean_variance + known.covariance) / known.variance
        to_wander = (known.covariance + known.wander_variance) / known.variance
        mean, mean_variance = to_mean * known.off, to_mean**2 * known.variance
        wander = known.wander + to_wander * known.off
        wander_variance = known.wander_variance - to_wander**2 * known.variance
        covariance = known.covariance - to_mean * to_wander * known.variance
        self._mean = self._mean + np.where(shown, mean, 0.0)
        self._mean_variance = self._mean_variance - np.where(shown, mean_variance, 0.0)
        self._wander = np.where(shown, wander, self._wander)
        self._wander_variance = np.where(shown, wander_variance, self._wander_variance)
        self._covariance = np.where(shown, covariance, self._covariance)

    def _weigh(self, shown: Bools, known: _Prediction) -> None:
        """Add the log likelihood (Student's t) of the scores to each model's log odds."""
        is_known, freedom = self._freedom()
        shown = shown & is_known
        square = np.where(shown, known.variance * self._squares, 1.0)
        log_likelihood = -0.5 * (np.log(square) + (freedom + 1.0) * np.log1p(known.off**2 / square))
        log_odds = self._log_odds + np.where(shown, log_likelihood, 0.0)
        log_odds = np.maximum(log_odds - log_odds.max(axis=0), FORGOTTEN)
        self._log_odds = np.maximum(log_odds, log_odds[0] + np.where(_SHARE > 0.0, CALM, 0.0))

    def _predict(self, scores: Floats, seconds: float) -> _Prediction:
        """Predict the next scores at a time, which is not before that of the last."""
        keeps = np.exp(-np.maximum(seconds - self._at, 0.0) / _TIME)
        covariance = keeps * self._covariance
        wander, wander_variance = keeps * self._wander, keeps**2 * self._wander_variance
        wander_variance = wander_variance + _SHARE * (1.0 - keeps**2)
        variance = self._mean_variance + 2.0 * covariance + wander_variance + 1.0 - _SHARE
        off = scores - self._mean - wander
        return _Prediction(wander, wander_variance, covariance, variance, off)

    def _probability(self) -> Floats:
        """Of each model."""
        odds = self._prior * np.exp(self._log_odds)
        probability: Floats = odds / odds.sum(axis=0)
        return probability
