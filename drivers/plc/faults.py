"""Faults of the rig: one table of effects, and faults as text.

A fault acts through numbers that always exist; at their neutral value they change nothing. ``ROW``
holds one number for each parameter of each fault, in SI units, for one scan of the PLC.
"""

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.errors import ConfigError
from twin.signals import BAR, MBAR, ML, MS, SL_MIN

PERCENT = 0.01
UNITS = {
    "sl/min": SL_MIN,
    "mbar": MBAR,
    "bar": BAR,
    "ml": ML,
    "ms": MS,
    "s": 1.0,
    "%": PERCENT,
    "%/s": PERCENT,
    "W/(m²·K)": 1.0,
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect in the field's unit; neutral is None where the rig has its own."""

    name: str
    unit: str
    low: float
    high: float
    neutral: float | None = 0.0


@dataclass(frozen=True, slots=True)
class Effect:
    """One way in which the rig can differ; the first parameter is its size."""

    meaning: str
    parameters: tuple[Parameter, ...]


def _effect(meaning: str, *parameters: Parameter) -> Effect:
    return Effect(meaning, parameters)


EFFECTS: dict[str, Effect] = {
    "leakage": Effect(
        "an orifice from ambient into the vessel", (Parameter("sonic_flow", "sl/min", 0, 50),)
    ),
    "porous_leakage": Effect(
        "a leak into the vessel in proportion to the vacuum",
        (Parameter("flow_at_600mbar", "sl/min", 0, 50),),
    ),
    "check_valve_leak": Effect(
        "back-flow through the ejector while its nozzle is off",
        (Parameter("sonic_flow", "sl/min", 0, 50),),
    ),
    "suction_loss": Effect(
        "the ejector moves less air at every vacuum", (Parameter("loss", "%", -50, 95),)
    ),
    "end_vacuum_loss": Effect(
        "the highest vacuum it can reach is lower",
        (Parameter("end_pressure_rise", "mbar", -100, 600),),
    ),
    "supply_pressure_drop": Effect("less operating pressure", (Parameter("drop", "bar", -3, 5),)),
    "filter_clogging": Effect(
        "a restriction between the port with its sensor and the vessel",
        (Parameter("pressure_drop_at_nominal", "mbar", 0, 600),),
    ),
    "added_volume": Effect("more volume than configured", (Parameter("volume", "ml", 0, 2000),)),
    "cup_compliance": Effect(
        "the vessel shrinks in proportion to the vacuum",
        (Parameter("volume_at_full_vacuum", "ml", 0, 100),),
    ),
    "heat_exchange": Effect(
        "the vessel's wall heat transfer is this instead of the rig's own",
        (Parameter("film_coefficient", "W/(m²·K)", 0, 500, None),),
    ),
    "response_delay": Effect("the suction valve acts later", (Parameter("delay", "ms", 0, 500),)),
    "slow_ramp_up": Effect(
        "the jet takes longer to reach full suction", (Parameter("time_constant", "ms", 0, 500),)
    ),
    "threshold_drift": Effect(
        "the air saving's levels moved: H1, and where it switches on again",
        (
            Parameter("h1_shift", "mbar", -300, 200),
            Parameter("h2_shift", "mbar", -300, 140),
        ),
    ),
    "weak_blow_off": Effect("blow-off flow too small", (Parameter("loss", "%", -50, 95),)),
    "blow_off_delay": Effect("the blow-off valve acts later", (Parameter("delay", "ms", 0, 500),)),
    "sensor_offset": Effect(
        "the PLC's sensor reads a constant amount more", (Parameter("offset", "mbar", -300, 300),)
    ),
    "sensor_gain": Effect(
        "the PLC's sensor reads more vacuum", (Parameter("error", "%", -50, 50),)
    ),
    "sensor_lag": Effect("the PLC's sensor is slow", (Parameter("time_constant", "ms", 0, 500),)),
    "ambient_pressure": Effect("weather or altitude", (Parameter("shift", "mbar", -300, 80),)),
    "lip_lift": Effect(
        "the sealing lip lifts and leaks above a certain vacuum",
        (
            Parameter("sonic_flow", "sl/min", 0, 50),
            Parameter("above", "mbar", 0, 900, 500.0),
        ),
    ),
    "supply_swing": Effect(
        "the supply swings as another consumer comes and goes",
        (
            Parameter("amplitude", "bar", 0, 3),
            Parameter("period", "s", 0.05, 3600, 1.7),
        ),
    ),
    "condensate": Effect(
        "water evaporates into the vessel under vacuum until it is used up in each cycle",
        (
            Parameter("vapour_flow", "sl/min", 0, 20),
            Parameter("used_up_after", "s", 0.05, 60, 0.8),
        ),
    ),
    "nozzle_icing": Effect(
        "suction falls while the nozzle is on and recovers over seconds",
        (Parameter("loss_rate", "%/s", 0, 80),),
    ),
    "sensor_backlash": Effect(
        "the PLC's sensor sticks until the pressure has moved by this much",
        (Parameter("width", "mbar", 0, 200),),
    ),
    "creeping_cup": Effect(
        "the cup's wall creeps under vacuum: the vessel shrinks over seconds",
        (
            Parameter("volume_at_full_vacuum", "ml", 0, 100),
            Parameter("time_constant", "s", 0.05, 60, 1.5),
        ),
    ),
    "sticking_valve": Effect(
        "the suction valve sticks in some of its strokes, opening or closing",
        (
            Parameter("delay", "ms", 0, 500),
            Parameter("stuck_strokes", "%", 0, 100, 33.0),
        ),
    ),
    "blow_off_valve_leak": Effect(
        "compressed air leaks through the seat of the blow-off valve into the port",
        (Parameter("sonic_flow", "sl/min", 0, 50),),
    ),
    "filling_silencer": Effect(
        "exhaust fills the silencer while the nozzle runs, and the end vacuum falls",
        (
            Parameter("back_pressure", "mbar", 0, 600),
            Parameter("time_constant", "s", 0.05, 60, 1.0),
        ),
    ),
    "second_ejector": Effect(
        "another ejector takes air from the same supply, on for two fifths of its own period",
        (
            Parameter("drop", "bar", 0, 3),
            Parameter("period", "s", 0.05, 3600, 2.9),
        ),
    ),
    "adsorbed_moisture": Effect(
        "walls give off moisture under vacuum until they are dry, and take it up at ambient",
        (
            Parameter("vapour_flow", "sl/min", 0, 20),
            Parameter("time_constant", "s", 0.05, 60, 0.6),
        ),
    ),
    "sensor_thermal_drift": Effect(
        "the PLC's sensor reads more as it warms up after the start",
        (
            Parameter("offset", "mbar", -300, 300),
            Parameter("time_constant", "s", 0.05, 3600, 15.0),
        ),
    ),
}


def column(effect: str, parameter: str) -> str:
    """Name of the parameter's field in ``ROW``."""
    return f"{effect}_{parameter}"


COLUMNS = {column(e, p.name): p for e, effect in EFFECTS.items() for p in effect.parameters}
ROW = np.dtype([(name, "f8") for name in (*COLUMNS, "supply_scatter", "seal_scatter")])
Rows = npt.NDArray[np.void]  # of ROW


@dataclass(frozen=True, slots=True)
class Fault:
    """One parameter of one effect with its course; the default course is a step at the start."""

    effect: str
    parameter: Parameter
    value: float  # size in the parameter's unit
    start_s: float = 0.0
    start_cycle: int | None = None
    ramp_s: float = 0.0
    every: int = 1
    share: float = 1.0

    @property
    def column(self) -> str:
        """Its field in ``ROW``."""
        return column(self.effect, self.parameter.name)


_TEXT = re.compile(
    r"(?P<effect>\w+)(?:\.(?P<parameter>\w+))?=(?P<value>[^@/]+)"
    r"(?:@(?P<cycle>c?)(?P<start>[^/]+))?(?:/(?P<course>\w+):(?P<amount>[^/]+))?"
)
_GRAMMAR = "write NAME=VALUE[@START][/COURSE], for example leakage=1.9@10/ramp:30"


def parse_fault(text: str) -> Fault:
    """Read ``NAME[.PARAMETER]=VALUE[@SECONDS|@cCYCLE][/ramp:SECONDS|/every:N|/share:S]``.

    Raises ConfigError if the text is malformed, a name is unknown or a value is out of bounds.
    """
    match = _TEXT.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"fault {text!r} cannot be read", _GRAMMAR)
    parameter = _parameter(text, match["effect"], match["parameter"])
    value = _number(text, match["value"], parameter.low, parameter.high)
    options = _start(text, match) | _course(text, match)
    return Fault(match["effect"], parameter, value, **options)  # type: ignore[arg-type]


