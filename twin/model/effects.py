"""Every way a real ejector can differ from its data set: one table, one entry each.

Every effect is always compiled in; at its neutral value it changes no bit of the result. The
monitor isolates effects by their signatures, the diagnosis searches their parameters, and an
extended model sets them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

from twin.errors import ConfigError
from twin.model import theta as c
from twin.model.theta import Theta
from twin.signals import BAR, MBAR, ML, MS, SL_MIN

FLATTEST = 0.9  # largest share of the volume by which cups shrink
# Frequency of an effect over that of wear, which is assumed to come once in two years.
WEEKLY, SELDOM = 100.0, 0.1
# Relative sigma of an estimated size in addition to that of the log. A rig has other equations than
# the model: 9 % rms over 11 sizes on rigs of the second world (tools/battery_second.py), less for
# sizes that a reading shows directly.
OTHER_EQUATIONS, READ_OFF = 0.08, 0.03
# Suction (kg/s) and volume (m³) of the unit that typical sizes refer to: a small gripper.
USUAL_SUCTION, USUAL_VOLUME = 30.0 * SL_MIN, 150.0 * ML
UNKNOWN = "unknown"  # stands for an effect where a deviation has no name yet


def is_of_volumes(unit: str) -> bool:
    """Whether a unit is one of flow or volume; pressures show only the ratios of these."""
    return unit in ("sl/min", "ml")


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, in the field's unit.

    ``typical`` is a change worth an alarm; for a ``ratio`` it is a factor. The neutral value is
    zero, or the data set's value if the parameter replaces a ``coefficient``. A parameter that only
    shapes an effect has its ``usual`` value, or the lowest one, instead.
    """

    name: str
    unit: str
    low: float
    high: float
    typical: float
    # Numbers of the coefficients that it changes; none for a mechanism, which acts on any. The
    # first is the main one: for a valve's delay, that of opening.
    touches: tuple[int, ...] = ()
    coefficient: int | None = None
    ratio: bool = False  # scale is logarithmic, as for a time constant
    usual: float | None = None  # usual value of a parameter that shapes an effect seen before
    is_of_the_log: bool = False  # holds for one log only: a phase
    relative_error: float = OTHER_EQUATIONS  # one sigma of an estimated size, relative
    # Scatter (one sigma) from cycle to cycle in a healthy ejector, in its unit, until a better one
    # is learned; 0: none.
    healthy_sigma: float = 0.0

    @property
    def is_time(self) -> bool:
        """Whether it is a delay or a time constant: it shifts edges, and acts nonlinearly."""
        return self.unit == "ms"

    @property
    def scales_with_volumes(self) -> bool:
        """Whether it is a flow or a volume."""
        return is_of_volumes(self.unit)

    @property
    def shapes(self) -> bool:
        """Whether it shapes an effect that was seen before, instead of giving its size."""
        return self.usual is not None

    def neutral(self, theta: Theta) -> float:
        """The value at which the effect changes nothing; the usual value of a shaping parameter."""
        if self.usual is not None:
            return self.usual
        if self.ratio:
            return self.low
        return 0.0 if self.coefficient is None else float(theta[self.coefficient])

    def steps_to(self, value: float, theta: Theta) -> float:
        """Number of typical changes from neutral to ``value``."""
        if self.ratio:
            return math.log(value / self.neutral(theta)) / math.log(self.typical)
        return (value - self.neutral(theta)) / self.typical

    def after(self, steps: float, theta: Theta) -> float:
        """The value at ``steps`` typical changes from neutral: the inverse of ``steps_to``."""
        if self.ratio:
            return float(self.neutral(theta) * self.typical**steps)
        return self.neutral(theta) + steps * self.typical

    def typical_on(self, theta: Theta) -> float:
        """A change worth an alarm on a unit; flows and volumes scale with the unit's size."""
        volume = theta[c.PORT_VOLUME] + theta[c.LINE_VOLUME] + theta[c.VOLUME]
        of_usual = {"sl/min": theta[c.SUCTION] / USUAL_SUCTION, "ml": volume / USUAL_VOLUME}
        return self.typical * min(float(of_usual.get(self.unit, 1.0)), 1.0)

    def range(self, theta: Theta) -> tuple[float, float]:
        """The bounds of a change from neutral."""
        neutral = self.neutral(theta)
        return self.low - neutral, self.high - neutral

    def reported(self, change: float, theta: Theta) -> float | None:
        """An estimated change from neutral for people; None at or beyond a bound.

        At a bound the effect cannot explain the log: the bound itself is no estimate.
        """
        low, high = self.range(theta)
        return change if low < change < high else None


