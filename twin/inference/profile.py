"""Intervals by profile likelihood: how far a size can move until the misfit has grown too much.

A normal approximation takes its width from the curvature at the best point, so it is symmetric.
Here the misfit is evaluated on either side, and the other sizes move along (Venzon and Moolgavkar,
"A method for computing profile-likelihood-based confidence intervals", 1988). So an interval may
be asymmetric, and ends at a bound if the data allow that.
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Misfit = Callable[[Floats], Floats]  # chi-square of points (n, sizes)

ROUNDS = 5
NEAR = 0.05  # relative error of the wanted rise at which a search ends
LEAST_TIMES, MOST_TIMES = 0.3, 3.0  # bounds of the factor by which one round changes a distance


def profile_interval(
    misfit: Misfit, x: Floats, covariance: Floats, bounds: tuple[Floats, Floats], rise: float
) -> tuple[Floats, Floats]:
    """Lower and upper end of each size in ``x``, where the misfit has grown by ``rise``.

    The other sizes move along as their ``covariance`` says. Ends are within ``bounds``, low and
    high.
    """
    count = len(x)
    sigmas = np.sqrt(np.diag(covariance))
    directions = np.concatenate(
        [-covariance / sigmas, covariance / sigmas], axis=1
    ).T  # (2 sizes, sizes)
    size_index = np.tile(np.arange(count), 2)
    reach = np.full(2 * count, math.sqrt(rise))
    room = _room(x, directions, size_index, bounds)
    best_misfit = float(misfit(x[None])[0])
    searching = np.ones(2 * count, np.bool_)
    for _ in range(ROUNDS):
        at_bound = reach >= room
        reach = np.minimum(reach, room)
        points = np.clip(x + reach[searching, None] * directions[searching], *bounds)
        rise_reached = np.maximum(misfit(points) - best_misfit, 1e-12)
        factor = np.clip(np.sqrt(rise / rise_reached), LEAST_TIMES, MOST_TIMES)
        active = np.flatnonzero(searching)
        done = (np.abs(rise_reached / rise - 1.0) < NEAR) | (
            at_bound[active] & (rise_reached <= rise)
        )
        reach[active[~done]] *= factor[~done]
        searching[active[done]] = False
        if not searching.any():
            break
    reach = np.minimum(reach, room)
    ends = x[size_index] + reach * directions[np.arange(2 * count), size_index]
    return ends[:count], ends[count:]


def _room(
    x: Floats, directions: Floats, size_index: npt.NDArray[np.int64], bounds: tuple[Floats, Floats]
) -> Floats:
    """Distance to each size's own bound along its direction, in sigmas."""
    step = directions[np.arange(len(size_index)), size_index]
    low, high = bounds
    room = np.where(step > 0.0, high[size_index] - x[size_index], low[size_index] - x[size_index])
    reach: Floats = np.maximum(room / np.where(step == 0.0, 1.0, step), 0.0)
    return reach
