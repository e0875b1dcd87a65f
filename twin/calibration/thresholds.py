"""Readings at which the control decides to switch the nozzle, from when it acts in a record.

The valve acts some milliseconds after the control has decided, and the jet collapses slowly.
Meanwhile the pressure moves on, so it turns beyond the threshold: by 80 mbar on a small gripper.
"""

from dataclasses import replace

import numpy as np

from twin.calibration.cycles import Cycles
from twin.calibration.readings import Readings
from twin.model import theta as c
from twin.model.theta import Theta
from twin.monitor.bins import Floats, Ints


def decided(readings: Readings, cycles: Cycles, theta: Theta) -> Readings:
    """``readings`` with ``off`` and ``on`` where the control decides, for the fitted ``theta``.

    A threshold cannot lie beyond the turn of the pressure that it leads to. A turn that the record
    does not show (NaN) stays unknown. ``on`` is unknown as well if ``cycles`` do not show that the
    nozzle goes on again: waves in a hose turn the pressure, too.
    """
    early, _ = cycles.best_early(theta)
    pressure = cycles.control_pressure(theta, early)
    rows, is_on = cycles.switchings
    rows = rows - early
    off = _before(pressure, rows[~is_on], float(theta[c.RESPONSE_OFF]) / cycles.period)
    on = _before(pressure, rows[is_on], float(theta[c.RESPONSE]) / cycles.period)
    on = float(np.minimum(readings.on, on)) if is_on.any() else np.nan
    return replace(readings, off=float(np.fmax(readings.off, off)), on=on)


def _before(pressure: Floats, rows: Ints, response: float) -> float:
    """Median pressure (Pa) so many rows before each of ``rows``; NaN without any."""
    at = np.interp(rows - response, np.arange(len(pressure)), pressure)
    at = at[np.isfinite(at)]
    return float(np.median(at)) if len(at) else np.nan
