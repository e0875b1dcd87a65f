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
# By effect: the parameter that scatters, and its sigma unless a better one was learned.
SCATTER: Mapping[str, tuple[str, float]] = {
    name: (parameter.name, parameter.healthy_sigma) for name, parameter in SCATTERING.items()
}
BREAK_LEVEL_MBAR = 0.7  # sigma of the level at a breakpoint, to which the model is set
FIRST_ERROR = ModelError(after_ms=(0.0,), common_mbar=(2.0,), alone_mbar=(0.5,))  # not learned
ON_THE_PART_S = 5e-3  # s after suction began: cups that meet the part sooner were on it before
SCAN_MS = 1.0  # cycle time of a PLC's fast task
_HOLD = KINDS.index("hold")  # begins with a breakpoint, as AGAIN does
_ERRORS = ("common_mbar", "alone_mbar")


def least_time_ms(period_ms: float) -> float:
    """One sigma (ms) of a command's time: a change shows only at the next row.

    ``period_ms`` is the time from row to row. A PLC reads pressure and commands in one scan of a
    millisecond; then the time is exact.
    """
    return math.sqrt(max(period_ms**2 - SCAN_MS**2, 0.0) / 12.0)


def comes_on_part(theta: Theta) -> bool:
    """Whether the cups meet the part only after suction began, at a time that scatters."""
    return bool(theta[c.CONTACT] > ON_THE_PART_S)


def by_contact(
    bins: Bins, rows: Ints, kept: Ints, expected: Floats, theta: Theta, period: float
) -> Floats:
    """Response (mbar) of the bins ``rows`` to a contact 1 ms later, (bins, 0 or 1).

    ``expected`` (mbar) is the twin's pressure at the rows ``kept``; rows are ``period`` seconds
    apart. To first order, the curve after contact shifts as a whole.
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
    """Two errors of the model in bins (mbar): common to all cycles, and of each cycle alone.

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
    """Warped times of the knots of an error."""
    return warped(np.array(after_ms) * MS)


def _worst_error(errors: Mapping[str, ModelError]) -> ModelError:
    """Error for a kind of stretch that no healthy cycle had: the largest of the other kinds."""
    if not errors:
        return FIRST_ERROR
    worst = [max(max(getattr(error, key)) for error in errors.values()) for key in _ERRORS]
    return ModelError(after_ms=(0.0,), common_mbar=(worst[0],), alone_mbar=(worst[1],))


def lasting(bins: Bins, rows: Ints, alone: Floats) -> Floats:
    """Covariance (mbar²) between the bins ``rows`` of errors that persist for a while.

    These are the model's error of each cycle, ``alone`` (mbar), and that of a breakpoint's level.
    """
    stretch, kind, time = bins.stretch[rows], bins.kind[rows], bins.time[rows]
    level_error = BREAK_LEVEL_MBAR * ((kind == _HOLD) | (kind == AGAIN))
    return fading(alone, time, stretch) + low_rank(level_error[:, None], stretch)


class Reading(NamedTuple):
    """Errors of readings (mbar, one sigma)."""

    noise: float  # mbar, of a single row
    rounding: float = 0.0  # mbar, common to all readings of a stretch at one pressure


def from_cycle_to_cycle(
    bins: Bins,
    rows: Ints,
    persistent: Floats,
    moves: Floats,
    reading: Reading,
    leftover: float,
) -> Floats:
    """Covariance (mbar²) between the bins ``rows`` of all differences between cycles.

    It sums errors of ``reading``, ``persistent`` errors (see ``lasting``) and scatter. ``moves``
    is the response (mbar) of each bin to one sigma of each scattering quantity, (bins,
    quantities). The sum is scaled by ``leftover``, the reduced chi of healthy cycles. Noise is
    measured: that factor may enlarge it and does not reduce it. Rounding is known, and healthy
    cycles may hardly show it: it is not scaled.
    """
    covariance = (low_rank(moves, bins.cycle[rows]) + persistent) * leftover**2
    if reading.rounding > 0.0:
        covariance += low_rank(np.full((len(rows), 1), reading.rounding), bins.stretch[rows])
    add_independent(covariance, (reading.noise * max(leftover, 1.0)) ** 2 / bins.count[rows])
    return covariance
