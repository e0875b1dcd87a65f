"""When something began to differ: sums over cycles that reach what no single cycle shows.

Scores come in, one for each suspect and cycle. They are made standard normal by what was seen
before (Hawkins' self-starting way), so that no table of healthy means has to be exact. Then, for
each suspect, sign and size, the likelihood ratio of "it began at cycle t" to "nothing did" is
summed over all t (Shiryaev and Roberts). In healthy cycles the weighted sum over all suspects grows
by 1 a cycle on average, however alike their signatures are: a limit on it is the number of cycles
to a false alarm, but for the overshoot.
"""

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri, stdtr

Floats = npt.NDArray[np.float64]
T = TypeVar("T")

SIZES = np.array([0.5, 1.0, 2.0])  # sigmas a cycle that a change is looked for in
SHARES = np.array([0.32, 0.26, 0.42])  # of the weight, of each size
# Power of the cosine by which suspects that look alike share one weight. When the sum of one is at
# its limit, exp(14), that of its neighbour is at exp(14 cos^2): below 0.9 it hardly helps.
ALIKE = 10
# The limit over the cycles to a false alarm: sums of normal scores jump over it (Siegmund).
OVERSHOOT = float(SHARES @ np.exp(-0.583 * SIZES))
# Sigmas that a cycle counts for at most, unless its own figures are out: an edge that was misread
# is no change.
MOST = 5.0
STRANGE = 3.5  # sigmas of a score, from which on it is not learned at once: a change may begin
WAITS = 4  # cycles for which nothing is learned then; the sums alarm by that time if it is great
MOST_WAITING = 20  # cycles: what is strange again and again without an alarm is usual
FARTHEST = 30.0  # sigmas; beyond, a probability is no number any more
# As if so many cycles had shown scores that are neither skewed nor alike from cycle to cycle; and
# sigmas up to which a score counts for that.
UNSKEWED, COUNTS = 100.0, 4.0
SKEWED, LEAST_SKEW = 1.5, 1e-6  # at most; less is none


@dataclass
class Reference:
    """What scores were in the cycles so far: their number, means and sums of squares about them.

    NaN is the score of a suspect that a cycle does not show.
    """

    count: Floats
    mean: Floats
    squares: Floats

    @classmethod
    def of(cls, suspects: int) -> "Reference":
        """Nothing seen yet."""
        return cls(np.zeros(suspects), np.zeros(suspects), np.zeros(suspects))

    def standard(self, scores: Floats) -> Floats:
        """Scores as standard normal variables, if they come from where those before came from.

        NaN also while too few are known.
        """
        known = (self.count >= 2.0) & (self.squares > 0.0)
        count = np.where(known, self.count, 2.0)
        variance = np.where(known, self.squares, 1.0) / (count - 1.0) * (1.0 + 1.0 / count)
        normal = as_normal((scores - self.mean) / np.sqrt(variance), count - 1.0)
        result: Floats = np.where(known, normal, np.nan)
        return result

    def add(self, scores: Floats) -> None:
        """Take a cycle in (Welford's way)."""
        shown = np.isfinite(scores)
        self.count = self.count + shown
        off = np.where(shown, scores - self.mean, 0.0)
        self.mean = self.mean + off / np.maximum(self.count, 1.0)
        self.squares = self.squares + np.where(shown, off * (scores - self.mean), 0.0)


@dataclass(frozen=True)
class NormalScores:
    """The scores of one cycle, and what they were made normal from."""

    standard: Floats  # NaN where there is no score, as in all of these
    unskewed: Floats  # the same, not skewed any more
    before: Floats  # that of the cycle before
    normal: Floats  # less what it has in common with that


class ScoreNormalizer:
    """How standard scores of healthy cycles differ from independent normal ones.

    Some are skewed: what is late moves an edge by more than what is early. And gas and walls keep
    some heat, so that a cycle is like the one before. Either makes far sums far more frequent: a
    skewness of 0.6 or a correlation of 0.07 makes several times as many false alarms in a month.
    """

    def __init__(self, suspects: int) -> None:
        self._count, self._cubes, self._products = np.zeros((3, suspects))
        self._before = np.full(suspects, np.nan)

    def take(self, standard: Floats) -> NormalScores:
        """Make the scores of the next cycle normal and independent of those before."""
        unskewed = _unskewed(standard, self._cubes / (self._count + UNSKEWED))
        alike = self._products / (self._count + UNSKEWED)
        goes_on = np.where(np.isfinite(self._before), self._before, 0.0) * alike
        normal = (unskewed - goes_on) / np.sqrt(1.0 - alike**2)
        scores = NormalScores(standard, unskewed, self._before, normal)
        self._before = np.where(np.isfinite(unskewed), unskewed, self._before)
        return scores

    def learn(self, scores: NormalScores) -> None:
        """Take a healthy cycle in."""
        standard, unskewed, before = (
            np.clip(one, -COUNTS, COUNTS)
            for one in (scores.standard, scores.unskewed, scores.before)
        )
        self._count = self._count + np.isfinite(standard)
        self._cubes = self._cubes + np.nan_to_num(standard**3)
        self._products = self._products + np.nan_to_num(unskewed * before)


