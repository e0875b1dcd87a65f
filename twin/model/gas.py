"""Gas laws for dry air as an ideal gas, small enough to check against a textbook.

All functions are compiled and work on scalars in SI units with absolute pressures. They are free of
branches, so that the bank of hypotheses can run them on several at once.
"""

import math

from twin.model.compiled import inlined

R = 287.05  # J/(kg K), specific gas constant of dry air
GAMMA = 1.4  # ratio of specific heats
CP = GAMMA * R / (GAMMA - 1.0)  # J/(kg K)
VISCOSITY = 1.82e-5  # Pa s, of air at 20 °C
CRITICAL_RATIO = 0.528  # ISO 6358 critical pressure ratio of a well rounded opening
LAMINAR_RATIO = 0.999  # above it ISO 6358 flow runs linearly to zero: no infinite slope, no chatter

_STEEP = 1.0 / (1.0 - CRITICAL_RATIO)
_EDGE = (LAMINAR_RATIO - CRITICAL_RATIO) * _STEEP
_LAMINAR_SLOPE = -math.sqrt(1.0 - _EDGE * _EDGE) / (1.0 - LAMINAR_RATIO)


@inlined
def orifice(ratio):  # type: ignore[no-untyped-def]
    """Flow through an opening as a share of its sonic flow, and its slope over ``ratio``.

    ISO 6358-1 with critical ratio 0.528; ``ratio`` is downstream over upstream absolute pressure,
    between 0 and 1.
    """
    below = min(max((ratio - CRITICAL_RATIO) * _STEEP, 0.0), _EDGE)
    share = math.sqrt(1.0 - below * below)
    laminar = ratio > LAMINAR_RATIO
    slope = _LAMINAR_SLOPE if laminar else -_STEEP * below / share
    return (-_LAMINAR_SLOPE * (1.0 - ratio) if laminar else share), slope


@inlined
def opening(p, ambient):  # type: ignore[no-untyped-def]
    """Flow from ambient into ``p`` through an opening, as a share of its sonic flow inwards.

    Negative outwards while ``p`` is above ambient. Also its slope over ``p`` (1/Pa).
    """
    inwards = p <= ambient
    share, slope = orifice(p / ambient if inwards else ambient / p)
    out = share * p / ambient
    steeper = (share - slope * ambient / p) / ambient
    return (share if inwards else -out), (slope / ambient if inwards else -steeper)
