"""Covariance over bins of the differences between cycles of a healthy ejector."""

import math
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from twin.inference.whitening import add_independent, fading, low_rank
from twin.model import theta as c
from twin.model.effects import EFFECTS, Parameter
from twin.model.term import AGAIN, KINDS
from twin.model.theta import Theta
from twin.monitor.bins import Bins, Floats, Ints, warped
from twin.monitor.healthy import ModelError
from twin.signals import MS, Phase

# Effects whose sizes scatter from cycle to cycle in a healthy ejector. Delays stand last, as in the
# columns of a diagnosis; the order of the others decides only how sums over them are rounded.
SCATTERING: Mapping[str, Parameter] = dict(
    sorted(
        (
            (effect.name, parameter)
            for effect in EFFECTS.values()
            for parameter in effect.parameters
            if parameter.healthy_sigma > 0.0
        ),
        key=lambda scattering: (scattering[1].is_time, scattering[1].healthy_sigma),
    )
)
# The same: parameter, and sigma unless a better one was learned.
SCATTER: Mapping[str, tuple[str, float]] = {
    name: (parameter.name, parameter.healthy_sigma) for name, parameter in SCATTERING.items()
}
KNEE_MBAR = 0.7  # sigma of the level found at a knee, to which the model is set
FIRST_ERROR = ModelError(after_ms=(0.0,), common_mbar=(2.0,), alone_mbar=(0.5,))  # nothing known
ON_THE_PART_S = 5e-3  # cups that meet the part sooner than this after suction began are on it
SCAN_MS = 1.0  # cycle time of a PLC's fast task
_HOLD = KINDS.index("hold")  # it begins with a knee, as AGAIN does
_ERRORS = ("common_mbar", "alone_mbar")


def least_time_ms(period_ms: float) -> float:
    """One sigma of the time of a command in rows so far apart: it is seen at the next one.

    A PLC reads pressure and commands in one scan, of a millisecond; then its time is known.
    """
    return math.sqrt(max(period_ms**2 - SCAN_MS**2, 0.0) / 12.0)


def comes_on_part(theta: Theta) -> bool:
    """Whether cups meet the part after suction began: when, differs from cycle to cycle."""
    return bool(theta[c.CONTACT] > ON_THE_PART_S)


def by_contact(
    bins: Bins, rows: Ints, kept: Ints, expected: Floats, theta: Theta, period: float
) -> Floats:
    """Changes of the bins ``rows`` (mbar) by a millisecond of the time of contact, (bins, 0 or 1).

    ``expected`` (mbar) is the twin's pressure at the rows ``kept``; rows are ``period`` seconds
    apart. What follows contact comes later as a whole, to first order.
    """
    if not comes_on_part(theta):
        return np.empty((len(rows), 0))
    used = np.flatnonzero(bins.number >= 0)
    first = used[np.searchsorted(bins.number[used], np.arange(len(bins.count)))]
    begin, end = (np.interp(at, kept, expected) for at in (first, first + bins.count))
    slope = (end - begin) / (bins.count * period)  # mbar/s
    after = (bins.kind == Phase.SUCTION) & ((bins.since + bins.count) * period > theta[c.CONTACT])
    later: Floats = -slope * after * MS
    return later[rows, None]


def model_error(
    errors: Mapping[str, ModelError], kind: Ints, time: Floats
) -> tuple[Floats, Floats]:
    """The model's error in bins (mbar): common to all cycles, and differing between them.

    ``kind`` are indices into KINDS; ``time`` is warped time since the stretch began.
    """
    common, alone = np.empty(len(kind)), np.empty(len(kind))
    for number, name in enumerate(KINDS):
        of_kind = kind == number
        if not of_kind.any():
            continue
        error = errors.get(name) or _worst_error(errors)
        knots = _knots(error.after_ms)
        common[of_kind] = np.interp(time[of_kind], knots, error.common_mbar)
        alone[of_kind] = np.interp(time[of_kind], knots, error.alone_mbar)
    return common, alone


@cache
def _knots(after_ms: tuple[float, ...]) -> Floats:
    """The times at which an error is given, warped."""
    return warped(np.array(after_ms) * MS)


def _worst_error(errors: Mapping[str, ModelError]) -> ModelError:
    """The error for a kind of stretch that healthy cycles did not have: the largest of others."""
    if not errors:
        return FIRST_ERROR
    worst = [max(max(getattr(error, key)) for error in errors.values()) for key in _ERRORS]
    return ModelError(after_ms=(0.0,), common_mbar=(worst[0],), alone_mbar=(worst[1],))


def lasting(bins: Bins, rows: Ints, alone: Floats) -> Floats:
    """Covariance (mbar²) between the bins ``rows`` of errors that persist for a while.

    These are the model's error of each cycle, ``alone`` (mbar), and that of the level at a knee.
    """
    stretch, kind, time = bins.stretch[rows], bins.kind[rows], bins.time[rows]
    knee = KNEE_MBAR * ((kind == _HOLD) | (kind == AGAIN))
    return fading(alone, time, stretch) + low_rank(knee[:, None], stretch)


class Reading(NamedTuple):
    """What readings are off by (mbar, one sigma)."""

    noise: float  # of a row
    rounding: float = 0.0  # of all readings of a stretch at one pressure


def from_cycle_to_cycle(
    bins: Bins,
    rows: Ints,
    persistent: Floats,
    moves: Floats,
    reading: Reading,
    leftover: float,
) -> Floats:
    """Covariance (mbar²) between the bins ``rows`` of all differences between cycles.

    Errors of ``reading``, ``persistent`` errors (see ``lasting``), and scatter: ``moves`` are the
    changes (mbar) of each bin by one sigma of each thing that scatters, (bins, scatters). They are
    scaled to the ``leftover`` (sigmas) that healthy cycles have. Noise is measured: it may grow
    with that, and does not shrink. Rounding is known; healthy cycles may hardly show it.
    """
    covariance = (low_rank(moves, bins.cycle[rows]) + persistent) * leftover**2
    if reading.rounding > 0.0:
        covariance += low_rank(np.full((len(rows), 1), reading.rounding), bins.stretch[rows])
    add_independent(covariance, (reading.noise * max(leftover, 1.0)) ** 2 / bins.count[rows])
    return covariance
