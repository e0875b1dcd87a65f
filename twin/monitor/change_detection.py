"""Change detection: sums over cycles that find changes too small for a single cycle.

The input is one score for each suspect and cycle, as a standard normal value by those before
(``score_prediction``), so that no table of healthy means has to be exact. Each suspect, sign and
size has likelihood ratios of "it began at cycle t" to "nothing changed". They are summed over all t
(Shiryaev and Roberts). In healthy cycles the weighted sum over all suspects grows by 1 a cycle on
average, however similar their signatures are. So a limit on it is the number of cycles to a false
alarm, except for the overshoot.
"""

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
T = TypeVar("T")

SIZES = np.array([0.5, 1.0, 2.0])  # sizes of a change, in sigmas per cycle
SHARES = np.array([0.32, 0.26, 0.42])  # share of the prior weight of each size
# Power of the cosine by which similar suspects share one weight. When the sum of one is at its
# limit, exp(14), that of its neighbour is at exp(14 cos^2): below 0.9 it hardly contributes.
ALIKE = 10
# The limit over the cycles to a false alarm: sums of normal scores overshoot it (Siegmund).
OVERSHOOT = float(SHARES @ np.exp(-0.583 * SIZES))
# Largest score (sigmas) of a cycle, unless its own figures are out: a misread edge is no change.
MOST = 5.0
STRANGE = 3.5  # sigmas: a larger score is not learned at once, since a change may begin
WAITS = 4  # cycles for which learning then pauses; a large change raises an alarm by then
MOST_WAITING = 20  # cycles after which scores that stay strange without an alarm are learned
# Prior cycles with neither skewness nor correlation; sigmas at which scores are clipped for both.
UNSKEWED, COUNTS = 100.0, 4.0
MOST_CORRELATED = 0.9
SKEWED, LEAST_SKEW = 1.5, 1e-6  # largest skewness; a smaller one counts as none


@dataclass(frozen=True)
class NormalScores:
    """The scores of one cycle after each step of their normalisation; NaN without a score."""

    standard: Floats  # standardised
    unskewed: Floats  # without skewness
    before: Floats  # unskewed scores of the previous cycle
    normal: Floats  # without the correlation with the previous cycle


class ScoreNormalizer:
    """Removes skewness and correlation from the standard scores of healthy cycles.

    Some scores are skewed: a delay moves an edge by more than an advance. Gas and walls keep some
    heat, so a cycle is correlated with the one before. Either makes large sums far more frequent: a
    skewness of 0.6 or a correlation of 0.07 causes several times as many false alarms in a month.
    """

    def __init__(self, suspects: int) -> None:
        self._count, self._cubes, self._products = np.zeros((3, suspects))
        self._before = np.full(suspects, np.nan)

    def take(self, standard: Floats) -> NormalScores:
        """Make the scores of the next cycle normal and independent of those before."""
        unskewed = _unskewed(standard, self._cubes / (self._count + UNSKEWED))
        correlation = self._products / (self._count + UNSKEWED)
        correlation = np.clip(correlation, -MOST_CORRELATED, MOST_CORRELATED)
        carried_over = np.where(np.isfinite(self._before), self._before, 0.0) * correlation
        normal = (unskewed - carried_over) / np.sqrt(1.0 - correlation**2)
        scores = NormalScores(standard, unskewed, self._before, normal)
        self._before = np.where(np.isfinite(unskewed), unskewed, self._before)
        return scores

    def learn(self, scores: NormalScores) -> None:
        """Learn skewness and correlation from a healthy cycle."""
        standard, unskewed, before = (
            np.clip(values, -COUNTS, COUNTS)
            for values in (scores.standard, scores.unskewed, scores.before)
        )
        self._count = self._count + np.isfinite(standard)
        self._cubes = self._cubes + np.nan_to_num(standard**3)
        self._products = self._products + np.nan_to_num(unskewed * before)


def _unskewed(standard: Floats, skewness: Floats) -> Floats:
    """Standard scores of a given skewness as normal values, by a shifted log-normal."""
    skewness = np.clip(skewness, -SKEWED, SKEWED)
    sign, size = np.where(skewness < 0.0, -1.0, 1.0), np.maximum(np.abs(skewness), LEAST_SKEW)
    spread = size / 3.0 * (1.0 - size**2 / 27.0)  # sqrt(exp(s²) − 1), by its series in skewness
    log_sigma = np.sqrt(np.log1p(spread**2))
    growth = np.maximum(1.0 + spread * sign * standard, LEAST_SKEW)
    normal: Floats = sign * (np.log(growth) / log_sigma + 0.5 * log_sigma)
    return normal


