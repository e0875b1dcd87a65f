"""The alternative to each cause: something that nobody listed, smooth and of unknown size.

Some effect outside the table pushes the pressure about. Listed effects mimic a part of that, and
leave a share of it: a smooth course of its own over the time since a switching, or over the vacuum.
Its size is not known, so it is integrated over; what it could have explained and did not need to
counts against it by itself (MacKay, "Information Theory, Inference, and Learning Algorithms", 28).
A listed effect that really acts leaves a share as well, as the model's waveform is a little off:
that is small.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.fit import white
from twin.diagnosis.unlisted import OVER, smooth
from twin.diagnosis.weights import Weights
from twin.model.courses import Cause, Course
from twin.monitor.bins import Floats
from twin.monitor.weights import MISMATCH

# How probable things are beforehand, beside a single listed effect. Chosen: something that is not
# in the table is a tenth as probable, beside a listed effect a fifth; of two listed ones at once
# each is a third as probable. UNLISTED halved or doubled moves 0.96 to 0.98 or 0.93.
UNLISTED, BESIDE, FURTHER = 0.1, 0.2, 0.3
SHARES = np.geomspace(0.003, 1.0, 9)  # of what was explained, that may be left of it
_EDGES = np.concatenate([[0.0], np.sqrt(SHARES[1:] * SHARES[:-1]), [1.0]])
_ANY = np.diff(_EDGES)  # of an effect that nobody listed all shares are as probable
_LITTLE = _ANY * np.exp(-0.5 * (SHARES / MISMATCH) ** 2)  # of one that is: as its waveform is off
_LITTLE /= _LITTLE.sum()
MOST = 1e9  # beyond it nothing changes any more


@dataclass(frozen=True)
class Odds:
    """How well what is left of the data suits an effect that nobody listed.

    ``ratio`` is its marginal likelihood beside that of a listed effect, from 0 to MOST.
    """

    ratio: float

    @classmethod
    def of(cls, log_likelihoods: Floats) -> "Odds":
        """From the log likelihoods with each of SHARES left, (·, shares): courses are averaged."""
        likelihoods = np.exp(log_likelihoods - log_likelihoods.max()).mean(axis=0)
        listed, unlisted = float(likelihoods @ _LITTLE), float(likelihoods @ _ANY)
        return cls(unlisted / max(listed, unlisted / MOST))

    def of_cause(self, causes: int, rivals: float) -> float:
        """Probability that a cause acts, one of so many; ``rivals`` weigh so much beside it."""
        beside = BESIDE * self.ratio
        return (1.0 + beside) / (1.0 + rivals + beside + self._instead(causes))

    def of_unlisted(self, causes: int) -> float:
        """Probability that something acts that nobody listed, beside or instead of a cause."""
        strange = BESIDE * self.ratio + self._instead(causes)
        return strange / (1.0 + strange)

    def _instead(self, causes: int) -> float:
        return UNLISTED * self.ratio / FURTHER ** (causes - 1)


@dataclass(frozen=True)
class Unmodelled:
    """What could be left of something unlisted, beside a hypothesis."""

    evidence: Evidence
    weights: Weights  # about the hypothesis
    found: Hypothesis

    @cached_property
    def _left(self) -> Floats:
        """Residual (sigmas), and what it is without each cause in turn, (residuals, 1 + causes)."""
        without = [tuple(c for c in self.found if c is not cause) for cause in self.found]
        return white(self.evidence, self.weights, [self.found, *without])

    @cached_property
    def _courses(self) -> list[Floats]:
        """Smooth courses that come again in every cycle, over time and over vacuum."""
        off = self.evidence.off([self.found])[:, 0]
        return [
            np.hstack([hats for _, hats in smooth(self.evidence, off, over).values()])
            for over in OVER
        ]

    def odds(self, number: int) -> Odds:
        """For the cause of this number, among those found."""
        left, explained = self._left[:, 0], self._left[:, 1 + number] - self._left[:, 0]
        scale = max(float(np.mean(left**2)), 1.0)
        acts = _acts(self.evidence, self.found[number])[self.evidence.bins.cycle]
        logs = np.array(
            [
                _log_likelihoods(self.weights.white(course * acts[:, None]), left, explained, scale)
                for course in self._courses
            ]
        )
        return Odds.of(logs)


def _log_likelihoods(courses: Floats, left: Floats, explained: Floats, scale: float) -> Floats:
    """With each of SHARES left in smooth ``courses``, less that with none; all are whitened.

    A share is of the root mean square; sizes of courses are normal. ``scale`` is the variance.
    """
    ways, sizes, _ = np.linalg.svd(courses, full_matrices=False)
    power = (ways.T @ left) ** 2 / scale
    total = float(explained @ explained) / scale
    variance = SHARES[:, None] ** 2 * total * sizes**2 / max(float(sizes @ sizes), 1e-12)
    gains = power * variance / (1.0 + variance) - np.log1p(variance)
    logs: Floats = 0.5 * gains.sum(axis=1)
    return logs


def _acts(evidence: Evidence, cause: Cause) -> Floats:
    """By how much of its size a cause acts in each cycle, by its end."""
    ends = evidence.seconds[evidence.starts[1:] - 1]
    if cause.course == Course.STEP:
        return np.asarray(ends > cause.onset_s, np.float64)
    if cause.course == Course.RAMP:
        lasts = max(float(ends[-1]) - cause.onset_s, 1e-3)
        return np.clip((ends - cause.onset_s) / lasts, 0.0, 1.0)
    if cause.course == Course.INTERMITTENT:
        return np.isin(evidence.numbers, list(cause.cycles)).astype(np.float64)
    return np.ones(evidence.cycles)
