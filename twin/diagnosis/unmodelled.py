"""The residual of a cause, and how well an unlisted effect explains it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.diagnosis.fit import white
from twin.diagnosis.hypotheses import often
from twin.diagnosis.residual_covariance import ResidualWhitener
from twin.diagnosis.unlisted import OVER, smooth
from twin.inference.priors import tempered
from twin.inference.unmodelled import MISMATCH, SHARES, SIZES, Odds, alone, log_likelihoods
from twin.model.courses import Course
from twin.model.effects import effect_of
from twin.monitor.bins import Floats


@dataclass(frozen=True)
class Unmodelled:
    """Likelihoods of an unlisted effect, given a hypothesis."""

    evidence: Evidence
    weights: ResidualWhitener  # about the hypothesis
    found: Hypothesis

    @cached_property
    def _off(self) -> Floats:
        """What is off (mbar), then that without each cause in turn, and without any.

        (bins, 2 + causes).
        """
        without = [tuple(c for c in self.found if c is not cause) for cause in self.found]
        return self.evidence.off([self.found, *without, HEALTHY])

    @cached_property
    def _residual(self) -> Floats:
        """What is off, in sigmas."""
        return white(self.evidence, self.weights, [self.found])[:, 0]

    @cached_property
    def _courses(self) -> list[Floats]:
        """Smooth courses that repeat in every cycle, over time and over vacuum."""
        off = self._off[:, 0]
        return [
            np.hstack([hats for _, hats in smooth(self.evidence, off, over).values()])
            for over in OVER
        ]

    def can_show(self, number: int) -> bool:
        """Whether what is left where a cause acts can show something unlisted.

        A cause that explains less than the waveforms of all are off by may correct a waveform. One
        that moves switching levels alone has none, and shows something unlisted only if it is one
        of several that come and go.
        """
        explained = np.sqrt(np.mean((self._off - self._off[:, :1]) ** 2, axis=0))
        if explained[1 + number] == 0.0:
            return self._irregular > 1
        return bool(explained[1 + number] > MISMATCH * explained[-1])

    @property
    def _irregular(self) -> int:
        """Number of causes that come and go."""
        return sum(cause.course == Course.INTERMITTENT for cause in self.found)

    def odds(self, number: int) -> Odds:
        """Odds for the cause of this number, among those found.

        Of what the cause explains in each place, something unlisted would leave a share.
        """
        explained = (self._off[:, 1 + number] - self._off[:, 0])[:, None]
        white = [self.weights.white(course * explained) for course in self._courses]
        cause = self.found[number]
        frequency = tempered(often(self.evidence, cause))
        of_cause = self._log_likelihoods(white), effect_of(cause.effect), frequency
        return Odds.of(*of_cause, self._irregular)

    def alone(self) -> float:
        """Probability that something unlisted acts if no cause was found.

        The residual's own width counts as noise: one odd cycle is no course that repeats.
        """
        white = [self.weights.white(course) for course in self._courses]
        noise = math.sqrt(len(self._residual))
        as_noise = [courses * (noise / np.linalg.norm(courses)) for courses in white]
        return alone(self._log_likelihoods(as_noise, SIZES))

    def _log_likelihoods(self, white: Sequence[Floats], shares: Floats = SHARES) -> Floats:
        """Of each set of whitened courses, with each of ``shares`` of them left."""
        scale = max(float(np.mean(self._residual**2)), 1.0)
        return np.array(
            [log_likelihoods(courses, self._residual, scale, shares) for courses in white]
        )
