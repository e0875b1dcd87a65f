"""Gas laws for dry air as an ideal gas, small enough to check against a textbook.

All functions are compiled and take scalars in SI units; pressures are absolute. They have no
branches, so that a loop over hypotheses is vectorised.
"""

from twin.model import air
from twin.model.compiled import inlined

# Its source is plain Python: a configuration uses it, and does not load the compiler.
orifice = inlined(air.orifice)


@inlined
def opening(p: float, ambient: float, critical: float) -> tuple[float, float]:
    """Flow from ambient to ``p`` (Pa) through an opening relative to its sonic flow, and its slope.

    The flow is negative (outwards) while ``p`` is above ambient; the slope is over ``p`` (1/Pa).
    """
    inwards = p <= ambient
    share, slope = orifice(p / ambient if inwards else ambient / p, critical)
    out = share * p / ambient
    steeper = (share - slope * ambient / p) / ambient
    return (share if inwards else -out), (slope / ambient if inwards else -steeper)
