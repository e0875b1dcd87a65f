"""Budget of false alarms: one wanted time between them for all judges of healthy cycles.

Sums over cycles, single cycles and the limits of key figures each have a share of it. A scatter
that few cycles showed counts by Student's distribution.
"""

import math

# Shares of all false alarms. Sums use theirs up; the others stay far below, since a single figure
# is judged as if it had the longest tail. A larger share would gain them little.
SUMS, SINGLE_CYCLES, LIMITS = 0.9, 0.05, 0.05
DAY_S = 86_400.0


def cycles_between(days: float, share: float, seconds: float) -> float:
    """Cycles of ``seconds`` between the false alarms of a judge with this ``share``.

    ``days`` are those between any two false alarms.
    """
    return days * DAY_S / share / seconds


def normal_limit(cycles: float, figures: int) -> float:
    """Standard normal value that one of ``figures`` exceeds, two-sided, once in ``cycles``."""
    from scipy.special import ndtri  # noqa: PLC0415 - else each configuration loads SciPy

    return -float(ndtri(0.5 / (cycles * figures)))


def student_limit(cycles: float, figures: int, reference_cycles: int) -> float:
    """One-sided limit in sigmas about the mean, both estimated from ``reference_cycles``."""
    from scipy.special import stdtrit  # noqa: PLC0415 - as above

    t = -float(stdtrit(reference_cycles - 1, 1.0 / (cycles * figures)))
    return t * math.sqrt(1.0 + 1.0 / reference_cycles)
