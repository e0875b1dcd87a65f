"""The alternative to each cause: something that nobody listed, smooth and of unknown size.

Some effect outside the table pushes the pressure about. Listed effects mimic a part of that, and
leave a share of it: a smooth course of its own over the time since a switching, or over the vacuum.
Its size is not known, so it is integrated over; what it could have explained and did not need to
counts against it by itself (MacKay, "Information Theory, Inference, and Learning Algorithms", 28).
A listed effect that really acts leaves a share as well, as the model's waveform is a little off:
that is small.
"""

from dataclasses import dataclass

import numpy as np

from twin.inference.whitening import Floats
from twin.model.effects import Effect

MISMATCH = 0.08  # of what an effect explains, that its waveform is off
# How probable things are beforehand, beside a single listed effect. Chosen: something that is not
# in the table is a tenth as probable; of two listed ones at once each is a third as probable.
# UNLISTED halved or doubled moves 0.96 to 0.98 or 0.93. Beside a listed effect something unlisted
# has 0.15: of 85 causes where more was left, 53 act (tools.reliability), 0.15 to 0.1 says 0.6.
UNLISTED, BESIDE, FURTHER = 0.1, 0.15, 0.3
# That a cause or a look-alike acts where something unlisted does: under the verdict `unlisted`.
MOST_BESIDE = BESIDE / (BESIDE + UNLISTED)
# Of faults, those that come and go. Two that do, each in cycles of its own, are rather one that
# changes from cycle to cycle, as much of what is unlisted does. Chosen, as in the battery.
COMES_AND_GOES = 0.2
SHARES = np.geomspace(0.003, 1.0, 9)  # of what was explained, that may be left of it
SIZES = np.geomspace(0.003, 30.0, 13)  # of the noise, that something may have where no cause acts
SMALLEST = 0.1  # of the noise, that something unlisted has: less would be part of the noise


def _widths(values: Floats) -> Floats:
    """Width of the interval about each of ``values``, which grow by the same factor."""
    edges = np.concatenate([[0.0], np.sqrt(values[1:] * values[:-1]), values[-1:]])
    widths: Floats = np.diff(edges)
    return widths


def _distribution(weights: Floats) -> Floats:
    shares: Floats = weights / weights.sum()
    return shares


_ANY = _widths(SHARES)  # of an effect that nobody listed all shares are as probable
# Of one that is listed little is left: as its waveform is off.
_LITTLE = _distribution(_ANY * np.exp(-0.5 * (SHARES / MISMATCH) ** 2))
# Weather acts on everything: Student's t with 2 degrees of freedom, as no law is quite the rig's.
_WEATHER = _distribution(_ANY * (2.0 + (SHARES / MISMATCH) ** 2) ** -1.5)
# Beside healthy cycles of another record a twin is off as well; by much on some rigs, as its
# equations are not theirs. On 72 records of 36 rigs from another world a Cauchy distribution of
# 4 to 8 % is the likeliest of Student's; a normal one of any width is exp(15) times less likely.
_TWIN = _distribution(_widths(SIZES) / (1.0 + (SIZES / MISMATCH) ** 2))
# Something unlisted is as often between one and two times the noise as between ten and twenty.
_UNLISTED = _distribution(np.where(SIZES >= SMALLEST, _widths(SIZES) / SIZES, 0.0))
MOST_SURE = 0.99  # nobody knows the whole table, nor all that may not be in it
LEAST_SURE = 0.2  # a name that is right less than once in five is none. Chosen
MOST = 1e9  # beyond it nothing changes any more


