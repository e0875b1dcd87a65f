"""What a calibration may move: one table, each with what the type leaves open."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.model.dataset import DataSet

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Free:
    """One value of a data set: where it stands, its unit and bounds, how far units differ.

    ``spread`` is one standard deviation from unit to unit and from what is configured: a share of
    the value where ``relative``, else in its unit. ``healthy`` is how many of them below and above
    the type's value a unit is still taken for healthy; None where the value only shapes the curve.
    """

    table: str
    key: str
    unit: str
    spread: float
    low: float
    high: float
    relative: bool = False
    healthy: tuple[float, float] | None = None

    @property
    def name(self) -> str:
        """As a configuration has it."""
        return f"{self.table}.{self.key}"

    def of(self, data: DataSet) -> float:
        """Its value in a data set."""
        return float(getattr(getattr(data, self.table), self.key))

    def sigma(self, data: DataSet) -> float:
        """How far it may be from its value in ``data``, one standard deviation, in its unit."""
        return self.spread * abs(self.of(data)) if self.relative else self.spread


_E = "ejector"
_ANY = (4.0, 4.0)
FREE = (
    # A worn nozzle moves less air; a unit that moves more than its type is only a good one.
    Free(_E, "suction_capacity_sl_min", "sl/min", 0.1, 1.0, 1000.0, True, (1.2, 4.0)),
    Free(_E, "end_pressure_mbar", "mbar", 40.0, 10.0, 700.0, healthy=(4.0, 2.0)),
    Free(_E, "bulge", "", 0.5, -0.9, 3.0),
    Free(_E, "skew", "", 0.2, -5.0, 5.0),
    Free(_E, "bend_2", "", 0.15, -10.0, 10.0),
    Free(_E, "bend_3", "", 0.05, -10.0, 10.0),
    Free(_E, "response_ms", "ms", 5.0, 0.0, 400.0, healthy=_ANY),
    Free(_E, "response_off_ms", "ms", 4.0, 0.0, 400.0),
    Free(_E, "ramp_up_ms", "ms", 3.0, 0.5, 200.0),
    Free(_E, "ramp_down_ms", "ms", 1.5, 0.5, 200.0),
    Free(_E, "blow_off_sl_min", "sl/min", 0.3, 1.0, 2000.0, True, healthy=_ANY),
    Free(_E, "blow_off_response_ms", "ms", 5.0, 0.0, 400.0, healthy=_ANY),
    Free(_E, "blow_off_response_off_ms", "ms", 4.0, 0.0, 400.0),
    Free(_E, "blow_off_ramp_ms", "ms", 3.0, 0.5, 200.0),
    Free(_E, "relief_sl_min", "sl/min", 0.4, 0.0, 5000.0, True),
    Free("system", "film_coefficient", "W/(m²·K)", 4.0, 0.0, 500.0, healthy=_ANY),
    Free("system", "tube_film_coefficient", "W/(m²·K)", 30.0, 0.0, 500.0),
    Free("system", "line_factor", "", 0.4, 0.05, 20.0, healthy=_ANY),
    Free("system", "line_share", "", 0.2, 0.05, 0.95),
    Free("system", "sensor_shift", "", 0.2, -1.0, 1.0),
    Free("system", "leak_sl_min", "sl/min", 1.0, 0.0, 60.0, healthy=(1.0, 0.6)),
    Free("sensor", "lag_ms", "ms", 1.0, 0.5, 200.0),
)
_NUMBER = {free.key: number for number, free in enumerate(FREE)}
_BENDS = [_NUMBER[key] for key in ("bulge", "skew", "bend_2", "bend_3")]
# Legendre polynomials over the characteristic, in powers of x. A real characteristic is smooth: in
# these the finer ones are small, and none can be traded against another, as powers could.
_SMOOTH = np.array(
    [
        [1.0, -1.0, 1.0, -1.0],
        [0.0, 2.0, -6.0, 12.0],
        [0.0, 0.0, 6.0, -30.0],
        [0.0, 0.0, 0.0, 20.0],
    ]
)


def values(data: DataSet) -> Floats:
    """Values of all free parameters, in their units."""
    return np.array([free.of(data) for free in FREE])


def directions(data: DataSet) -> Floats:
    """(parameters, n): independent ways to differ from ``data``, one standard deviation each."""
    ways = np.diag([free.sigma(data) for free in FREE])
    ways[np.ix_(_BENDS, _BENDS)] = _SMOOTH * np.diag(ways)[_BENDS]
    # The exhaust that blow-off leaves through is as wide as the blow-off needs it.
    flow, relief = FREE[_NUMBER["blow_off_sl_min"]], _NUMBER["relief_sl_min"]
    ways[relief, _NUMBER["blow_off_sl_min"]] = flow.spread * FREE[relief].of(data)
    return ways


def with_values(data: DataSet, numbers: Floats) -> DataSet:
    """``data`` with other values, unchecked: a search passes through what is no ejector."""
    changed: dict[str, dict[str, float]] = {}
    for free, number in zip(FREE, numbers, strict=True):
        changed.setdefault(free.table, {})[free.key] = float(number)
    tables = {name: getattr(data, name).model_copy(update=new) for name, new in changed.items()}
    return data.model_copy(update=tables)
