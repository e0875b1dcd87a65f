"""What differs from cycle to cycle in a healthy ejector, as a covariance over bins."""

from collections.abc import Mapping
from functools import cache

import numpy as np

from twin.inference.covariance import add_independent, fading, low_rank
from twin.model.term import AGAIN, KINDS
from twin.monitor.bins import Bins, Floats, Ints, warped
from twin.monitor.healthy import ModelError
from twin.signals import MS

# What differs from cycle to cycle in a healthy ejector: effect, parameter, one standard deviation
# where nothing better was learned.
SCATTER: Mapping[str, tuple[str, float]] = {
    "supply_pressure_drop": ("drop", 0.02),
    "leakage": ("sonic_flow", 0.03),
    "response_delay": ("delay", 0.5),
    "blow_off_delay": ("delay", 0.5),
}
KNEE_MBAR = 0.7  # the level at a knee is not found better, and the model is set onto it
FIRST_ERROR = ModelError(after_ms=(0.0,), common_mbar=(2.0,), alone_mbar=(0.5,))  # nothing known
_HOLD = KINDS.index("hold")  # it begins with a knee, as AGAIN does
_ERRORS = ("common_mbar", "alone_mbar")


def model_error(known: Mapping[str, ModelError], kind: Ints, time: Floats) -> tuple[Floats, Floats]:
    """The model's error in bins (mbar): in all cycles alike, and from cycle to cycle.

    ``kind`` are indices into KINDS, ``time`` is warped, since a stretch began.
    """
    common, alone = np.empty(len(kind)), np.empty(len(kind))
    for number, name in enumerate(KINDS):
        here = kind == number
        if not here.any():
            continue
        error = known.get(name) or _like(known)
        knots = _knots(error.after_ms)
        common[here] = np.interp(time[here], knots, error.common_mbar)
        alone[here] = np.interp(time[here], knots, error.alone_mbar)
    return common, alone


@cache
def _knots(after_ms: tuple[float, ...]) -> Floats:
    """The times at which an error is known, warped."""
    return warped(np.array(after_ms) * MS)


def _like(known: Mapping[str, ModelError]) -> ModelError:
    """The error of a kind of stretch that healthy cycles did not have: the worst of the others."""
    if not known:
        return FIRST_ERROR
    worst = [max(max(getattr(one, key)) for one in known.values()) for key in _ERRORS]
    return ModelError(after_ms=(0.0,), common_mbar=(worst[0],), alone_mbar=(worst[1],))


def lasting(bins: Bins, here: Ints, alone: Floats) -> Floats:
    """Covariance (mbar²) between the bins ``here`` of what goes on for a while.

    The model's error from cycle to cycle, ``alone`` (mbar) in each, and the level found at a knee.
    """
    stretch, kind, time = bins.stretch[here], bins.kind[here], bins.time[here]
    knee = KNEE_MBAR * ((kind == _HOLD) | (kind == AGAIN))
    return fading(alone, time, stretch) + low_rank(knee[:, None], stretch)


def from_cycle_to_cycle(
    bins: Bins, here: Ints, goes_on: Floats, moves: Floats, noise: float
) -> Floats:
    """Covariance (mbar²) between the bins ``here`` of what is not the same in all cycles.

    Noise (mbar, of a row), what ``goes_on`` for a while (see ``lasting``), and what scatters: by
    how much (mbar) each bin ``moves`` with one sigma of it, (bins, scatters).
    """
    covariance = low_rank(moves, bins.cycle[here]) + goes_on
    add_independent(covariance, noise**2 / bins.count[here])
    return covariance
