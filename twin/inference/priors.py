"""How often each effect comes, as far as that counts in a probability: live and in a diagnosis."""

import math

import numpy as np
import numpy.typing as npt

from twin.model.effects import Effect

Floats = npt.NDArray[np.float64]

# Exponent of the prior frequencies in a probability: a ratio of a thousand counts as ten, as sites
# differ. Chosen.
PRIOR_TEMPER = 1.0 / 3.0
# bar, one sigma of what a gauge of the supply reads on two days at one pressure: 1 % of the 10 bar
# of digital pressure switches, as their data sheets have it for a temperature range.
GAUGE = 0.1
# Sigmas beyond which a gauge says no more: it is as likely that the gauge is wrong. Chosen.
FARTHEST = 5.0


def tempered(frequency: float) -> float:
    """A prior frequency, over that of wear, as far as it counts in a probability."""
    return math.pow(frequency, PRIOR_TEMPER)


def by_gauge(drop: Floats, read: Floats) -> Floats:
    """Penalty (chi-square) of a lower supply where a gauge reads less by ``read``, both in bar.

    It is that beside an unchanged supply: below zero if the gauge shows the ``drop``, and zero
    if there is no gauge (``read`` is NaN).
    """
    off = np.minimum(np.abs(drop - read) / GAUGE, FARTHEST) ** 2
    unchanged = np.minimum(np.abs(read) / GAUGE, FARTHEST) ** 2
    penalties: Floats = np.nan_to_num(off - unchanged)
    return penalties


def penalty(effect: Effect, size: float, *, ambient_is_measured: bool) -> float:
    """Prior penalty (chi-square) of an effect in ``size`` (in typical ones), beside wear."""
    of_size = size**2 if effect.is_weather else 0.0
    frequency = effect.frequency(ambient_is_measured=ambient_is_measured)
    return of_size - 2.0 * math.log(tempered(frequency))