class LearningGuard(Generic[T]):
    """Delays the learning of cycles while a change may be beginning."""

    def __init__(self) -> None:
        self._waiting: list[T] = []
        self._cycles = 0  # cycles for which learning still pauses

    def take(self, cycle: T, normal: Floats) -> list[T]:
        """Take a cycle with its standard normal scores; give the cycles to learn now."""
        self._waiting.append(cycle)
        strange = (np.abs(normal) > STRANGE).any()
        self._cycles = WAITS if strange else self._cycles - 1
        if self._cycles > 0 and len(self._waiting) < MOST_WAITING:
            return []
        ready = self._waiting
        self.forget()
        return ready

    def forget(self) -> None:
        """Drop the waiting cycles, because a change had begun."""
        self._waiting, self._cycles = [], 0


class ChangeDetector:
    """Shiryaev-Roberts statistics for each suspect, sign and size.

    ``often`` is the prior weight of each suspect.
    """

    def __init__(self, both_ways: npt.NDArray[np.bool_], often: Floats) -> None:
        self._prior = often
        self._signs = np.stack(
            [np.ones(len(both_ways)), -1.0 * both_ways], axis=1
        )  # 0 for an impossible sign
        self._shift = self._signs[:, :, None] * SIZES
        self._half = 0.5 * self._shift**2
        self.weigh(np.eye(len(both_ways)))
        self.begin()

    def weigh(self, cosines: Floats) -> None:
        """Share the weights by the cosines between signatures; zeros mark an unseen suspect."""
        shares = _weights(self._signs, self._prior, cosines)[:, :, None] * SHARES  # pyright: ignore[reportArgumentType]
        self._weight = np.log(shares + np.finfo(float).tiny)

    def begin(self) -> None:
        """Reset the statistics."""
        self._log = np.full(self._shift.shape, -np.inf)

    def begin_some(self, some: npt.NDArray[np.bool_]) -> None:
        """Reset the statistics of some suspects; of some devices if several are taken at once."""
        self._log[some] = -np.inf

    def take(self, normal: Floats, most: float = MOST) -> None:
        """Take the standard normal scores of a cycle; NaN changes nothing.

        They are (suspects,), or (devices, suspects) for several at once. Each is clipped to
        ``most``.
        """
        counted = np.clip(normal, -most, most)[..., None, None]
        after = np.logaddexp(0.0, self._log) + (self._shift * counted - self._half)
        self._log = np.where(np.isnan(counted), self._log, after)

    @property
    def log_sum(self) -> float:
        """The logarithm of the weighted sum over suspects, signs and sizes."""
        return float(self.log_sums)

    @property
    def log_sums(self) -> Floats:
        """``log_sum`` of each device."""
        sums: Floats = np.logaddexp.reduce(self._log + self._weight, axis=(-3, -2, -1))
        return sums

    def foremost(self) -> tuple[int, int]:
        """The suspect with the largest statistic, and the sign."""
        by_size = np.logaddexp.reduce(self._log + self._weight, axis=2)
        suspect, sign = np.unravel_index(int(np.argmax(by_size)), by_size.shape)
        return int(suspect), 1 - 2 * int(sign)


def _weights(signs: Floats, prior: Floats, suspect_cosines: Floats) -> Floats:
    """Weights of each suspect and sign, together 1: similar suspects share the weight of one.

    So a suspect that is unlike all others is found no later than necessary.
    """
    flat_signs, prior = signs.ravel(), np.repeat(prior, 2)
    cosines = np.kron(suspect_cosines, np.ones((2, 2))) * np.outer(flat_signs, flat_signs)
    shown = np.diag(cosines) > 0.0
    shared = np.maximum(cosines, 0.0) ** ALIKE * prior
    np.fill_diagonal(shared, 1.0)
    weights = np.where(shown, prior / shared.sum(axis=1), 0.0)
    weights /= max(weights.sum(), 1.0)
    result: Floats = weights.reshape(signs.shape)
    return result


def limit(cycles: float) -> float:
    """Limit of ``log_sum`` for one false alarm in so many cycles."""
    return math.log(OVERSHOOT * cycles)


def began(normal: Floats) -> int:
    """Cycles since the change, counted from the last score, by maximum likelihood."""
    sums = np.maximum(np.cumsum(np.nan_to_num(normal[::-1])), 0.0)
    count = np.cumsum(np.isfinite(normal[::-1]))
    gain = sums**2 / np.maximum(count, 1)
    return int(np.argmax(gain)) + 1
