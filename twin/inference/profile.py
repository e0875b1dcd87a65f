"""Intervals by profile likelihood: how far a size may go until the misfit has grown too much.

A normal approximation takes its width from the curvature at the best point and is as wide on both
sides. Here the misfit is asked on either side, the other sizes moving along (Venzon and Moolgavkar,
"A method for computing profile-likelihood-based confidence intervals", 1988), so an interval may be
lopsided and ends at a bound where the data allow that.
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Misfit = Callable[[Floats], Floats]  # chi-square of points (n, sizes)

ROUNDS = 5
NEAR = 0.05  # of the rise that is looked for
LEAST_TIMES, MOST_TIMES = 0.3, 3.0  # as far as before, in one round


def profile_interval(
    misfit: Misfit, x: Floats, covariance: Floats, bounds: tuple[Floats, Floats], rise: float
) -> tuple[Floats, Floats]:
    """Lower and upper end of each size in ``x``, where the misfit has grown by ``rise``.

    The other sizes go along as ``covariance`` (of the sizes) says: what one takes away another
    adds. Ends are within ``bounds``, low and high.
    """
    count = len(x)
    sigmas = np.sqrt(np.diag(covariance))
    ways = np.concatenate([-covariance / sigmas, covariance / sigmas], axis=1).T  # (2 sizes, sizes)
    own = np.tile(np.arange(count), 2)
    reach = np.full(2 * count, math.sqrt(rise))
    room = _room(x, ways, own, bounds)
    least = float(misfit(x[None])[0])
    going = np.ones(2 * count, np.bool_)
    for _ in range(ROUNDS):
        at_bound = reach >= room
        reach = np.minimum(reach, room)
        points = np.clip(x + reach[going, None] * ways[going], *bounds)
        grown = np.maximum(misfit(points) - least, 1e-12)
        times = np.clip(np.sqrt(rise / grown), LEAST_TIMES, MOST_TIMES)
        here = np.flatnonzero(going)
        done = (np.abs(grown / rise - 1.0) < NEAR) | (at_bound[here] & (grown <= rise))
        reach[here[~done]] *= times[~done]
        going[here[done]] = False
        if not going.any():
            break
    reach = np.minimum(reach, room)
    ends = x[own] + reach * ways[np.arange(2 * count), own]
    return ends[:count], ends[count:]


def _room(
    x: Floats, ways: Floats, own: npt.NDArray[np.int64], bounds: tuple[Floats, Floats]
) -> Floats:
    """How far each size itself can go on its way until a bound, in sigmas."""
    step = ways[np.arange(len(own)), own]
    low, high = bounds
    room = np.where(step > 0.0, high[own] - x[own], low[own] - x[own])
    reach: Floats = np.maximum(room / np.where(step == 0.0, 1.0, step), 0.0)
    return reach
