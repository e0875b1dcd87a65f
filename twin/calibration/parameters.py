"""Table of a calibration's free parameters, each with its prior; and the space of a search."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from twin.inference.sensitivities import STEP
from twin.model.dataset import DataSet, sensor_place
from twin.model.effects import is_of_volumes

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Free:
    """One free value of a data set: table and key, unit, bounds, and how far units differ.

    ``spread`` is one sigma from unit to unit and from the configuration: a share of the value if
    ``relative``, else in its unit. ``healthy`` limits a healthy unit, in sigmas below and above the
    type's value; None if the value only shapes the curve. ``market`` is one sigma if the type is
    unknown: of the logarithm if the value is ``scaled``, else in its unit. It is wide enough for
    any rig on the market. ``model_form`` is one sigma of the logarithm between rigs of other
    equations whose curves agree: it only widens the reported interval.
    """

    table: str
    key: str
    unit: str
    spread: float
    low: float
    high: float
    relative: bool = False
    healthy: tuple[float, float] | None = None
    market: float = 0.0
    scaled: bool = True
    model_form: float = 0.0

    @property
    def scales_with_volumes(self) -> bool:
        """Whether it is a flow or a volume: a record shows only what it is beside the system's."""
        return is_of_volumes(self.unit)

    @property
    def name(self) -> str:
        """Table and key as in a configuration."""
        return f"{self.table}.{self.key}"

    def of(self, data: DataSet) -> float:
        """Its value in a data set."""
        return float(getattr(getattr(data, self.table), self.key))

    def sigma(self, data: DataSet) -> float:
        """One sigma about its value in ``data``, in its unit."""
        return self.spread * abs(self.of(data)) if self.relative else self.spread


_E = "ejector"
_ANY = (4.0, 4.0)
FREE = (
    # A worn nozzle moves less air; a unit that moves more than its type is only a good one.
    # This is suction at ambient pressure, where the jet still grows and gas at the port hides that.
    # On seven commissioned rigs of the tests' second world (seeds from 101000) its error was 26 %
    # rms, while the curves agreed to a millibar.
    Free(
        _E,
        "suction_capacity_sl_min",
        "sl/min",
        0.1,
        1.0,
        1000.0,
        True,
        (1.2, 4.0),
        market=0.5,
        model_form=0.22,
    ),
    Free(_E, "end_pressure_mbar", "mbar", 40.0, 10.0, 700.0, healthy=(4.0, 2.0), market=0.5),
    Free(_E, "bulge", "", 0.5, -1.0, 4.0, market=1.0, scaled=False),
    Free(_E, "skew", "", 0.2, -20.0, 20.0, market=0.7, scaled=False),
    Free(_E, "bend_2", "", 0.15, -40.0, 40.0, market=0.5, scaled=False),
    Free(_E, "bend_3", "", 0.05, -40.0, 40.0, market=0.3, scaled=False),
    Free(_E, "response_ms", "ms", 5.0, 0.0, 400.0, healthy=_ANY, market=0.6),
    Free(_E, "response_off_ms", "ms", 4.0, 0.0, 400.0, market=0.6),
    Free(_E, "ramp_up_ms", "ms", 3.0, 0.5, 200.0, market=0.7),
    Free(_E, "ramp_down_ms", "ms", 1.5, 0.5, 200.0, market=1.2),
    Free(_E, "blow_off_sl_min", "sl/min", 0.3, 1.0, 2000.0, True, healthy=_ANY, market=1.0),
    Free(_E, "blow_off_response_ms", "ms", 5.0, 0.0, 400.0, healthy=_ANY, market=0.6),
    Free(_E, "blow_off_response_off_ms", "ms", 4.0, 0.0, 400.0, market=0.6),
    Free(_E, "blow_off_ramp_ms", "ms", 3.0, 0.5, 200.0, market=0.7),
    Free(_E, "relief_sl_min", "sl/min", 0.4, 0.0, 5000.0, True, market=1.5),
    Free("system", "film_coefficient", "W/(m²·K)", 4.0, 0.0, 500.0, healthy=_ANY, market=0.7),
    Free("system", "tube_film_coefficient", "W/(m²·K)", 30.0, 0.0, 500.0, market=1.0),
    Free("system", "line_factor", "", 0.4, 0.02, 1000.0, healthy=_ANY, market=1.2),
    Free("system", "line_share", "", 0.2, 0.05, 0.95, market=0.25, scaled=False),
    Free("system", "sensor_shift", "", 0.2, -1.0, 1.0, market=0.4, scaled=False),
    Free("system", "leak_sl_min", "sl/min", 1.0, 0.0, 60.0, healthy=(1.0, 0.6), market=1.5),
    # Farther off is another filter in front of the sensor, which a wide fit would hide elsewhere.
    Free("sensor", "lag_ms", "ms", 1.0, 0.5, 200.0, healthy=_ANY, market=0.4),
)
_NUMBER = {free.key: number for number, free in enumerate(FREE)}
_BENDS = [_NUMBER[key] for key in ("bulge", "skew", "bend_2", "bend_3")]
# Legendre polynomials over the characteristic, in powers of x. A real characteristic is smooth, so
# the finer ones are small. They are orthogonal; powers of x would be nearly collinear.
_SMOOTH = np.array(
    [
        [1.0, -1.0, 1.0, -1.0],
        [0.0, 2.0, -6.0, 12.0],
        [0.0, 0.0, 6.0, -30.0],
        [0.0, 0.0, 0.0, 20.0],
    ]
)

