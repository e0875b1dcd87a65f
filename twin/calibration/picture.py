"""The picture of a fit: a typical cycle, measured and fitted, and the deviation below."""

import numpy as np

from twin.diagnosis.curves import Expected, draw_curves
from twin.diagnosis.drawing import Picture, empty
from twin.languages.texts import tr
from twin.live import Twin
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.monitor.cycles import Cycle, whole
from twin.signals import MBAR, MS, NS, Samples


def draw_fit(data: DataSet, samples: Samples) -> Picture:
    """Draw the cycle of ``samples`` whose deviation is the median of all."""
    cycle = _typical(data, samples)
    ambient = float(coefficients(data)[c.AMBIENT])
    ms = (cycle.samples["time_ns"] - cycle.samples["time_ns"][0]) * (NS / MS)
    measured, fitted = (
        (ambient - pressure.astype(np.float64)) / MBAR
        for pressure in (cycle.samples["pressure"], cycle.ticks["expected"])
    )
    alt = tr("Vacuum of one cycle, measured and fitted, and the deviation below it")
    with empty("fit", 5.0, alt) as picture:
        expected = [Expected(fitted, tr("fitted"))]
        below = draw_curves(picture, ms, measured, expected, cycle.ticks["phase"])
        below.set_xlabel(tr("time since the suction edge (ms)"))
    return picture


def _typical(data: DataSet, samples: Samples) -> Cycle:
    """The cycle with the median deviation."""
    cycles = [cycle for cycle in whole(Twin.of(data).over([samples])) if cycle.settled]
    cycles.sort(key=lambda cycle: float(np.nanmean(cycle.off**2)))
    return cycles[len(cycles) // 2]
