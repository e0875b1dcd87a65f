"""Dry air as an ideal gas: its properties in SI units, and its flow through an opening."""

import math

R = 287.05  # J/(kg K), specific gas constant of dry air
GAMMA = 1.4  # ratio of specific heats
CP = GAMMA * R / (GAMMA - 1.0)  # J/(kg K)
VISCOSITY = 1.82e-5  # Pa s, of air at 20 °C
CRITICAL_RATIO = 0.528  # ISO 6358 critical pressure ratio of a well rounded opening
LAMINAR_RATIO = 0.999  # above it the flow is linear, which avoids an infinite slope at 1
_PER_LAMINAR = 1.0 / (1.0 - LAMINAR_RATIO)


def orifice(ratio: float, critical: float) -> tuple[float, float]:
    """Flow through an opening relative to its sonic flow, and its slope over ``ratio``.

    ISO 6358-1 with the ``critical`` pressure ratio; ``ratio`` is downstream over upstream absolute
    pressure (0 to 1).
    """
    steep = 1.0 / (1.0 - critical)
    below = max((min(ratio, LAMINAR_RATIO) - critical) * steep, 0.0)
    share = math.sqrt(1.0 - below * below)
    laminar = ratio > LAMINAR_RATIO
    slope = -share * _PER_LAMINAR if laminar else -steep * below / share
    return (share * _PER_LAMINAR * (1.0 - ratio) if laminar else share), slope
