"""The residual of a cause, and how well an unlisted effect explains it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.diagnosis.covariance import Weights
from twin.diagnosis.evidence import Evidence, Hypothesis
from twin.diagnosis.fit import white
from twin.diagnosis.unlisted import OVER, smooth
from twin.inference.unmodelled import Odds, alone, log_likelihoods
from twin.model.courses import Cause, Course
from twin.monitor.bins import Floats


@dataclass(frozen=True)
class Unmodelled:
    """Likelihoods of an unlisted effect, given a hypothesis."""

    evidence: Evidence
    weights: Weights  # about the hypothesis
    found: Hypothesis

    @cached_property
    def _residuals(self) -> Floats:
        """Residual (sigmas), then that without each cause in turn, (residuals, 1 + causes)."""
        without = [tuple(c for c in self.found if c is not cause) for cause in self.found]
        return white(self.evidence, self.weights, [self.found, *without])

    @cached_property
    def _courses(self) -> list[Floats]:
        """Smooth courses that repeat in every cycle, over time and over vacuum."""
        off = self.evidence.off([self.found])[:, 0]
        return [
            np.hstack([hats for _, hats in smooth(self.evidence, off, over).values()])
            for over in OVER
        ]

    def odds(self, number: int) -> Odds:
        """Odds for the cause of this number, among those found."""
        residual, explained = (
            self._residuals[:, 0],
            self._residuals[:, 1 + number] - self._residuals[:, 0],
        )
        scale = max(float(np.mean(residual**2)), 1.0)
        acts = _acts(self.evidence, self.found[number])[self.evidence.bins.cycle]
        logs = np.array(
            [
                log_likelihoods(
                    self.weights.white(course * acts[:, None]), residual, explained, scale
                )
                for course in self._courses
            ]
        )
        return Odds.of(logs)

    def alone(self) -> float:
        """Probability that something unlisted acts if no cause was found.

        The residual's own width counts as noise: one odd cycle is no course that repeats.
        """
        residual, noise = self._residuals[:, 0], np.ones(len(self._residuals))
        scale = max(float(np.mean(residual**2)), 1.0)
        courses = [self.weights.white(course) for course in self._courses]
        return alone(
            np.array([log_likelihoods(course, residual, noise, scale) for course in courses])
        )


def _acts(evidence: Evidence, cause: Cause) -> Floats:
    """Share of its size with which a cause acts at the end of each cycle."""
    ends = evidence.seconds[evidence.starts[1:] - 1]
    if cause.course == Course.STEP:
        return np.asarray(ends > cause.onset_s, np.float64)
    if cause.course == Course.RAMP:
        lasts = max(float(ends[-1]) - cause.onset_s, 1e-3)
        return np.clip((ends - cause.onset_s) / lasts, 0.0, 1.0)
    if cause.course == Course.INTERMITTENT:
        return np.isin(evidence.numbers, list(cause.cycles)).astype(np.float64)
    return np.ones(evidence.cycles)
