"""Mechanisms, which act beside the table of effects: coefficients that change under a condition.

A mechanism has a *place* (a coefficient: a flow into the vessel, a share of suction, a volume, the
sensor), a *condition* (always, while the nozzle runs, above a vacuum, in a rhythm) and a *speed*
(at once, or setting in and fading with time constants, like ice, water and warmth). Its share runs
from 0 to 1; the coefficient changes by ``SIZE`` times the share. A mechanism has a state, so it
holds for every program of commands.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeVar

from twin.errors import ConfigError
from twin.model import theta as c
from twin.model.effects import FLATTEST, Effect, Parameter, add_beside
from twin.model.theta import Theta
from twin.signals import BAR, MBAR, ML, SL_MIN

_Value = TypeVar("_Value", float, str)  # of a parameter: a number, or its expression in C

SLOTS = 2  # number of mechanisms that can act at once
# Offsets of a mechanism's coefficients from ``c.MECHANISMS`` on; each mechanism has WIDTH of them.
ON, SIZE, ALSO_ON, ALSO_SIZE, WHEN, BEGINS, ENDS, SETS_IN, FADES, PERIOD, SHIFT, DUTY = range(12)
WIDTH = (len(c.COEFFICIENTS) - c.MECHANISMS) // SLOTS
# When it acts: always; while the nozzle runs; while it does not; in blow-off; above one vacuum
# until below another; in proportion to the vacuum above a threshold; gathered while the nozzle runs
# and cleared by blow-off; renewed at ambient pressure and used up by vacuum; to and fro in a rhythm
# of its own; on and off in one.
(
    ALWAYS,
    NOZZLE_ON,
    NOZZLE_OFF,
    BLOWING,
    ABOVE,
    BEYOND,
    GATHERED,
    USED_UP,
    SWINGING,
    PULSED,
) = range(10)
RHYTHMIC = (SWINGING, PULSED)  # with a period and a phase, which no command sets


@dataclass(frozen=True)
class Place:
    """Where a mechanism acts: one or two coefficients, each with a size in the field's unit.

    ``si`` converts a size into the change of its coefficient (SI); it is translated into C for
    FMUs, so it is plain arithmetic. ``sentence`` is completed by the sizes and by the condition;
    ``words`` name the coefficients in a formula.
    """

    name: str
    coefficients: tuple[int, ...]
    parameters: tuple[Parameter, ...]
    si: tuple[Callable[[Theta, float], float], ...]
    sentence: str
    words: tuple[str, ...]


@dataclass(frozen=True)
class When:
    """When and how fast a mechanism acts: a code of the kernel, with parameters beside the sizes.

    ``starts`` are starting points of a search, each with one value for each of the ``parameters``.
    """

    name: str
    code: int
    parameters: tuple[Parameter, ...]
    starts: tuple[tuple[float, ...], ...]
    sentence: str  # sentence with the parameters' values
    formula: str
    briefly: str = ""  # the sentence without values, if it has some


# --- sizes in SI ---------------------------------------------------------------------------------


def _flowing(_theta: Theta, flow: float) -> float:
    return flow * SL_MIN


def _seeping(_theta: Theta, flow: float) -> float:
    return flow * SL_MIN / (600.0 * MBAR)


def _less_suction(theta: Theta, loss: float) -> float:
    return -loss / 100.0 * float(theta[c.SUCTION])


def _higher_end(theta: Theta, rise: float) -> float:
    return rise * MBAR / float(theta[c.AMBIENT_NOMINAL])


def _less_supply(_theta: Theta, drop: float) -> float:
    return -drop * BAR


def _less_blow_off(theta: Theta, loss: float) -> float:
    return -loss / 100.0 * float(theta[c.BLOW_OFF])


def _yielding(_theta: Theta, volume: float) -> float:
    return volume * ML


def _narrower(theta: Theta, drop: float) -> float:
    more = c.resistance(theta, abs(drop) * MBAR)
    return -more if drop < 0.0 else more


def _film(_theta: Theta, film: float) -> float:
    return film


def _offset(_theta: Theta, offset: float) -> float:
    return offset * MBAR


# --- the grammar ---------------------------------------------------------------------------------

_P = Parameter
_BEGINS = _P("begins", "mbar", 20.0, 900.0, 40.0)
_BELOW = _P("ends_below", "mbar", 1.0, 400.0, 2.0, ratio=True)
_SETS_IN = _P("sets_in", "s", 0.02, 600.0, 1.5, ratio=True)
_FADES = _P("fades", "s", 0.02, 600.0, 1.5, ratio=True)
# Of a rhythm: the clock of the rows shows it, and no equation of the plant has a part in it.
_PERIOD = _P("period", "s", 0.2, 120.0, 1.1, ratio=True, relative_error=0.0)
_SHIFT = _P("shift", "s", 0.0, 120.0, 0.2, is_of_the_log=True, relative_error=0.0)
_DUTY = _P("duty", "%", 2.0, 98.0, 5.0, relative_error=0.0)

PLACES = {
    place.name: place
    for place in (
        Place(
            "inflow",
            (c.INFLOW,),
            (_P("flow", "sl/min", -30.0, 60.0, 1.0),),
            (_flowing,),
            "air or vapour flows into the vacuum side at a rate of its own",
            ("inflow",),
        ),
        Place(
            "port",
            (c.PORT_INFLOW,),
            (_P("flow", "sl/min", 0.0, 60.0, 1.0),),
            (_flowing,),
            "air flows into the port of the ejector at a rate of its own",
            ("inflow at the port",),
        ),
        Place(
            "opening",
            (c.LEAK,),
            (_P("sonic_flow", "sl/min", -30.0, 60.0, 1.0),),
            (_flowing,),
            "an opening to ambient on the vacuum side",
            ("opening",),
        ),
        Place(
            "seepage",
            (c.LAMINAR_LEAK,),
            (_P("flow_at_600mbar", "sl/min", -30.0, 60.0, 1.0),),
            (_seeping,),
            "air seeps in, the more the higher the vacuum",
            ("seepage",),
        ),
        Place(
            "suction",
            (c.SUCTION,),
            (_P("loss", "%", -50.0, 90.0, 10.0),),
            (_less_suction,),
            "the ejector moves less air",
            ("suction capacity",),
        ),
        Place(
            "end_pressure",
            (c.END_RATIO,),
            (_P("end_pressure_rise", "mbar", -200.0, 600.0, 20.0),),
            (_higher_end,),
            "the highest vacuum that the ejector can reach is lower",
            ("end pressure",),
        ),
        Place(
            "nozzle",
            (c.SUCTION, c.END_RATIO),
            (
                _P("loss", "%", -50.0, 90.0, 10.0),
                _P("end_pressure_rise", "mbar", -200.0, 600.0, 20.0),
            ),
            (
                _less_suction,
                _higher_end,
            ),
            "the nozzle gives less: the ejector moves less air and reaches less vacuum",
            ("suction capacity", "end pressure"),
        ),
        Place(
            "supply",
            (c.SUPPLY,),
            (_P("drop", "bar", -2.0, 4.0, 0.4),),
            (_less_supply,),
            "the operating pressure is lower",
            ("operating pressure",),
        ),
        Place(
            "blow_off",
            (c.BLOW_OFF,),
            (_P("loss", "%", -100.0, 95.0, 20.0),),
            (_less_blow_off,),
            "the blow-off flow is smaller",
            ("blow-off flow",),
        ),
        Place(
            "volume",
            (c.COMPLIANCE,),
            (_P("volume_at_full_vacuum", "ml", -100.0, 1000.0, 10.0),),
            (_yielding,),
            "the volume gives way under vacuum",
            ("volume that gives way",),
        ),
        Place(
            "line",
            (c.RESISTANCE,),
            (_P("pressure_drop_at_nominal", "mbar", -400.0, 800.0, 40.0),),
            (_narrower,),
            "the line between ejector and vessel is narrower",
            ("pressure drop of the line",),
        ),
        Place(
            "heat",
            (c.FILM,),
            (_P("film_coefficient", "W/(m²·K)", -100.0, 300.0, 5.0),),
            (_film,),
            "heat passes faster between gas and wall",
            ("heat transfer",),
        ),
        Place(
            "sensor",
            (c.SENSOR_OFFSET,),
            (_P("offset", "mbar", -200.0, 200.0, 8.0),),
            (_offset,),
            "the pressure sensor reads too high",
            ("sensor offset",),
        ),
    )
}

WHENS = {
    when.name: when
    for when in (
        When("always", ALWAYS, (), ((),), "all the time", "share = 1"),
        When(
            "warming_up",
            ALWAYS,
            (_SETS_IN,),
            ((10.0,), (60.0,)),
            "which sets in over {sets_in}",
            "d share/dt = (1 - share) / {sets_in}",
            "which sets in slowly",
        ),
        When(
            "nozzle_on",
            NOZZLE_ON,
            (),
            ((),),
            "while the nozzle runs",
            "share = jet",
        ),
        When(
            "nozzle_on_slowly",
            NOZZLE_ON,
            (_SETS_IN, _FADES),
            (
                (0.3, 0.3),
                (1.0, 1.0),
                (3.0, 3.0),
                (10.0, 10.0),
                (40.0, 40.0),
                (2.0, 20.0),
                (20.0, 2.0),
            ),
            "which builds up over {sets_in} while the nozzle runs and goes back over {fades}"
            " while it does not",
            "d share/dt = jet (1 - share) / {sets_in} - (1 - jet) share / {fades}",
            "which builds up while the nozzle runs and goes back while it does not",
        ),
        When(
            "nozzle_off",
            NOZZLE_OFF,
            (),
            ((),),
            "while the nozzle is off",
            "share = 1 - jet",
        ),
        When(
            "in_blow_off",
            BLOWING,
            (),
            ((),),
            "during blow-off",
            "share = blow-off valve",
        ),
        When(
            "above",
            ABOVE,
            (_BEGINS, _BELOW),
            tuple(
                (level, gap)
                for level in (150.0, 300.0, 450.0, 600.0, 700.0)
                for gap in (10.0, 120.0)
            ),
            "above {begins} of vacuum, until it is {ends_below} below that",
            "share = 1 from {begins} of vacuum on, until {ends_below} below that; else 0",
            "above some vacuum, until it has fallen well below that",
        ),
        When(
            "beyond",
            BEYOND,
            (_BEGINS,),
            ((20.0,), (200.0,), (400.0,), (550.0,), (680.0,)),
            "the more the higher the vacuum is above {begins}",
            "share = (vacuum - {begins}) / (ambient - {begins}), at least 0",
            "the more the higher the vacuum is above some value",
        ),
        When(
            "beyond_slowly",
            BEYOND,
            (_BEGINS, _SETS_IN),
            ((20.0, 0.5), (20.0, 2.0), (20.0, 8.0), (400.0, 1.0)),
            "the more the higher the vacuum is above {begins}, with a delay of {sets_in}",
            "d share/dt = ((vacuum - {begins}) / (ambient - {begins}) - share) / {sets_in}",
            "the more the higher the vacuum is above some value, with a delay",
        ),
        When(
            "gathered",
            GATHERED,
            (_SETS_IN, _FADES),
            ((0.5, 0.1), (2.0, 0.1), (10.0, 0.1), (10.0, 1.0), (40.0, 1.0)),
            "which gathers over {sets_in} while the nozzle runs and is cleared by blow-off"
            " over {fades}",
            "d share/dt = jet (1 - share) / {sets_in} - blow-off share / {fades}",
            "which gathers while the nozzle runs and is cleared by blow-off",
        ),
        When(
            "used_up",
            USED_UP,
            (_SETS_IN, _FADES),
            ((0.1, 0.2), (0.1, 1.0), (1.0, 1.0), (5.0, 5.0)),
            "which vacuum uses up over {fades} and ambient pressure renews over {sets_in}",
            "d share/dt = pressure (1 - share) / {sets_in} - vacuum share / {fades}, of ambient",
            "which vacuum uses up and ambient pressure renews",
        ),
        When(
            "swinging",
            SWINGING,
            (_PERIOD, _SHIFT),
            tuple(
                (period, period * share)
                for period in (0.5, 0.8, 1.3, 2.0, 3.2, 5.0, 8.0, 13.0, 20.0)
                for share in (0.0, 0.25)
            ),
            "to and fro with a period of {period}",
            "share = sin(2 pi (t - {shift}) / {period}), with t from the first row evaluated",
            "to and fro",
        ),
        When(
            "pulsed",
            PULSED,
            (_PERIOD, _DUTY, _SHIFT),
            ((1.3, 40.0, 0.0),),
            "on and off with a period of {period}, on for {duty} of it",
            "share = 1 while (t - {shift}) modulo {period} is below {duty} of {period}; else 0,"
            " with t from the first row evaluated",
            "on and off in a rhythm of its own",
        ),
    )
}
_SIGNED = {c.INFLOW, c.SENSOR_OFFSET}  # coefficients that may be negative
# Conditions that only some places have. At other places, mechanisms that always act are effects of
# the table; a period comes from a compressor or from another consumer.
_ONLY = {
    "always": {"inflow", "port"},
    "swinging": {"supply", "inflow"},
    "pulsed": {"supply", "inflow"},
}
# Conditions that a place lacks, because a log would not show them, or because it is told there by
# an effect or by another place: only a valve that never closes lets air into the port.
_NOT = {
    "port": set(WHENS) - {"always"},
    "nozzle": {"nozzle_off", "in_blow_off"},
    "blow_off": {"nozzle_on", "nozzle_off", "nozzle_on_slowly", "above", "used_up"},
    "suction": {"nozzle_off", "in_blow_off"},
    "end_pressure": {"nozzle_off", "in_blow_off"},
}


@dataclass(frozen=True)
class Mechanism:
    """A place with a condition: an effect beside the table."""

    place: Place
    when: When

    @property
    def name(self) -> str:
        """Its name in data sets and answers."""
        return f"{self.place.name}_{self.when.name}"

    @property
    def _capitalised_sentence(self) -> str:
        return self.place.sentence[0].upper() + self.place.sentence[1:]

    @property
    def effect(self) -> Effect:
        """The mechanism as an effect, with its sizes and its other parameters."""
        return Effect(
            self.name,
            f"{self._capitalised_sentence}: {self.when.name}",
            "",
            (*self.place.parameters, *self.when.parameters),
            self._act,
        )

    def sentence(self, values: Mapping[str, float]) -> str:
        """A sentence that describes the mechanism with its values."""
        sizes = ", ".join(_value_text(parameter, values) for parameter in self.place.parameters)
        condition = self.when.sentence.format(**self._value_texts(values))
        return f"{self._capitalised_sentence} ({sizes}), {condition}"

    def formula(self, values: Mapping[str, float]) -> str:
        """The changed coefficients, and the equation of the share."""
        added = "; ".join(
            f"{words} changes by {_value_text(parameter, values)} times the share"
            for words, parameter in zip(self.place.words, self.place.parameters, strict=True)
        )
        return f"{added}; {self.when.formula.format(**self._value_texts(values))}"

    def _value_texts(self, values: Mapping[str, float]) -> Mapping[str, str]:
        return {
            parameter.name: f"{values[parameter.name]:.3g} {parameter.unit}"
            for parameter in self.when.parameters
        }

    def _act(self, theta: Theta, *values: float) -> None:
        """Fill the first free slot. ConfigError if there is none."""
        first = next(_free_slots(theta), None)
        if first is None:
            raise ConfigError(
                f"{self.name}: {SLOTS} mechanisms act already, and more cannot act at once",
                "calibrate the unit anew, or take one of them out of its data set",
            )
        sizes = zip(self.place.coefficients, self.place.si, values, strict=False)
        by_name = dict(
            zip((parameter.name for parameter in self.effect.parameters), values, strict=True)
        )
        for where, (coefficient, si, value) in zip((ON, ALSO_ON), sizes, strict=False):
            theta[first + where] = coefficient
            theta[first + where + 1] = limit_of(coefficient)(theta, coefficient, si(theta, value))
        theta[first + WHEN] = self.when.code
        set_condition(theta, first, *self.condition(by_name, 0.0))
        set_rhythm(theta, first, *self.rhythm(by_name, 0.0))

    def condition(self, values: Mapping[str, _Value], zero: _Value) -> tuple[_Value, ...]:
        """Last arguments of ``set_condition``; ``zero`` where it has no such parameter.

        What has no fading time of its own fades as it sets in.
        """
        sets_in = values.get("sets_in", zero)
        return (
            values.get("begins", zero),
            values.get("ends_below", zero),
            sets_in,
            values.get("fades", sets_in),
        )

    def rhythm(self, values: Mapping[str, _Value], zero: _Value) -> tuple[_Value, ...]:
        """Last arguments of ``set_rhythm``; ``zero`` where it has no such parameter."""
        return tuple(values.get(name, zero) for name in ("period", "shift", "duty"))


def set_condition(
    theta: Theta,
    first: int,
    begins: float,
    ends_below: float,
    sets_in: float,
    fades: float,
) -> None:
    """Set the levels (mbar) and time constants (s) of the slot at ``first``.

    Plain arithmetic: it is translated into C for FMUs.
    """
    theta[first + BEGINS] = begins * MBAR
    theta[first + ENDS] = max(begins - ends_below, 1.0) * MBAR
    theta[first + SETS_IN] = sets_in
    theta[first + FADES] = fades


def set_rhythm(theta: Theta, first: int, period: float, shift: float, duty: float) -> None:
    """Set period and shift (s) and duty (%) of the slot at ``first``; a period of 0 is none.

    Plain arithmetic: it is translated into C for FMUs.
    """
    theta[first + PERIOD] = period if period > 0.0 else 1.0
    theta[first + SHIFT] = shift
    theta[first + DUTY] = duty / 100.0


def slot_at(number: int) -> int:
    """Index of the first coefficient of a slot, which count from 0."""
    return c.MECHANISMS + number * WIDTH


def _free_slots(theta: Theta) -> Iterator[int]:
    """Index of the first coefficient of each free slot."""
    for begin in range(c.MECHANISMS, len(c.COEFFICIENTS), WIDTH):
        if not theta[[begin + SIZE, begin + ALSO_SIZE]].any():
            yield begin


def free_slots(theta: Theta) -> int:
    """Number of free slots for further mechanisms."""
    return sum(1 for _ in _free_slots(theta))


Limit = Callable[[Theta, int, float], float]  # of the change of a coefficient (SI)


def limit_of(coefficient: int) -> Limit:
    """What limits a change: no flow, share or volume is negative, and no cup vanishes."""
    if coefficient == c.COMPLIANCE:
        return _some_volume_left
    return _any_change if coefficient in _SIGNED else _not_negative


def _any_change(_theta: Theta, _coefficient: int, added: float) -> float:
    return added


def _not_negative(theta: Theta, coefficient: int, added: float) -> float:
    return max(added, -float(theta[coefficient]))


def _some_volume_left(theta: Theta, coefficient: int, added: float) -> float:
    room = FLATTEST * float(theta[c.VOLUME]) - float(theta[coefficient])
    return max(min(added, room), -float(theta[coefficient]))


def _value_text(parameter: Parameter, values: Mapping[str, float]) -> str:
    return f"{parameter.name.replace('_', ' ')} {values[parameter.name]:.3g} {parameter.unit}"


MECHANISMS = {
    mechanism.name: mechanism
    for place in PLACES.values()
    for when in WHENS.values()
    if when.name not in _NOT.get(place.name, set()) and place.name in _ONLY.get(when.name, PLACES)
    for mechanism in (Mechanism(place, when),)
}
add_beside({name: mechanism.effect for name, mechanism in MECHANISMS.items()})


def places_table() -> str:
    """The table of places of mechanisms, in Markdown."""
    lines = ["| where | what it does | sizes |", "| --- | --- | --- |"]
    for place in PLACES.values():
        lines.append(f"| `{place.name}` | {place.sentence} | {_listed(place.parameters)} |")
    return "\n".join(lines)


def whens_table() -> str:
    """The table of conditions and speeds of mechanisms, in Markdown."""
    lines = ["| when | what it means | what is to be known |", "| --- | --- | --- |"]
    for when in WHENS.values():
        words = when.sentence.replace("{", "`").replace("}", "`")
        lines.append(f"| `{when.name}` | {words} | {_listed(when.parameters) or '–'} |")
    return "\n".join(lines)


def _listed(parameters: tuple[Parameter, ...]) -> str:
    return "<br>".join(f"`{p.name}` {p.low:g} to {p.high:g} {p.unit}" for p in parameters)
