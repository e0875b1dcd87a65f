"""A measured characteristic diagram, reduced to the shape the kernel runs on.

The diagram is suction capacity over vacuum and operating pressure, as makers print it. The model
describes it by one curve from end pressure to ambient, a capacity that peaks at the optimum
operating pressure, and an end pressure that rises as operating pressure falls.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from twin.errors import ConfigError

WORST = 0.1  # of the largest capacity; a diagram with a larger error is not that of an ejector
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
    """The values of the model for a diagram, and their errors."""

    tables: dict[str, dict[str, float]]  # as [data] has them, in the field's units
    rms: float  # sl/min
    worst: float  # sl/min


def reduce(vacuum: Floats, supply: Floats, flow: Floats, nominal: float, ambient: float) -> Reduced:
    """Reduce a diagram: vacuum (n) in mbar, supply (m) in bar gauge, capacity (m, n) in sl/min.

    ``nominal`` is the operating pressure (bar) of the nominal capacity and end pressure,
    ``ambient`` (mbar) the ambient pressure of the measurement. With only one operating pressure,
    the result does not contain how capacity and end pressure depend on it. ConfigError if the model
    cannot fit the diagram.
    """
    top = float(flow.max())
    nearness = (
        1.0 / (1.0 + (supply - nominal) ** 2)[:, None]
    )  # the weight is largest at the nominal pressure

    def miss(x: Floats) -> Floats:
        return capacity(x, vacuum, supply, nominal, ambient) - flow

    def residual(x: Floats) -> Floats:
        return np.concatenate([(miss(x) * nearness).ravel() / top, 1e-3 * x[2:6]])

    start = np.array([top, 150.0, 0.3, 0.0, 0.0, 0.0, float(supply[flow[:, 0].argmax()]), 0.5, 0.1])
    low = [0.1 * top, 1.0, -0.9, -5.0, -10.0, -10.0, 0.1, 0.0, 0.0]
    high = [3.0 * top, 0.97 * ambient, 3.0, 5.0, 10.0, 10.0, 10.0, 20.0, 5.0]
    # SciPy imports it with its first use: few data sets have diagrams.
    least_squares = scipy.optimize.least_squares
    fit = least_squares(residual, np.clip(start, low, high), bounds=(low, high), x_scale="jac")
    misses = np.abs(miss(fit.x))
    if misses.max() > WORST * top:
        raise ConfigError(
            f"the characteristic diagram is missed by up to {misses.max():.3g} sl/min",
            "check its rows: one peak over operating pressure, and capacity that falls with vacuum",
        )
    count = len(_KEYS) if len(supply) > 1 else 6
    tables: dict[str, dict[str, float]] = {}
    for (table, key), value in zip(_KEYS[:count], fit.x, strict=False):
        tables.setdefault(table, {})[key] = float(value)
    return Reduced(tables, float(np.sqrt(np.mean(misses**2))), float(misses.max()))


def capacity(x: Floats, vacuum: Floats, supply: Floats, nominal: float, ambient: float) -> Floats:
    """Suction capacity (m, n) of the model in sl/min, for values ``x`` in the order of _KEYS."""
    most, end, bulge, skew, bend_2, bend_3, optimum, curvature, slope = (
        float(value) for value in x
    )
    peak = np.maximum(1.0 - curvature * (supply / optimum - 1.0) ** 2, 0.0)
    at_nominal = max(1.0 - curvature * (nominal / optimum - 1.0) ** 2, 1e-3)
    ends = np.clip(end * (1.0 + slope * (nominal - supply)), 0.0, 0.98 * ambient)[:, None]
    x_share = np.clip((ambient - vacuum - ends) / (ambient - ends), 0.0, 1.0)
    bend = bulge + x_share * (skew + x_share * (bend_2 + x_share * bend_3))
    share: Floats = np.maximum(x_share * (1.0 + (1.0 - x_share) * bend), 0.0)
    flow: Floats = most * (peak / at_nominal)[:, None] * share
    return flow
