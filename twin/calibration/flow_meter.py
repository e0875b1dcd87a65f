"""The evacuated gas by a flow meter in the suction line, without a model.

The removed mass and the fall of pressure give the volume. The gas cools as it expands and warms up
at the wall, some leaks in, and the meter may be slow. One energy balance of the gas has all of
these as unknowns, and needs no measured temperature.
"""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import nnls

from twin.model.air import GAMMA

BEGUN = 0.1  # share of the fall from which rows are used: open cups have met their part by then
DEEP = 100e2  # Pa: the least fall of pressure
FEWEST_ROWS = 8  # readings of the flow in a suction; they may be one for each block
FEWEST, MOST_APART = 3, 0.1  # suctions, and the spread of their median that is still one volume
PASSES = 15  # iterations of the balance, whose temperatures follow from its result
COLDEST, WARMEST = 0.6, 1.1  # bounds of the gas temperature over the wall's
# Largest rms misfit of a balance, as a share of the fall: with a fast meter, and with a slow one.
# Soft cups exceed it; their volume is not one number.
LEFT, LEFT_IF_SLOW = 0.003, 0.01
SLOWEST = 0.4  # longest lag of the meter, over the time until the lowest pressure

Floats = npt.NDArray[np.float64]
Suction = tuple[Floats, Floats, Floats]  # seconds, pressure (Pa), flow (kg/s), row by row


def stored(suctions: Iterable[Suction]) -> float:
    """Gas (kg) removed per Pa of fall at constant temperature; NaN if it does not show."""
    values = np.array([value for rows in suctions if np.isfinite(value := _stored(*rows))])
    if len(values) < FEWEST:
        return float("nan")
    median = float(np.median(values))
    deviation = float(np.median(np.abs(values - median)))
    return median if deviation < MOST_APART * median else float("nan")


def _stored(seconds: Floats, pressure: Floats, flow: Floats) -> float:
    """Gas per Pa (kg/Pa) from one suction."""
    if len(pressure) < FEWEST_ROWS:
        return float("nan")
    start, depth = pressure[0], pressure[0] - pressure.min()
    begun = np.flatnonzero(pressure <= start - BEGUN * depth)
    if depth < DEEP or len(begun) < FEWEST_ROWS:
        return float("nan")
    rows = slice(int(begun[0]), None)
    columns = seconds[rows], pressure[rows], flow[rows]
    for is_slow, largest_rms in ((False, LEFT), (True, LEFT_IF_SLOW)):
        gas_per_pa, rms = _balance(*columns, float(start), is_slow=is_slow)
        if rms < largest_rms * depth:
            return gas_per_pa
    return float("nan")


def _balance(
    seconds: Floats, pressure: Floats, flow: Floats, start: float, *, is_slow: bool
) -> tuple[float, float]:
    """Gas (kg/Pa) of the best balance, and its misfit (Pa rms).

    dp/dt has three parts: enthalpy that flows out, heat from the wall, and a leak. ``isothermal``
    is the pressure of the gas at the wall's temperature: it falls with the mass alone. A slow
    meter's flow lags by a multiple of its slope.
    """
    since = seconds - seconds[0]
    out = cumulative_trapezoid(flow, since, initial=0)
    temperature_ratio = np.full(len(pressure), (pressure[0] / start) ** (1.0 - 1.0 / GAMMA))
    isothermal_start = pressure[0] / temperature_ratio[0]
    per_kg, misfit, behind = 0.0, np.inf, list[float]()
    for _ in range(PASSES):
        columns = [
            -GAMMA * cumulative_trapezoid(temperature_ratio, out, initial=0),
            GAMMA * since,
            cumulative_trapezoid(1.0 - temperature_ratio, since, initial=0),
        ]
        if is_slow:
            columns.append(-GAMMA * cumulative_trapezoid(temperature_ratio, flow, initial=0))
        balance = np.stack(columns, axis=1)
        scale = np.abs(balance).max(axis=0) + np.finfo(float).tiny
        solution, misfit = nnls(balance / scale, pressure - pressure[0])
        per_kg, leak, _, *behind = solution / scale
        removed = per_kg * out + sum(behind) * (flow - flow[0])
        isothermal = np.maximum(isothermal_start - removed + leak * since, pressure / WARMEST)
        temperature_ratio = np.clip(pressure / isothermal, COLDEST, WARMEST)
    falls = float(since[pressure.argmin()])
    if per_kg <= 0.0 or sum(behind) > SLOWEST * falls * per_kg:
        return float("nan"), np.inf
    return 1.0 / per_kg, misfit / np.sqrt(len(pressure))