@dataclass(frozen=True)
class Odds:
    """How well what is left of the data suits an effect that nobody listed.

    ``ratio`` is its marginal likelihood beside that of a listed effect, from 0 to MOST,
    ``frequency`` how often that comes beside wear, and ``coming_and_going`` how many of the causes
    are intermittent.
    """

    ratio: float
    frequency: float = 1.0
    coming_and_going: int = 0

    @classmethod
    def of(
        cls, log_likelihoods: Floats, cause: Effect, frequency: float, coming_and_going: int = 0
    ) -> "Odds":
        """From the log likelihoods with each of SHARES left beside a cause, (·, shares).

        Courses are averaged. ``frequency`` is the cause's tempered prior one.
        """
        ratio = _ratio(log_likelihoods, _WEATHER if cause.is_weather else _LITTLE)
        return cls(ratio, frequency, coming_and_going)

    def of_cause(self, causes: int, rivals: float, *, is_beside: bool = False) -> float:
        """Probability that a cause acts, one of so many; ``rivals`` weigh so much beside it.

        ``is_beside`` says that something unlisted acts, in place of the cause or beside it.
        """
        beside = self._beside
        probability = (1.0 + beside) / (1.0 + rivals + beside + self._instead(causes))
        if not is_beside:
            return probability
        return probability * min(MOST_BESIDE / (1.0 - self.instead(causes, rivals)), 1.0)

    def instead(self, causes: int, rivals: float, *, is_beside: bool = False) -> float:
        """Probability that something unlisted acts in place of a cause, one of so many.

        ``is_beside`` as for ``of_cause``.
        """
        strange = self._instead(causes)
        probability = strange / (1.0 + rivals + self._beside + strange)
        return max(probability, 1.0 - MOST_BESIDE) if is_beside else probability

    def of_unlisted(self, causes: int) -> float:
        """Probability that something acts that nobody listed, beside or instead of a cause."""
        strange = self._beside + self._instead(causes)
        return strange / (1.0 + strange)

    @property
    def _beside(self) -> float:
        """Weight of something unlisted beside a cause; healthy records have weather as well."""
        return BESIDE * self.ratio / max(self.frequency, 1.0)

    def _instead(self, causes: int) -> float:
        """Weight of something unlisted in place of a cause, one of so many."""
        at_once: float = FURTHER ** (causes - 1) * COMES_AND_GOES ** max(
            self.coming_and_going - 1, 0
        )
        return UNLISTED * self.ratio / self.frequency / at_once


def alone(log_likelihoods: Floats) -> float:
    """Probability that something unlisted acts where no listed effect does.

    ``log_likelihoods`` are those with each of SIZES of the noise left, (·, sizes).
    """
    strange = UNLISTED * _ratio(log_likelihoods, _TWIN, _UNLISTED)
    return min(strange / (1.0 + strange), MOST_SURE)


def _ratio(log_likelihoods: Floats, expected: Floats, unlisted: Floats = _ANY) -> float:
    """Likelihood of shares as something unlisted leaves, beside the ``expected``; at most MOST."""
    likelihoods = np.exp(log_likelihoods - log_likelihoods.max()).mean(axis=0)
    usual, strange = float(likelihoods @ expected), float(likelihoods @ unlisted)
    return strange / max(usual, strange / MOST)


def log_likelihoods(
    courses: Floats, left: Floats, scale: float = 1.0, shares: Floats = SHARES
) -> Floats:
    """With each of ``shares`` left in smooth ``courses``, less that with none; all are whitened.

    Each course is as large as what is explained in its place, and is left with a normal size.
    ``scale`` is the variance of what is ``left``.
    """
    directions, sizes, _ = np.linalg.svd(courses, full_matrices=False)
    variance = shares[:, None] ** 2 * sizes**2 / scale
    power = (directions.T @ left) ** 2 / scale
    logs: Floats = 0.5 * (power * variance / (1.0 + variance) - np.log1p(variance)).sum(axis=1)
    return logs


def hats(values: Floats, knots: Floats) -> Floats:
    """Share of each knot in each value, (values, knots): straight lines between them."""
    return np.stack([np.interp(values, knots, row) for row in np.eye(len(knots))], axis=1)


def knots_over(time: Floats) -> Floats:
    """Knots over warped time, up to the last one there is."""
    return np.arange(0.5, max(float(time.max()), 1.0))
