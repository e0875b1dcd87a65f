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

from twin.inference.priors import tempered
from twin.inference.whitening import Floats
from twin.model.effects import Effect

MISMATCH = 0.08  # of what an effect explains, that its waveform is off
# How probable things are beforehand, beside a single listed effect. Chosen: something that is not
# in the table is a tenth as probable; of two listed ones at once each is a third as probable.
# UNLISTED halved or doubled moves 0.96 to 0.98 or 0.93. Beside a listed effect something unlisted
# has 0.15: of 85 causes where more was left, 53 act (tools.reliability), 0.15 to 0.1 says 0.6.
UNLISTED, BESIDE, FURTHER = 0.1, 0.15, 0.3
SHARES = np.geomspace(0.003, 1.0, 9)  # of what was explained, that may be left of it
_EDGES = np.concatenate([[0.0], np.sqrt(SHARES[1:] * SHARES[:-1]), [1.0]])
_ANY = np.diff(_EDGES)  # of an effect that nobody listed all shares are as probable
_LITTLE = _ANY * np.exp(-0.5 * (SHARES / MISMATCH) ** 2)  # of one that is: as its waveform is off
_LITTLE /= _LITTLE.sum()
# Beside healthy cycles of another record a twin is off as well; by much on some rigs, as its
# equations are not theirs: Student's t with 2 degrees of freedom, on 16 records of rigs from
# another world.
_TWIN = _ANY * (2.0 + (SHARES / MISMATCH) ** 2) ** -1.5
_TWIN /= _TWIN.sum()
MOST_SURE = 0.99  # nobody knows the whole table, nor all that may not be in it
LEAST_SURE = 0.2  # a name that is right less than once in five is none. Chosen
MOST = 1e9  # beyond it nothing changes any more


@dataclass(frozen=True)
class Odds:
    """How well what is left of the data suits an effect that nobody listed.

    ``ratio`` is its marginal likelihood beside that of a listed effect, from 0 to MOST, and
    ``frequency`` how often that comes beside wear.
    """

    ratio: float
    frequency: float = 1.0

    @classmethod
    def of(cls, log_likelihoods: Floats, cause: Effect, *, ambient_is_measured: bool) -> "Odds":
        """From the log likelihoods with each of SHARES left beside a cause, (·, shares).

        Courses are averaged. Weather acts on everything, and no model's laws are quite those of the
        rig: it leaves as much as a twin leaves on another day.
        """
        expected = _TWIN if cause.is_weather else _LITTLE
        frequency = tempered(cause, ambient_is_measured=ambient_is_measured)
        return cls(_ratio(log_likelihoods, expected), frequency)

    def of_cause(self, causes: int, rivals: float) -> float:
        """Probability that a cause acts, one of so many; ``rivals`` weigh so much beside it."""
        beside = self._beside
        return (1.0 + beside) / (1.0 + rivals + beside + self._instead(causes))

    def instead(self, causes: int, rivals: float) -> float:
        """Probability that something unlisted acts in place of a cause, one of so many."""
        strange = self._instead(causes)
        return strange / (1.0 + rivals + self._beside + strange)

    def of_unlisted(self, causes: int) -> float:
        """Probability that something acts that nobody listed, beside or instead of a cause."""
        strange = self._beside + self._instead(causes)
        return strange / (1.0 + strange)

    @property
    def _beside(self) -> float:
        """Weight of something unlisted beside a cause; healthy records have weather as well."""
        return BESIDE * self.ratio / max(self.frequency, 1.0)

    def _instead(self, causes: int) -> float:
        return UNLISTED * self.ratio / self.frequency / FURTHER ** (causes - 1)


def alone(log_likelihoods: Floats) -> float:
    """Probability that something unlisted acts where no listed effect does.

    ``log_likelihoods`` are those with each of SHARES of the noise left, (·, shares).
    """
    strange = UNLISTED * _ratio(log_likelihoods, _TWIN)
    return min(strange / (1.0 + strange), MOST_SURE)


def _ratio(log_likelihoods: Floats, expected: Floats) -> float:
    """Likelihood of any share beside that of the shares that are ``expected``, at most MOST."""
    likelihoods = np.exp(log_likelihoods - log_likelihoods.max()).mean(axis=0)
    usual, unlisted = float(likelihoods @ expected), float(likelihoods @ _ANY)
    return unlisted / max(usual, unlisted / MOST)


def log_likelihoods(courses: Floats, left: Floats, scale: float = 1.0) -> Floats:
    """With each of SHARES left in smooth ``courses``, less that with none; all are whitened.

    Each course is as large as what is explained in its place, and is left with a normal size.
    ``scale`` is the variance of what is ``left``.
    """
    directions, sizes, _ = np.linalg.svd(courses, full_matrices=False)
    variance = SHARES[:, None] ** 2 * sizes**2 / scale
    power = (directions.T @ left) ** 2 / scale
    logs: Floats = 0.5 * (power * variance / (1.0 + variance) - np.log1p(variance)).sum(axis=1)
    return logs


def hats(values: Floats, knots: Floats) -> Floats:
    """Share of each knot in each value, (values, knots): straight lines between them."""
    return np.stack([np.interp(values, knots, row) for row in np.eye(len(knots))], axis=1)


def knots_over(time: Floats) -> Floats:
    """Knots over warped time, up to the last one there is."""
    return np.arange(0.5, max(float(time.max()), 1.0))
