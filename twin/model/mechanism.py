"""What acts beside the table of effects: a coefficient that changes while something is the case.

A mechanism says *where* it acts (a coefficient: a flow into the vessel, a share of suction, a
volume, the sensor), *when* (always, while the nozzle runs, from a vacuum on, periodically) and
*how* (at once, or setting in and fading with time constants: ice, water, warmth). It acts by a
share from 0 to 1, ``set_in``; the coefficient is what it is without, plus ``SIZE`` times that
share. So it has a state, and holds for every program of commands.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from twin.errors import ConfigError
from twin.model import theta as c
from twin.model.effects import FLATTEST, Effect, Parameter, add_beside
from twin.model.theta import Theta
from twin.signals import BAR, MBAR, ML, SL_MIN

SLOTS = 2  # mechanisms that can act at once
# Coefficients of one mechanism, from ``c.MECHANISMS`` on; each has WIDTH of them.
ON, SIZE, ALSO_ON, ALSO_SIZE, WHEN, BEGINS, ENDS, SETS_IN, FADES, PERIOD, SHIFT = range(11)
WIDTH = (len(c.COEFFICIENTS) - c.MECHANISMS) // SLOTS
# When it acts: always; while the nozzle runs, or does not; in blow-off; from a vacuum on, until it
# is below another; the more the higher the vacuum is above one; gathered while the nozzle runs and
# cleared by blow-off; all the time but where the vacuum used it up; to and fro.
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
) = range(9)


@dataclass(frozen=True)
class Place:
    """Where a mechanism acts: coefficients, each with a size in the field's unit and its bounds.

    ``si`` turns a size into what is added to its coefficient; there is one, or two of them that
    move together. ``sentence`` is completed by the sizes and by when it acts; ``words`` stand in a
    formula.
    """

    name: str
    coefficients: tuple[int, ...]
    parameters: tuple[Parameter, ...]
    si: tuple[Callable[[Theta, float], float], ...]
    sentence: str
    words: tuple[str, ...]


@dataclass(frozen=True)
class When:
    """When and how a mechanism acts: a code of the kernel, and what is to be known beside a size.

    ``starts`` are values to begin a search from, one for each of the ``parameters``.
    """

    name: str
    code: int
    parameters: tuple[Parameter, ...]
    starts: tuple[tuple[float, ...], ...]
    sentence: str  # with the parameters' values
    formula: str
    briefly: str = ""  # the same without values, where the sentence has some


_P = Parameter
_BEGINS = _P("begins", "mbar", 20.0, 900.0, 40.0)
_BELOW = _P("ends_below", "mbar", 1.0, 400.0, 2.0, ratio=True)
_SETS_IN = _P("sets_in", "s", 0.02, 600.0, 1.5, ratio=True)
_FADES = _P("fades", "s", 0.02, 600.0, 1.5, ratio=True)
_PERIOD = _P("period", "s", 0.2, 120.0, 1.1, ratio=True)
_SHIFT = _P("shift", "s", 0.0, 120.0, 0.2)

PLACES = {
    place.name: place
    for place in (
        Place(
            "inflow",
            (c.INFLOW,),
            (_P("flow", "sl/min", -30.0, 60.0, 1.0),),
            (lambda _, flow: flow * SL_MIN,),
            "air or vapour flows into the vacuum side at a rate of its own",
            ("inflow",),
        ),
        Place(
            "opening",
            (c.LEAK,),
            (_P("sonic_flow", "sl/min", -30.0, 60.0, 1.0),),
            (lambda _, flow: flow * SL_MIN,),
            "an opening to ambient on the vacuum side",
            ("opening",),
        ),
        Place(
            "seepage",
            (c.LAMINAR_LEAK,),
            (_P("flow_at_600mbar", "sl/min", -30.0, 60.0, 1.0),),
            (lambda _, flow: flow * SL_MIN / (600.0 * MBAR),),
            "air seeps in, the more the higher the vacuum",
            ("seepage",),
        ),
        Place(
            "suction",
            (c.SUCTION,),
            (_P("loss", "%", -50.0, 90.0, 10.0),),
            (lambda theta, loss: -loss / 100.0 * float(theta[c.SUCTION]),),
            "the ejector moves less air",
            ("suction capacity",),
        ),
        Place(
            "end_pressure",
            (c.END_RATIO,),
            (_P("end_pressure_rise", "mbar", -200.0, 600.0, 20.0),),
            (lambda theta, rise: rise * MBAR / float(theta[c.AMBIENT_NOMINAL]),),
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
                lambda theta, loss: -loss / 100.0 * float(theta[c.SUCTION]),
                lambda theta, rise: rise * MBAR / float(theta[c.AMBIENT_NOMINAL]),
            ),
            "the nozzle gives less: the ejector moves less air and reaches less vacuum",
            ("suction capacity", "end pressure"),
        ),
        Place(
            "supply",
            (c.SUPPLY,),
            (_P("drop", "bar", -2.0, 4.0, 0.4),),
            (lambda _, drop: -drop * BAR,),
            "the operating pressure is lower",
            ("operating pressure",),
        ),
        Place(
            "blow_off",
            (c.BLOW_OFF,),
            (_P("loss", "%", -100.0, 95.0, 20.0),),
            (lambda theta, loss: -loss / 100.0 * float(theta[c.BLOW_OFF]),),
            "the blow-off flow is smaller",
            ("blow-off flow",),
        ),
        Place(
            "volume",
            (c.COMPLIANCE,),
            (_P("volume_at_full_vacuum", "ml", -100.0, 1000.0, 10.0),),
            (lambda _, volume: volume * ML,),
            "the volume gives way under vacuum",
            ("volume that gives way",),
        ),
        Place(
            "line",
            (c.RESISTANCE,),
            (_P("pressure_drop_at_nominal", "mbar", -400.0, 800.0, 40.0),),
            (lambda theta, drop: math.copysign(c.resistance(theta, abs(drop) * MBAR), drop),),
            "the line between ejector and vessel is narrower",
            ("pressure drop of the line",),
        ),
        Place(
            "heat",
            (c.FILM,),
            (_P("film_coefficient", "W/(m²·K)", -100.0, 300.0, 5.0),),
            (lambda _, film: film,),
            "heat passes faster between gas and wall",
            ("heat transfer",),
        ),
        Place(
            "sensor",
            (c.SENSOR_OFFSET,),
            (_P("offset", "mbar", -200.0, 200.0, 8.0),),
            (lambda _, offset: offset * MBAR,),
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
            "share = sin(2 pi (t - {shift}) / {period})",
            "to and fro",
        ),
    )
}
_SIGNED = {c.INFLOW, c.SENSOR_OFFSET}  # coefficients that may be negative
# What is combined with these places alone: others that act always are effects of the table, and
# only these have a rhythm of their own, by a compressor or another consumer.
_ONLY = {"always": {"inflow"}, "swinging": {"supply", "inflow"}}
# What a place is not combined with, as nothing would be seen of it.
_NOT = {
    "nozzle": {"nozzle_off", "in_blow_off"},
    "blow_off": {"nozzle_on", "nozzle_off", "nozzle_on_slowly", "above", "used_up"},
    "suction": {"nozzle_off", "in_blow_off"},
    "end_pressure": {"nozzle_off", "in_blow_off"},
}


@dataclass(frozen=True)
class Mechanism:
    """A place with when it acts there: an effect beside the table."""

    place: Place
    when: When

    @property
    def name(self) -> str:
        """As a data set and an answer have it."""
        return f"{self.place.name}_{self.when.name}"

    @property
    def _begin(self) -> str:
        return self.place.sentence[0].upper() + self.place.sentence[1:]

    @property
    def effect(self) -> Effect:
        """The effect that it is, with a size and what else is to be known."""
        return Effect(
            self.name,
            f"{self._begin}: {self.when.name}",
            "",
            (*self.place.parameters, *self.when.parameters),
            self._act,
        )

    def sentence(self, values: Mapping[str, float]) -> str:
        """What it does, in words, with its values."""
        sizes = ", ".join(_told(one, values) for one in self.place.parameters)
        return f"{self._begin} ({sizes}), {self.when.sentence.format(**self._shown(values))}"

    def formula(self, values: Mapping[str, float]) -> str:
        """What it adds in the model, and how the share of that runs."""
        added = "; ".join(
            f"{words} changes by {_told(one, values)} times the share"
            for words, one in zip(self.place.words, self.place.parameters, strict=True)
        )
        return f"{added}; {self.when.formula.format(**self._shown(values))}"

    def _shown(self, values: Mapping[str, float]) -> Mapping[str, str]:
        return {one.name: f"{values[one.name]:.3g} {one.unit}" for one in self.when.parameters}

    def _act(self, theta: Theta, *values: float) -> None:
        """Take the first slot that is free. ConfigError where there is none."""
        first = next(_free(theta), None)
        if first is None:
            raise ConfigError(
                f"{self.name}: {SLOTS} mechanisms act already, and more cannot act at once",
                "calibrate the unit anew, or take one of them out of its data set",
            )
        sizes = zip(self.place.coefficients, self.place.si, values, strict=False)
        told = dict(zip((one.name for one in self.effect.parameters), values, strict=True))
        sets_in = told.get("sets_in", 0.0)
        begin = told.get("begins", 0.0)
        for where, (coefficient, si, value) in zip((ON, ALSO_ON), sizes, strict=False):
            theta[first + where] = coefficient
            theta[first + where + 1] = _kept(theta, coefficient, si(theta, value))
        theta[first + WHEN] = self.when.code
        theta[first + BEGINS] = begin * MBAR
        theta[first + ENDS] = max(begin - told.get("ends_below", 0.0), 1.0) * MBAR
        theta[first + SETS_IN] = sets_in
        theta[first + FADES] = told.get("fades", sets_in)
        theta[first + PERIOD] = told.get("period", 1.0)
        theta[first + SHIFT] = told.get("shift", 0.0)


def _free(theta: Theta) -> Iterator[int]:
    """Where the coefficients of each slot begin in which nothing acts."""
    for begin in range(c.MECHANISMS, len(c.COEFFICIENTS), WIDTH):
        if not theta[[begin + SIZE, begin + ALSO_SIZE]].any():
            yield begin


def free_slots(theta: Theta) -> int:
    """How many mechanisms more can act."""
    return sum(1 for _ in _free(theta))


def _kept(theta: Theta, coefficient: int, added: float) -> float:
    """What may be added: no flow, share or volume is negative, and cups do not vanish."""
    known = float(theta[coefficient])
    if coefficient == c.COMPLIANCE:
        added = min(added, FLATTEST * float(theta[c.VOLUME]) - known)
    return added if coefficient in _SIGNED else max(added, -known)


def _told(one: Parameter, values: Mapping[str, float]) -> str:
    return f"{one.name.replace('_', ' ')} {values[one.name]:.3g} {one.unit}"


MECHANISMS = {
    one.name: one
    for place in PLACES.values()
    for when in WHENS.values()
    if when.name not in _NOT.get(place.name, set()) and place.name in _ONLY.get(when.name, PLACES)
    for one in (Mechanism(place, when),)
}
add_beside({name: one.effect for name, one in MECHANISMS.items()})


def places_table() -> str:
    """Where mechanisms act, in Markdown."""
    lines = ["| where | what it does | sizes |", "| --- | --- | --- |"]
    for place in PLACES.values():
        lines.append(f"| `{place.name}` | {place.sentence} | {_listed(place.parameters)} |")
    return "\n".join(lines)


def whens_table() -> str:
    """When and how mechanisms act, in Markdown."""
    lines = ["| when | what it means | what is to be known |", "| --- | --- | --- |"]
    for when in WHENS.values():
        words = when.sentence.replace("{", "`").replace("}", "`")
        lines.append(f"| `{when.name}` | {words} | {_listed(when.parameters) or '–'} |")
    return "\n".join(lines)


def _listed(parameters: tuple[Parameter, ...]) -> str:
    return "<br>".join(f"`{p.name}` {p.low:g} to {p.high:g} {p.unit}" for p in parameters)
