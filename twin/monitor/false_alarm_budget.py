"""How often all that judges healthy cycles may be wrong: one wanted time between false alarms.

Sums over cycles, single cycles and the limits of key figures each have a share of it. What a few
cycles showed of a figure's scatter counts by Student's distribution.
"""

import math

from scipy.special import ndtri, stdtrit

# Of all false alarms. Sums keep what they are given; the others come far below theirs, since a
# figure by itself is judged as if it had the longest tail. More would gain them little.
SUMS, SINGLE_CYCLES, LIMITS = 0.9, 0.05, 0.05
DAY_S = 86_400.0


def cycles_between(days: float, share: float, seconds: float) -> float:
    """Cycles of so many ``seconds`` between the false alarms of one that has a ``share``.

    ``days`` are those between any two.
    """
    return days * DAY_S / share / seconds


def normal_limit(cycles: float, figures: int) -> float:
    """Standard normal value that one of ``figures`` is beyond, either way, once in ``cycles``."""
    return -float(ndtri(0.5 / (cycles * figures)))


def student_limit(cycles: float, figures: int, known: int) -> float:
    """The same one way, in standard deviations and about a mean that ``known`` cycles showed."""
    t = -float(stdtrit(known - 1, 1.0 / (cycles * figures)))
    return t * math.sqrt(1.0 + 1.0 / known)