@dataclass(frozen=True)
class Law:
    """A shape of an effect that differs from unit to unit and that no healthy cycle shows.

    The data set's value, ``ejector.name``, holds for a well-known type. A diagnosis tries each
    value in ``tried``. Causes that differ under only one of these values count as look-alikes.
    """

    name: str
    coefficient: int
    tried: tuple[float, ...]


@dataclass(frozen=True)
class Effect:
    """One way in which an ejector differs, in words for maintenance, and where it acts.

    ``sentence`` describes it, ``look_at`` names the first thing to inspect, and ``often`` is its
    frequency over that of wear: weather is weekly, a sensor of steel and silicon hardly ever
    drifts. ``can_be_mended`` is False for weather and set-up: the live monitor gives them a small
    prior weight.
    """

    name: str
    sentence: str
    look_at: str
    parameters: tuple[Parameter, ...]
    act: Callable[..., None]  # (theta, one value per parameter) -> changes theta in place
    often: float = 1.0
    acts: Callable[[Theta], bool] = lambda _: True  # whether the effect can act on a unit
    law: Law | None = None
    can_be_mended: bool = True

    @cached_property
    def takes(self) -> frozenset[str]:
        """Names of its parameters and of its law."""
        law = [self.law.name] if self.law else []
        return frozenset([*(parameter.name for parameter in self.parameters), *law])

    @property
    def touches(self) -> frozenset[int]:
        """Numbers of the coefficients that its parameters change."""
        return frozenset(number for p in self.parameters for number in p.touches)

    @property
    def is_weather(self) -> bool:
        """Whether the effect is another ambient pressure.

        Its typical size is one sigma of the weather, and a barometer shows it.
        """
        return c.AMBIENT in self.touches

    def laws(self) -> list[dict[str, float]]:
        """The possible laws, as values beside those of the parameters."""
        return [{self.law.name: value} for value in self.law.tried] if self.law else [{}]

    def frequency(self, *, ambient_is_measured: bool) -> float:
        """Prior frequency over that of wear; small if the model follows the weather."""
        is_followed = ambient_is_measured and self.is_weather
        return min(self.often, 1.0) if is_followed else self.often


def _leakage(theta: Theta, flow: float) -> None:
    theta[c.LEAK] += flow * SL_MIN


def _porous_leakage(theta: Theta, flow: float) -> None:
    theta[c.LAMINAR_LEAK] += flow * SL_MIN / (600.0 * MBAR)


def _check_valve_leak(theta: Theta, flow: float) -> None:
    theta[c.BACK_FLOW] += flow * SL_MIN


def _suction_loss(theta: Theta, percent: float) -> None:
    theta[c.SUCTION] *= 1.0 - percent / 100.0
    narrower = 1.0 - theta[c.EXHAUST_FOLLOWS] * percent / 100.0
    theta[c.RELIEF] *= narrower
    theta[c.EXHAUST] *= narrower


def _end_vacuum_loss(theta: Theta, rise: float) -> None:
    moved = theta[c.END_MOVES] * rise * MBAR
    theta[c.MOVED] += moved
    theta[c.END_RATIO] += (rise * MBAR - moved) / theta[c.AMBIENT_NOMINAL]


def _supply_pressure_drop(theta: Theta, drop: float) -> None:
    theta[c.SUPPLY] -= drop * BAR
    rise = theta[c.END_SLOPE] * drop * BAR  # the plant adds it; the supply's own droop was fitted
    theta[c.END_RATIO] *= (1.0 + theta[c.END_FOLLOWS] * rise) / (1.0 + rise)


def _filter_clogging(theta: Theta, drop: float) -> None:
    more = c.resistance(theta, drop * MBAR)
    near = theta[c.FILTER_AT] > 0.0 or theta[c.PLACE] < theta[c.NEAR_RESISTANCE]
    theta[c.NEAR_RESISTANCE if near else c.RESISTANCE] += more
    theta[c.PLACE] += theta[c.FILTER_AT] * more


def _added_volume(theta: Theta, volume: float) -> None:
    theta[c.VOLUME] += volume * ML


def _cup_compliance(theta: Theta, volume: float) -> None:
    theta[c.COMPLIANCE] = min(theta[c.COMPLIANCE] + volume * ML, FLATTEST * theta[c.VOLUME])