def _unskewed(standard: Floats, skewness: Floats) -> Floats:
    """Standard scores of such a skewness as normal ones, as if they were log-normal."""
    skewness = np.clip(skewness, -SKEWED, SKEWED)
    sign, size = np.where(skewness < 0.0, -1.0, 1.0), np.maximum(np.abs(skewness), LEAST_SKEW)
    spread = size / 3.0 * (1.0 - size**2 / 27.0)  # sqrt(exp(s²) − 1), by its series in skewness
    log_sigma = np.sqrt(np.log1p(spread**2))
    rises = np.maximum(1.0 + spread * sign * standard, LEAST_SKEW)
    found: Floats = sign * (np.log(rises) / log_sigma + 0.5 * log_sigma)
    return found


def as_normal(t: Floats, freedom: Floats) -> Floats:
    """Student's t as the standard normal value that is as improbable; NaN stays."""
    result: Floats = -np.sign(t) * np.maximum(ndtri(stdtr(freedom, -np.abs(t))), -FARTHEST)
    return result


class LearningGuard(Generic[T]):
    """Keeps cycles from being learned as usual while a change may be beginning."""

    def __init__(self) -> None:
        self._waiting: list[T] = []
        self._cycles = 0  # for which they wait still

    def take(self, cycle: T, normal: Floats) -> list[T]:
        """Take a cycle with its standard normal scores; give those to be learned now."""
        self._waiting.append(cycle)
        strange = (np.abs(normal) > STRANGE).any()
        self._cycles = WAITS if strange else self._cycles - 1
        if self._cycles > 0 and len(self._waiting) < MOST_WAITING:
            return []
        ready = self._waiting
        self.forget()
        return ready

    def forget(self) -> None:
        """Learn none of those that wait: a change had begun."""
        self._waiting, self._cycles = [], 0


class ChangeDetector:
    """Sums of likelihood ratios, for each suspect, sign and size.

    ``often`` is how frequent each suspect is thought to be beside the others.
    """

    def __init__(self, both_ways: npt.NDArray[np.bool_], often: Floats) -> None:
        self._often = often
        self._signs = np.stack([np.ones(len(both_ways)), -1.0 * both_ways], axis=1)  # 0: not so
        self._shift = self._signs[:, :, None] * SIZES
        self._half = 0.5 * self._shift**2
        self.weigh(np.eye(len(both_ways)))
        self.begin()

    def weigh(self, alike: Floats) -> None:
        """Share the weight by the cosines between signatures; 0 with all: it is not shown."""
        shares = _weights(self._signs, self._often, alike)[:, :, None] * SHARES
        self._weight = np.log(shares + np.finfo(float).tiny)

    def begin(self) -> None:
        """Forget everything."""
        self._log = np.full(self._shift.shape, -np.inf)

    def begin_some(self, which: npt.NDArray[np.bool_]) -> None:
        """Forget everything of some devices, where scores of several are taken at once."""
        self._log[which] = -np.inf

    def take(self, normal: Floats, most: float = MOST) -> None:
        """Take the standard normal scores of a cycle; where there is none (NaN) all stays.

        They are (suspects,), or (devices, suspects) for several at once. None counts for more than
        ``most``.
        """
        counted = np.clip(normal, -most, most)[..., None, None]
        after = np.logaddexp(0.0, self._log) + (self._shift * counted - self._half)
        self._log = np.where(np.isnan(counted), self._log, after)

    @property
    def log_sum(self) -> float:
        """The logarithm of the weighted sum over all of them."""
        return float(self.log_sums)

    @property
    def log_sums(self) -> Floats:
        """The same of each device."""
        found: Floats = np.logaddexp.reduce(self._log + self._weight, axis=(-3, -2, -1))
        return found

    def foremost(self) -> tuple[int, int]:
        """The suspect for which it is greatest, and the sign."""
        by_size = np.logaddexp.reduce(self._log + self._weight, axis=2)
        suspect, sign = np.unravel_index(int(np.argmax(by_size)), by_size.shape)
        return int(suspect), 1 - 2 * int(sign)


def _weights(signs: Floats, often: Floats, alike: Floats) -> Floats:
    """Of each suspect and sign, together 1: what is unlike all others weighs as much as any group.

    So what is found late is found no later than it must be.
    """
    ways, often = signs.ravel(), np.repeat(often, 2)
    cosines = np.kron(alike, np.ones((2, 2))) * np.outer(ways, ways)
    shown = np.diag(cosines) > 0.0
    shared = np.maximum(cosines, 0.0) ** ALIKE * often
    np.fill_diagonal(shared, 1.0)
    weights = np.where(shown, often / shared.sum(axis=1), 0.0)
    weights /= max(weights.sum(), 1.0)
    result: Floats = weights.reshape(signs.shape)
    return result


def limit(cycles: float) -> float:
    """What the logarithm of the sum is compared with, for a false alarm in so many cycles."""
    return math.log(OVERSHOOT * cycles)


def began(normal: Floats) -> int:
    """How many of the last scores are above zero, by the likelihood of when it began."""
    sums = np.maximum(np.cumsum(np.nan_to_num(normal[::-1])), 0.0)
    count = np.cumsum(np.isfinite(normal[::-1]))
    gain = sums**2 / np.maximum(count, 1)
    return int(np.argmax(gain)) + 1
