"""What a flow meter in the suction line says of the gas that is evacuated, without a model.

What it carries off and what the pressure loses give the volume. The gas cools as it expands and
warms up at the wall, some leaks in, and the meter may be slow: that is one energy balance of the
gas, in which all of these are unknown and none needs a temperature.
"""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import nnls

from twin.model.gas import GAMMA

BEGUN = 0.1  # of the way down, from which on it is looked at: open cups have met their part by then
DEEP = 100e2  # Pa, that the pressure falls by at least
FEWEST_ROWS = 8  # readings of the flow in a suction; they may be one for each block
FEWEST, MOST_APART = 3, 0.1  # suctions, and the spread of their median that is still one volume
PASSES = 15  # over the balance, whose temperatures follow from its result
COLDEST, WARMEST = 0.6, 1.1  # of the wall's temperature
# Of the way down, rms, that a balance may leave: at once, or with a meter that is slow. Soft cups
# leave more than that; their volume is not one number.
LEFT, LEFT_IF_SLOW = 0.003, 0.01
SLOWEST = 0.4  # of the time until the pressure is lowest; a slower meter tells too much

Floats = npt.NDArray[np.float64]
Suction = tuple[Floats, Floats, Floats]  # seconds, pressure (Pa), flow (kg/s), row by row


def stored(suctions: Iterable[Suction]) -> float:
    """Gas (kg) for each Pa that it loses at constant temperature; NaN where that is not shown."""
    found = np.array([one for rows in suctions if np.isfinite(one := _stored(*rows))])
    if len(found) < FEWEST:
        return float("nan")
    middle = float(np.median(found))
    apart = float(np.median(np.abs(found - middle)))
    return middle if apart < MOST_APART * middle else float("nan")


def _stored(seconds: Floats, pressure: Floats, flow: Floats) -> float:
    """The same from one suction."""
    if len(pressure) < FEWEST_ROWS:
        return float("nan")
    before, way = pressure[0], pressure[0] - pressure.min()
    begun = np.flatnonzero(pressure <= before - BEGUN * way)
    if way < DEEP or len(begun) < FEWEST_ROWS:
        return float("nan")
    rows = slice(int(begun[0]), None)
    gas = seconds[rows], pressure[rows], flow[rows]
    for is_slow, most in ((False, LEFT), (True, LEFT_IF_SLOW)):
        found, left = _balance(*gas, float(before), is_slow=is_slow)
        if left < most * way:
            return found
    return float("nan")


def _balance(
    seconds: Floats, pressure: Floats, flow: Floats, before: float, *, is_slow: bool
) -> tuple[float, float]:
    """Gas (kg/Pa) that balances best, and what it leaves (Pa rms).

    dp/dt is in proportion to the enthalpy that flows out, to what the gas is colder than the wall,
    and to a leak. ``still`` is the pressure that the gas would have were it as warm as the wall: it
    falls with the mass alone. A slow meter's flow is behind by so much of its slope.
    """
    since = seconds - seconds[0]
    out = cumulative_trapezoid(flow, since, initial=0)
    warm = np.full(len(pressure), (pressure[0] / before) ** (1.0 - 1.0 / GAMMA))
    still = pressure[0] / warm[0]
    per_kg, left, behind = 0.0, np.inf, list[float]()
    for _ in range(PASSES):
        columns = [
            -GAMMA * cumulative_trapezoid(warm, out, initial=0),
            GAMMA * since,
            cumulative_trapezoid(1.0 - warm, since, initial=0),
        ]
        if is_slow:
            columns.append(-GAMMA * cumulative_trapezoid(warm, flow, initial=0))
        balance = np.stack(columns, axis=1)
        scale = np.abs(balance).max(axis=0) + np.finfo(float).tiny
        found, left = nnls(balance / scale, pressure - pressure[0])
        per_kg, leak, _, *behind = found / scale
        gone = per_kg * out + sum(behind) * (flow - flow[0])
        kept = np.maximum(still - gone + leak * since, pressure / WARMEST)
        warm = np.clip(pressure / kept, COLDEST, WARMEST)
    falls = float(since[pressure.argmin()])
    if per_kg <= 0.0 or sum(behind) > SLOWEST * falls * per_kg:
        return float("nan"), np.inf
    return 1.0 / per_kg, left / np.sqrt(len(pressure))
