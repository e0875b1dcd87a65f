"""How often each effect comes, as far as that counts in a probability: live and in a diagnosis."""

import math

from twin.model.effects import Effect

# Exponent of the prior frequencies in a probability: a ratio of a thousand counts as ten, as sites
# differ. Chosen.
PRIOR_TEMPER = 1.0 / 3.0


def tempered(frequency: float) -> float:
    """A prior frequency, over that of wear, as far as it counts in a probability."""
    return math.pow(frequency, PRIOR_TEMPER)


def penalty(effect: Effect, size: float, *, ambient_is_measured: bool) -> float:
    """Prior penalty (chi-square) of an effect in ``size`` (in typical ones), beside wear."""
    of_size = size**2 if effect.is_weather else 0.0
    frequency = effect.frequency(ambient_is_measured=ambient_is_measured)
    return of_size - 2.0 * math.log(tempered(frequency))