def _heat_exchange(theta: Theta, film_coefficient: float) -> None:
    theta[c.FILM] = film_coefficient


def _response_delay(theta: Theta, delay: float) -> None:
    theta[[c.RESPONSE, c.RESPONSE_OFF]] += delay * MS


def _slow_ramp_up(theta: Theta, time_constant: float) -> None:
    theta[c.SLOW_RAMP_UP] += time_constant * MS


def _threshold_drift(theta: Theta, h1_shift: float, h2_shift: float) -> None:
    theta[c.H1] += h1_shift * MBAR
    theta[c.H1_LOW] += h2_shift * MBAR


def _saves_air(theta: Theta) -> bool:
    return bool(theta[c.AIR_SAVING] != c.OFF)


def _weak_blow_off(theta: Theta, percent: float) -> None:
    theta[c.BLOW_OFF] *= 1.0 - percent / 100.0


def _blow_off_delay(theta: Theta, delay: float) -> None:
    theta[[c.BLOW_OFF_RESPONSE, c.BLOW_OFF_RESPONSE_OFF]] += delay * MS


def _sensor_offset(theta: Theta, offset: float) -> None:
    theta[c.SENSOR_OFFSET] += offset * MBAR


def _sensor_gain(theta: Theta, percent: float) -> None:
    theta[c.SENSOR_GAIN] += percent / 100.0


def _sensor_lag(theta: Theta, time_constant: float) -> None:
    theta[c.SLOW_SENSOR] += time_constant * MS


def _ambient_pressure(theta: Theta, shift: float) -> None:
    theta[c.AMBIENT] += shift * MBAR
    # The absolute reading of a gauge sensor was calculated with the assumed ambient pressure.
    theta[c.SENSOR_OFFSET] -= theta[c.GAUGE] * shift * MBAR
    theta[[c.H1, c.H1_LOW]] += theta[c.H1_FOLLOWS] * shift * MBAR