# A characteristic can also be given by its rises in five parts, as with the coefficients of
# Bernstein polynomials; with rises above zero it is monotonic. Bends from rises, (bends, parts).
_FROM_RISES = np.array(
    [
        [4.0, -1.0, -1.0, -1.0, -1.0],
        [-6.0, 9.0, -1.0, -1.0, -1.0],
        [4.0, -11.0, 9.0, -1.0, -1.0],
        [-1.0, 4.0, -6.0, 4.0, -1.0],
    ]
)
_PARTS = _FROM_RISES.shape[1]
# Legendre polynomials that tilt the logarithms of the rises, the finer ones last, (parts, bends).
_TILTS = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, _PARTS), len(_BENDS))[:, 1:]
LEAST_RISE = 1e-3  # least share of the whole rise in a part, where a fit begins


def _rises(bends: Floats) -> Floats:
    """Rises of a characteristic from its bends; they add up to 1."""
    equations = np.vstack([_FROM_RISES, np.ones(_PARTS)])
    rises = np.maximum(np.linalg.solve(equations, np.append(bends, 1.0)), LEAST_RISE)
    shares: Floats = rises / rises.sum()
    return shares


def _tilted(rises: Floats, tilts: Floats) -> Floats:
    """Rises with tilted logarithms; they add up to 1."""
    logarithms = _TILTS @ tilts
    tilted = rises * np.exp(logarithms - logarithms.max())
    shares: Floats = tilted / tilted.sum()
    return shares


