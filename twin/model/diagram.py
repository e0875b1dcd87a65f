"""A measured characteristic diagram, reduced to the shape the kernel runs on.

The diagram is suction capacity over vacuum and operating pressure, as makers print it. The model
has it as one curve over the way from end pressure to ambient, a capacity that peaks at the optimum
operating pressure, and an end pressure that rises as operating pressure falls.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from twin.errors import ConfigError

WORST = 0.1  # of the largest capacity; a diagram that is met no better is not that of an ejector
_KEYS = (
    ("ejector", "suction_capacity_sl_min"),
    ("ejector", "end_pressure_mbar"),
    ("ejector", "bulge"),
    ("ejector", "skew"),
    ("ejector", "bend_2"),
    ("ejector", "bend_3"),
    ("supply", "optimum_bar"),
    ("supply", "curvature"),
    ("supply", "end_pressure_slope"),
)

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Reduced:
    """What the model keeps of a diagram, and by how much that misses it."""

    tables: dict[str, dict[str, float]]  # as [data] has them, in the field's units
    rms: float  # sl/min
    worst: float  # sl/min


def reduce(vacuum: Floats, supply: Floats, flow: Floats, nominal: float, ambient: float) -> Reduced:
    """Reduce a diagram: vacuum (n) in mbar, supply (m) in bar gauge, capacity (m, n) in sl/min.

    ``nominal`` is the operating pressure (bar) at which capacity and end pressure are given,
    ``ambient`` (mbar) what it was measured at. With one operating pressure only, how they follow it
    is not known and left out. ConfigError if the model cannot follow the diagram.
    """
    top = float(flow.max())
    nearness = 1.0 / (1.0 + (supply - nominal) ** 2)[:, None]  # where it works counts most

    def missed(x: Floats) -> Floats:
        return capacity(x, vacuum, supply, nominal, ambient) - flow

    def residual(x: Floats) -> Floats:
        return np.concatenate([(missed(x) * nearness).ravel() / top, 1e-3 * x[2:6]])

    start = np.array([top, 150.0, 0.3, 0.0, 0.0, 0.0, float(supply[flow[:, 0].argmax()]), 0.5, 0.1])
    low = [0.1 * top, 1.0, -0.9, -5.0, -10.0, -10.0, 0.1, 0.0, 0.0]
    high = [3.0 * top, 0.97 * ambient, 3.0, 5.0, 10.0, 10.0, 10.0, 20.0, 5.0]
    fit = scipy.optimize.least_squares  # imported with its first use: few data sets have diagrams
    found = fit(residual, np.clip(start, low, high), bounds=(low, high), x_scale="jac")
    off = np.abs(missed(found.x))
    if off.max() > WORST * top:
        raise ConfigError(
            f"the characteristic diagram is missed by up to {off.max():.3g} sl/min",
            "check its rows: one peak over operating pressure, and capacity that falls with vacuum",
        )
    known = len(_KEYS) if len(supply) > 1 else 6
    tables: dict[str, dict[str, float]] = {}
    for (table, key), value in zip(_KEYS[:known], found.x, strict=False):
        tables.setdefault(table, {})[key] = float(value)
    return Reduced(tables, float(np.sqrt(np.mean(off**2))), float(off.max()))


def capacity(x: Floats, vacuum: Floats, supply: Floats, nominal: float, ambient: float) -> Floats:
    """Suction capacity (m, n) in sl/min as the model has it, from values in the order of _KEYS."""
    most, end, bulge, skew, bend_2, bend_3, optimum, curvature, slope = (float(one) for one in x)
    peak = np.maximum(1.0 - curvature * (supply / optimum - 1.0) ** 2, 0.0)
    at_nominal = max(1.0 - curvature * (nominal / optimum - 1.0) ** 2, 1e-3)
    ends = np.clip(end * (1.0 + slope * (nominal - supply)), 0.0, 0.98 * ambient)[:, None]
    way = np.clip((ambient - vacuum - ends) / (ambient - ends), 0.0, 1.0)
    bend = bulge + way * (skew + way * (bend_2 + way * bend_3))
    share: Floats = np.maximum(way * (1.0 + (1.0 - way) * bend), 0.0)
    found: Floats = most * (peak / at_nominal)[:, None] * share
    return found