_P = Parameter
_TABLE = (
    Effect(
        "leakage",
        "Air leaks in through an opening on the vacuum side",
        "hoses, fittings and cups: a cut, or a loose connection",
        (_P("sonic_flow", "sl/min", 0.0, 60.0, 1.0, (c.LEAK,), healthy_sigma=0.03),),
        _leakage,
    ),
    Effect(
        "porous_leakage",
        "Air seeps in through a porous part or seal, the more the higher the vacuum",
        "the part's surface and the sealing lips; try a dense part",
        (_P("flow_at_600mbar", "sl/min", 0.0, 60.0, 1.0, (c.LAMINAR_LEAK,)),),
        _porous_leakage,
    ),
    Effect(
        "check_valve_leak",
        "Air flows back through the ejector while its nozzle is off",
        "the ejector's check valve: dirt on its seat",
        (_P("sonic_flow", "sl/min", 0.0, 60.0, 1.0, (c.BACK_FLOW,)),),
        _check_valve_leak,
    ),
    Effect(
        "suction_loss",
        "The ejector moves less air at every vacuum: worn or dirty nozzle",
        "the nozzles and the silencer: clean or replace them",
        (_P("loss", "%", 0.0, 90.0, 10.0, (c.SUCTION, c.RELIEF, c.EXHAUST)),),
        _suction_loss,
        # A worn nozzle, or dirt in the tube that blow-off leaves through as well.
        law=Law("exhaust_follows", c.EXHAUST_FOLLOWS, (0.0, 1.0)),
    ),
    Effect(
        "end_vacuum_loss",
        "The highest vacuum it can reach is lower: worn receiver nozzle or clogged silencer",
        "the receiver nozzle for wear, the silencer for dirt",
        (_P("end_pressure_rise", "mbar", 0.0, 600.0, 20.0, (c.END_RATIO, c.MOVED)),),
        _end_vacuum_loss,
        # Of one stage the flow at ambient pressure stays. Of two the back pressure of a silencer
        # moves the second one, which has most of the flow: two rigs of momentum theory.
        law=Law("end_loss_moves", c.END_MOVES, (0.0, 1.0)),
    ),
    Effect(
        "supply_pressure_drop",
        "The operating pressure is too low: suction, end vacuum and blow-off weaken together",
        "the supply pressure at the ejector while its nozzle is on",
        (_P("drop", "bar", 0.0, 4.0, 0.4, (c.SUPPLY, c.END_RATIO), healthy_sigma=0.02),),
        _supply_pressure_drop,
        # One nozzle's end pressure hardly moves, another's doubles with a bar less: healthy cycles
        # are of one supply. Momentum theory of ejectors on the market has 0.1 to 2 per bar.
        law=Law("end_follows_supply", c.END_FOLLOWS, (1.0, 2.5, 6.0)),
    ),
    Effect(
        "filter_clogging",
        "A clogged filter throttles the flow between vessel and ejector",
        "the vacuum filter: clean or replace it",
        (
            _P(
                "pressure_drop_at_nominal",
                "mbar",
                0.0,
                800.0,
                40.0,
                (c.RESISTANCE, c.NEAR_RESISTANCE, c.PLACE),
            ),
        ),
        _filter_clogging,
        # In the line behind the sensor, or in the ejector with the sensor behind it.
        law=Law("filter_before_sensor", c.FILTER_AT, (0.0, 1.0)),
    ),
    Effect(
        "added_volume",
        "More volume than configured: a longer hose or a bigger cup",
        "hose length and cups against what is configured",
        (_P("volume", "ml", 0.0, 5000.0, 20.0, (c.VOLUME,)),),
        _added_volume,
    ),
    Effect(
        "cup_compliance",
        "The cups give way: their volume shrinks as vacuum rises",
        "the cups: worn, soft, or of another kind",
        (_P("volume_at_full_vacuum", "ml", 0.0, 100.0, 10.0, (c.COMPLIANCE,)),),
        _cup_compliance,
    ),
    Effect(
        "heat_exchange",
        "Heat passes between gas and wall at another rate than the data set says",
        "what changed about the vessel; if nothing did, calibrate again",
        # How the heat of the wall is shared between vessel and line is uncertain.
        (
            _P(
                "film_coefficient",
                "W/(m²·K)",
                0.0,
                500.0,
                5.0,
                (c.FILM,),
                coefficient=c.FILM,
                relative_error=0.1,
            ),
        ),
        _heat_exchange,
        can_be_mended=False,
    ),
    Effect(
        "response_delay",
        "The suction valve acts later",
        "the suction valve and the output that drives it",
        (
            _P(
                "delay",
                "ms",
                0.0,
                400.0,
                10.0,
                (c.RESPONSE, c.RESPONSE_OFF),
                healthy_sigma=0.5,
            ),
        ),
        _response_delay,
    ),
    Effect(
        "slow_ramp_up",
        "The jet takes longer to reach full suction",
        "the suction valve and the supply hose: something opens slowly",
        (_P("time_constant", "ms", 0.0, 400.0, 20.0, (c.SLOW_RAMP_UP,)),),
        _slow_ramp_up,
        # The jet grows with the valve's opening, or is full long before the valve is open.
        law=Law("jet_full_at", c.JET_FULL_AT, (1.0, 0.5, 0.2, 0.08)),
    ),
    Effect(
        "threshold_drift",
        "The switching points of the air saving moved",
        "the air saving's settings H1 and H2 in the ejector",
        (
            _P("h1_shift", "mbar", -200.0, 200.0, 20.0, (c.H1,), relative_error=READ_OFF),
            _P("h2_shift", "mbar", -200.0, 200.0, 20.0, (c.H1_LOW,), relative_error=READ_OFF),
        ),
        _threshold_drift,
        acts=_saves_air,
    ),
    Effect(
        "weak_blow_off",
        "The blow-off flow is too small",
        "the blow-off valve and its throttle screw",
        # A narrower valve on a rig, less flow in the model: they differ against a rising pressure.
        (_P("loss", "%", 0.0, 95.0, 20.0, (c.BLOW_OFF,), relative_error=0.15),),
        _weak_blow_off,
    ),
    Effect(
        "blow_off_delay",
        "The blow-off valve acts later",
        "the blow-off valve and the output that drives it",
        (
            _P(
                "delay",
                "ms",
                0.0,
                400.0,
                10.0,
                (c.BLOW_OFF_RESPONSE, c.BLOW_OFF_RESPONSE_OFF),
                healthy_sigma=0.5,
            ),
        ),
        _blow_off_delay,
    ),
    Effect(
        "sensor_offset",
        "The pressure sensor reads a constant amount off (positive: too much absolute pressure)",
        "the sensor's zero: what it reads while open to ambient",
        (_P("offset", "mbar", -200.0, 200.0, 8.0, (c.SENSOR_OFFSET,), relative_error=READ_OFF),),
        _sensor_offset,
        SELDOM,
    ),
    Effect(
        "sensor_gain",
        "The span of the pressure sensor is off (positive: it reads too much vacuum)",
        "the sensor's span: compare it with a gauge at high vacuum",
        (_P("error", "%", -30.0, 30.0, 2.0, (c.SENSOR_GAIN,), relative_error=READ_OFF),),
        _sensor_gain,
        SELDOM,
    ),
    Effect(
        "sensor_lag",
        "The pressure sensor is slow, or its tube is long",
        "the sensor's tube for length, water and dirt, and its filter setting",
        (_P("time_constant", "ms", 0.0, 400.0, 20.0, (c.SLOW_SENSOR,)),),
        _sensor_lag,
    ),
    Effect(
        "ambient_pressure",
        "Ambient pressure differs from the data set: weather or altitude",
        "today's air pressure against that of the data set",
        (
            _P(
                "shift",
                "mbar",
                -300.0,
                100.0,
                15.0,
                (c.AMBIENT, c.SENSOR_OFFSET, c.H1, c.H1_LOW),
                relative_error=READ_OFF,
            ),
        ),
        _ambient_pressure,
        WEEKLY,
        # The ejector's own sensor counts from ambient pressure, or from zero.
        law=Law("h1_follows_ambient", c.H1_FOLLOWS, (0.0, 1.0)),
        can_be_mended=False,
    ),
)