# Free parameters if the type is unknown.
FREE_IN_MARKET = (
    *FREE,
    Free(_E, "port_volume_ml", "ml", 0.2, 0.1, 1000.0, True, market=1.0),
    Free(_E, "kink", "", 0.1, 0.0, 0.95, market=0.3, scaled=False),
    Free(_E, "kink_at", "", 0.1, 0.02, 0.95, market=0.2, scaled=False),
    Free(_E, "jet_depth", "", 0.2, 0.0, 1.0, market=0.3, scaled=False),
    Free(_E, "exhaust_sl_min", "sl/min", 0.4, 0.0, 5000.0, True, market=1.5),
    Free(_E, "cracking_pressure_mbar", "mbar", 2.0, 0.0, 100.0, market=5.0, scaled=False),
    Free(_E, "relief_pressure_mbar", "mbar", 10.0, 0.0, 2000.0, market=100.0, scaled=False),
    Free(_E, "back_flow_sl_min", "sl/min", 0.4, 0.0, 5000.0, True, market=1.5),
    Free(_E, "blow_off_closing_factor", "", 0.2, 0.02, 50.0, True, market=0.7),
    Free(_E, "blow_off_shape", "", 0.1, -0.9, 3.0, market=0.4, scaled=False),
    Free(_E, "blow_off_drain_per_s", "1/s", 0.4, 0.0, 200.0, True, market=1.5),
    Free(_E, "blow_off_refill", "", 0.2, 0.0, 5.0, True, market=1.0),
    Free("system", "free_convection", "", 0.2, 0.0, 1.0, market=0.3, scaled=False),
    Free("system", "forced_convection", "", 0.2, 0.0, 20.0, market=1.0),
    Free("supply", "droop_bar", "bar", 0.1, 0.0, 1.0, market=1.0),
    Free("supply", "lag_ms", "ms", 20.0, 1.0, 1000.0, market=1.0),
    Free("system", "leak_critical_ratio", "", 0.05, 0.1, 0.6, market=0.12, scaled=False),
    # Catalogues of tubes and fittings have 0.1 to 0.5, less the longer a tube is.
    Free("system", "line_critical_ratio", "", 0.05, 0.0, 0.5, market=0.15, scaled=False),
    Free("system", "opening_factor", "", 0.4, 1e-3, 100.0, True, market=1.5),
    Free("system", "line_volume_factor", "", 0.2, 0.02, 50.0, True, market=0.5),
    Free("system", "line_inertia_factor", "", 0.2, 0.02, 50.0, True, market=0.5),
    Free("system", "shrinks_ml", "ml", 0.3, 0.0, 5000.0, True, market=1.5),
    Free("system", "softness", "", 0.5, 0.0, 500.0, True, market=1.0),
    Free("system", "stiff_mbar", "mbar", 20.0, 0.0, 2000.0, market=1.0),
    Free("system", "creep_share", "", 0.1, 0.0, 1.0, market=0.3, scaled=False),
    Free("system", "creep_ms", "ms", 10.0, 1.0, 1000.0, market=0.7),
    Free("system", "part_meets_ms", "ms", 5.0, 0.0, 5000.0, market=0.6),
    Free("system", "release_shift_mbar", "mbar", 5.0, -60.0, 200.0, market=15.0, scaled=False),
)
# Also free if an absolute sensor reads a system that is never open: nothing else shows ambient
# pressure. If configured, it is known to some mbar; otherwise it depends on the site's height.
AMBIENT = Free("ambient", "pressure_mbar", "mbar", 3.0, 500.0, 1100.0, market=40.0, scaled=False)
AMBIENT_TOLD = replace(AMBIENT, market=3.0)
SMALLEST = 0.02  # in its unit: least centre of a scaled value, as a factor cannot leave zero
FARTHEST = 5.0  # largest change of the logarithm from the guess
# Step of a derivative, in market sigmas. With five times as much, a fit of 46 values stopped far
# from the best: errors along the strong directions hid the weak ones.
MARKET_STEP = 0.01


def values(data: DataSet, free: Sequence[Free] = FREE) -> Floats:
    """Values of free parameters, in their units."""
    return np.array([parameter.of(data) for parameter in free])


def directions(data: DataSet) -> Floats:
    """(parameters, n): independent directions away from ``data``, one sigma each."""
    columns = np.diag([free.sigma(data) for free in FREE])
    columns[np.ix_(_BENDS, _BENDS)] = _SMOOTH * np.diag(columns)[_BENDS]
    # The exhaust is sized for the blow-off, so it varies with it.
    flow, relief = FREE[_NUMBER["blow_off_sl_min"]], _NUMBER["relief_sl_min"]
    columns[relief, _NUMBER["blow_off_sl_min"]] = flow.spread * FREE[relief].of(data)
    return columns


def with_values(data: DataSet, numbers: Floats, free: Sequence[Free] = FREE) -> DataSet:
    """``data`` with other values, unchecked: a search may pass through impossible ejectors.

    The nozzle switches at absolute pressures: another ambient pressure changes the vacuum of its
    thresholds.
    """
    changed: dict[str, dict[str, float]] = {}
    for parameter, number in zip(free, numbers, strict=True):
        changed.setdefault(parameter.table, {})[parameter.key] = float(number)
    if "ambient" in changed:
        rise = changed["ambient"][AMBIENT.key] - data.ambient.pressure_mbar
        for key in ("h1_mbar", "h2_mbar"):
            changed.setdefault("ejector", {})[key] = getattr(data.ejector, key) + rise
    tables = {name: getattr(data, name).model_copy(update=new) for name, new in changed.items()}
    return data.model_copy(update=tables)