def _parameter(text: str, effect: str, name: str | None) -> Parameter:
    if effect not in EFFECTS:
        raise ConfigError(f"fault {text!r}: no effect {effect!r}", f"one of {', '.join(EFFECTS)}")
    parameters = EFFECTS[effect].parameters
    for parameter in parameters:
        if name in (None, parameter.name):
            return parameter
    names = ", ".join(p.name for p in parameters)
    raise ConfigError(f"fault {text!r}: {effect} has no parameter {name!r}", f"it has {names}")


def _number(text: str, digits: str, low: float, high: float) -> float:
    try:
        value = float(digits)
    except ValueError as error:
        raise ConfigError(f"fault {text!r}: {digits!r} is not a number", _GRAMMAR) from error
    if not low <= value <= high:
        raise ConfigError(f"fault {text!r}: {value:g} is out of bounds", f"{low:g} to {high:g}")
    return value


def _whole(text: str, digits: str, low: int) -> int:
    if not digits.isdecimal() or int(digits) < low:
        raise ConfigError(f"fault {text!r}: {digits!r} is not a whole number from {low}", _GRAMMAR)
    return int(digits)


def _start(text: str, match: re.Match[str]) -> dict[str, float | int]:
    if match["start"] is None:
        return {}
    if match["cycle"]:
        return {"start_cycle": _whole(text, match["start"], 0)}
    return {"start_s": _number(text, match["start"], 0.0, 1e9)}


def _course(text: str, match: re.Match[str]) -> dict[str, float | int]:
    match match["course"]:
        case None:
            return {}
        case "ramp":
            return {"ramp_s": _number(text, match["amount"], 1e-3, 1e9)}
        case "every":
            return {"every": _whole(text, match["amount"], 1)}
        case "share":
            return {"share": _number(text, match["amount"], 0.0, 1.0)}
        case course:
            raise ConfigError(f"fault {text!r}: no course {course!r}", "one of ramp, every, share")