EFFECTS: Mapping[str, Effect] = {effect.name: effect for effect in _TABLE}


def standing_for(coefficient: int) -> tuple[Effect, Parameter]:
    """The effect of the table, with its parameter, that changes a coefficient.

    StopIteration if there is none.
    """
    return next(
        (effect, parameter)
        for effect in _TABLE
        for parameter in effect.parameters
        if parameter.touches[:1] == (coefficient,)
    )


WEATHER = standing_for(c.AMBIENT)[0].name  # the effect that ``is_weather``

_BESIDE: dict[str, Effect] = {}  # effects beside the table, by name


def add_beside(effects: Mapping[str, Effect]) -> None:
    """Register effects beside the table by name; the search for causes skips them."""
    _BESIDE.update(effects)


def find_effect(name: str) -> Effect | None:
    """The effect of a name, in the table or beside it; None if it is unknown."""
    return EFFECTS.get(name) or _BESIDE.get(name)


def effect_of(name: str) -> Effect:
    """The effect of a name, in the table or beside it; ConfigError if it is unknown."""
    effect = find_effect(name)
    if effect is None:
        raise ConfigError(f"unknown effect {name!r}", "twin effects lists them")
    return effect


def acting_on(theta: Theta) -> list[Effect]:
    """The effects of the table that can act on a unit; the others are no hypotheses."""
    return [effect for effect in _TABLE if effect.acts(theta)]


def apply(theta: Theta, name: str, values: Mapping[str, float]) -> Theta:
    """Return ``theta`` with an effect at the given parameter values (missing ones neutral).

    ``values`` may contain a law; without one, the data set's law applies.
    Raises ConfigError for an unknown effect or parameter and for a value out of bounds.
    """
    effect = effect_of(name)
    if not values.keys() <= effect.takes:
        unknown = ", ".join(sorted(values.keys() - effect.takes))
        raise ConfigError(f"{name} has no parameter {unknown}", f"has {set(effect.takes)}")
    sizes = [
        values[parameter.name] if parameter.name in values else parameter.neutral(theta)
        for parameter in effect.parameters
    ]
    for parameter, size in zip(effect.parameters, sizes, strict=True):
        if not parameter.low <= size <= parameter.high:
            raise ConfigError(
                f"{name}.{parameter.name} = {size} {parameter.unit} is out of bounds",
                f"between {parameter.low} and {parameter.high}",
            )
    changed = theta.copy()
    if effect.law and effect.law.name in values:
        changed[effect.law.coefficient] = values[effect.law.name]
    effect.act(changed, *sizes)
    return changed


def table(line_break: str = "<br>") -> str:
    """The table of effects in Markdown, for the README.

    ``line_break`` separates the parameters of an effect; tables of Markdown have none.
    """
    lines = ["| effect | what it means | parameters |", "| --- | --- | --- |"]
    for effect in EFFECTS.values():
        numbers = line_break.join(
            f"`{p.name}` {p.low:g} to {p.high:g} {p.unit}" for p in effect.parameters
        )
        lines.append(f"| `{effect.name}` | {effect.sentence} | {numbers} |")
    return "\n".join(lines)
