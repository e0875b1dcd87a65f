"""Gas laws for dry air as an ideal gas, small enough to check against a textbook.

All functions are compiled and work on scalars in SI units with absolute pressures.
"""

import math

from twin.model.compiled import compiled

R = 287.05  # J/(kg K), specific gas constant of dry air
GAMMA = 1.4  # ratio of specific heats
CP = GAMMA * R / (GAMMA - 1.0)  # J/(kg K)
CRITICAL_RATIO = 0.528  # ISO 6358 critical pressure ratio of a well rounded opening
LAMINAR_RATIO = 0.999  # above it ISO 6358 flow runs linearly to zero: no infinite slope, no chatter


@compiled
def orifice(ratio: float) -> float:
    """Flow through an opening as a share of its sonic flow (ISO 6358-1, critical ratio 0.528).

    ``ratio`` is downstream over upstream absolute pressure, between 0 and 1.
    """
    if ratio <= CRITICAL_RATIO:
        return 1.0
    if ratio < LAMINAR_RATIO:
        below = (ratio - CRITICAL_RATIO) / (1.0 - CRITICAL_RATIO)
        return math.sqrt(1.0 - below * below)
    edge = (LAMINAR_RATIO - CRITICAL_RATIO) / (1.0 - CRITICAL_RATIO)
    return math.sqrt(1.0 - edge * edge) * (1.0 - ratio) / (1.0 - LAMINAR_RATIO)
