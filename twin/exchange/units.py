"""Units as exchange formats declare them: exponents of the base units, and a factor.

They come from the tables of coefficients and effects; the names are plain text for older tools.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from twin.signals import BAR, MBAR, ML, MS, SL_MIN

_PLAIN = str.maketrans({"²": "2", "³": "3", "·": ".", " ": "."})


@dataclass(frozen=True)
class Unit:
    """One unit: a value times ``factor`` is SI. ``shown`` lists display units."""

    base: Mapping[str, int]
    factor: float = 1.0
    shown: Mapping[str, float] = field(default_factory=dict)  # display units per unit


_PRESSURE, _FLOW, _VOLUME = {"kg": 1, "m": -1, "s": -2}, {"kg": 1, "s": -1}, {"m": 3}
_TIME, _FILM = {"s": 1}, {"kg": 1, "s": -3, "K": -1}

UNITS: Mapping[str, Unit] = {
    "1": Unit({}),
    "%": Unit({}, 0.01),
    "Pa": Unit(_PRESSURE, shown={"bar": 1.0 / BAR, "mbar": 1.0 / MBAR}),
    "mbar": Unit(_PRESSURE, MBAR),
    "bar": Unit(_PRESSURE, BAR),
    "Pa/s": Unit({"kg": 1, "m": -1, "s": -3}),
    "1/Pa": Unit({"kg": -1, "m": 1, "s": 2}),
    "1/s": Unit({"s": -1}),
    "K": Unit({"K": 1}),
    "s": Unit(_TIME),
    "ms": Unit(_TIME, MS),
    "kg/s": Unit(_FLOW, shown={"sl/min": 1.0 / SL_MIN}),
    "sl/min": Unit(_FLOW, SL_MIN),
    "s/kg": Unit({"kg": -1, "s": 1}),
    "kg/(s.Pa)": Unit({"m": 1, "s": 1}),
    "m3": Unit(_VOLUME),
    "ml": Unit(_VOLUME, ML),
    "m2": Unit({"m": 2}),
    "1/m": Unit({"m": -1}),
    "W/K": Unit({"kg": 1, "m": 2, "s": -3, "K": -1}),
    "W/(m2.K)": Unit(_FILM),
    "Pa2/(kg/s)2": Unit({"m": -2, "s": -2}),
    "Pa2/(kg/s)": Unit({"kg": 1, "m": -2, "s": -3}),
}


def plain(unit: str) -> str:
    """The name of a unit in plain text."""
    return unit.translate(_PLAIN)