def _reach(parameter: Free, data: DataSet) -> tuple[float, float]:
    """Market coordinates about ``data`` at which a value reaches its bounds."""
    value = parameter.of(data)
    if not parameter.scaled:
        return (parameter.low - value) / parameter.market, (
            parameter.high - value
        ) / parameter.market
    centre, farthest = max(value, parameter.low, SMALLEST), np.exp(FARTHEST)
    low, high = max(parameter.low, centre / farthest), min(parameter.high, centre * farthest)
    return float(np.log(low / centre)) / parameter.market, float(
        np.log(high / centre)
    ) / parameter.market


@dataclass(frozen=True)
class Space:
    """Space of a fit: coordinates in sigmas about a data set, which is at 0.

    ``ways`` are directions, (parameters, n). A ``scaled`` parameter is multiplied by the
    exponential of its coordinate; to any other the coordinate is added. A search stays between
    ``low`` and ``high``: outside the derivatives are zero. If the type is unknown, the coordinates
    of the bends tilt the characteristic so that it rises ``everywhere``.
    """

    data: DataSet
    free: tuple[Free, ...]
    ways: Floats
    scaled: npt.NDArray[np.bool_]
    low: Floats
    high: Floats
    step: float = STEP  # in coordinates, for a derivative
    everywhere: bool = False

    @classmethod
    def of_type(cls, data: DataSet) -> "Space":
        """Units of a known type, ``data``."""
        anywhere = np.full(len(FREE), np.inf)
        return cls(data, FREE, directions(data), anywhere < 0.0, -anywhere, anywhere)

    @classmethod
    def of_market(cls, data: DataSet, free: tuple[Free, ...] = FREE_IN_MARKET) -> "Space":
        """Any ejector on the market with any system; ``data`` is a guess."""
        directions = np.diag([parameter.market for parameter in free])
        scaled = np.array([parameter.scaled for parameter in free])
        low, high = np.array([_reach(parameter, data) for parameter in free]).T
        low[_BENDS], high[_BENDS] = -np.inf, np.inf  # each coordinate moves several of them
        return cls(data, free, directions, scaled, low, high, MARKET_STEP, everywhere=True)

    @property
    def on_the_line(self) -> "Space":
        """The same space with the sensor bound to the line.

        A search may pass an end of the line, so that it does not stop there. But derivatives are
        zero beyond it: the record would seem not to determine the sensor's place.
        """
        system = self.data.system.model_copy(update={"sensor_shift": 0.0})
        configured_place = sensor_place(self.data.model_copy(update={"system": system}))
        number = [parameter.key for parameter in self.free].index("sensor_shift")
        ends = np.array([0.0, 1.0]) - configured_place
        parameter = replace(self.free[number], low=float(ends[0]), high=float(ends[1]))
        low, high = self.low.copy(), self.high.copy()
        low[number], high[number] = (ends - parameter.of(self.data)) / self.ways[number, number]
        free = (*self.free[:number], parameter, *self.free[number + 1 :])
        return replace(self, free=free, low=low, high=high)

    def values(self, x: Floats) -> Floats:
        """Values of the free parameters at ``x``, kept within their bounds."""
        low, high = (
            [getattr(parameter, end) for parameter in self.free] for end in ("low", "high")
        )
        return np.clip(self._unbound(x), low, high)

    def at(self, x: Floats) -> DataSet:
        """The data set at ``x``."""
        return with_values(self.data, self.values(x), self.free)

    def slopes(self, x: Floats) -> Floats:
        """(parameters, n): derivatives of the values."""
        slopes = np.where(self.scaled, self._unbound(x), 1.0)[:, None] * self.ways
        if self.everywhere:
            tilts = np.ix_(_BENDS, _BENDS)
            rises = _tilted(_rises(values(self.data, self.free)[_BENDS]), (self.ways @ x)[_BENDS])
            per_tilt = (np.diag(rises) - np.outer(rises, rises)) @ _TILTS
            slopes[tilts] = _FROM_RISES @ per_tilt @ self.ways[tilts]
        return slopes

    def _unbound(self, x: Floats) -> Floats:
        moved = self.ways @ x
        centre = values(self.data, self.free)
        if self.everywhere:
            rises = _tilted(_rises(centre[_BENDS]), moved[_BENDS])
            moved[_BENDS] = _FROM_RISES @ rises - centre[_BENDS]
        least = np.array([max(parameter.low, SMALLEST) for parameter in self.free])
        scale = np.exp(np.clip(moved, -FARTHEST, FARTHEST))
        return np.where(self.scaled, np.maximum(centre, least) * scale, centre + moved)
