"""The variables of an FMU: ports, settings, effects, and the coefficients of the data set.

The description, the C sources, the page and the parameter sets are made from this one table.
Effects and coefficients come from the model's own tables; effects of the data set's catalogue are
beside them, each in one of the model's slots for mechanisms.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Literal

from twin.exchange.units import plain
from twin.model.catalogue import CatalogueEffect
from twin.model.dataset import (
    AIR_SAVING_MODES,
    BLOW_OFF_MODES,
    CONTROL_SENSORS,
    DataSet,
    coefficients,
)
from twin.model.effects import EFFECTS, Effect
from twin.model.mechanism import SLOTS, WIDTH, Mechanism, free_slots, slot_at
from twin.model.plant import COLDEST, HIGHEST, HOTTEST, LOWEST
from twin.model.theta import COEFFICIENTS, Theta
from twin.signals import Phase

Where = Literal["inside", "outside"]  # the vessel: part of the FMU, or somebody else's

PHASES = {phase.name.lower(): int(phase) for phase in Phase}
# Coefficients that are ports and settings, in C over the values ``v``.
_PORTS = {
    "AMBIENT": "v[V_AMBIENT_PRESSURE]",
    "SUPPLY": "v[V_SUPPLY_PRESSURE]",
    "H1": "v[V_THRESHOLD_H1]",
    "H1_LOW": "v[V_THRESHOLD_H1] - v[V_THRESHOLD_H1_HYSTERESIS]",
    "H2": "v[V_THRESHOLD_H2]",
    "H2_LOW": "v[V_THRESHOLD_H2] - v[V_THRESHOLD_H2_HYSTERESIS]",
    "AIR_SAVING": "v[V_CONTROL_AIR_SAVING]",
    "PERMITTED_LEAKAGE": "v[V_CONTROL_PERMITTED_LEAKAGE]",
    "BLOW_OFF_MODE": "v[V_CONTROL_BLOW_OFF]",
    "BLOW_OFF_TIME": "v[V_CONTROL_BLOW_OFF_TIME]",
    "CONTROL_SENSOR": "v[V_CONTROL_SENSOR]",
}
_VESSEL: Mapping[Where, Mapping[str, str]] = {
    "inside": {
        "INFLOW": "v[V_VESSEL_INFLOW]",
        "RELEASE": "v[V_CUPS_RELEASE] > -9e5 ? v[V_CUPS_RELEASE] : NAN",
    },
    # A vessel so large that its pressure stays at the port's value for a millisecond.
    "outside": {
        "VOLUME": "1e3",
        "COMPLIANCE": "0.0",
        "FILM": "0.0",
        "AREA": "0.0",
        "OPENING": "0.0",
        "HOLE": "0.0",
        "RELEASE": "NAN",
        "CONTACT": "0.0",
        "INFLOW": "0.0",
    },
}


def reference(name: str) -> str:
    """The value reference of a variable by name, in C."""
    return f"V_{name.upper().replace('.', '_')}"


class Role(Enum):
    """The role of a variable for the importing tool: causality and variability."""

    INPUT = ("input", "continuous")
    COMMAND = ("input", "discrete")
    OUTPUT = ("output", "continuous")
    SIGNAL = ("output", "discrete")
    DATA = ("parameter", "fixed")
    SETTING = ("parameter", "tunable")


@dataclass(frozen=True)
class Variable:
    """One variable; ``choices`` make it an enumeration, ``truth`` a Boolean."""

    name: str
    words: str
    role: Role
    unit: str = ""
    start: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    shown: str = ""  # unit to show it in
    truth: bool = False
    choices: Mapping[str, int] | None = None

    @property
    def reference(self) -> str:
        """Its value reference by name, in C."""
        return reference(self.name)

    @property
    def type_name(self) -> str:
        """The name of an enumeration's type."""
        return "".join(part.capitalize() for part in self.name.replace(".", "_").split("_"))

    @property
    def is_output(self) -> bool:
        """Whether the FMU computes it."""
        return self.role in (Role.OUTPUT, Role.SIGNAL)

    @property
    def is_parameter(self) -> bool:
        """Whether a parameter set may hold it."""
        return self.role in (Role.DATA, Role.SETTING)


@dataclass(frozen=True)
class InSlot:
    """An effect of the catalogue: a mechanism in a slot of the model that is its own."""

    entry: CatalogueEffect
    first: int  # number of the slot's first coefficient

    @property
    def mechanism(self) -> Mechanism:
        """What acts."""
        return self.entry.acts_as


@dataclass(frozen=True)
class Component:
    """The source of an FMU: its variables, and the C expression of each coefficient."""

    where: Where
    variables: tuple[Variable, ...]
    sources: Mapping[str, str]  # coefficient -> expression over v, the values
    effects: tuple[Effect, ...]  # in the order in which they act
    slots: Mapping[str, InSlot]  # of those that are in the catalogue, by name
    left_out: tuple[str, ...]  # effects of the catalogue for which no slot is free

    @classmethod
    def of(cls, data: DataSet, where: Where) -> "Component":
        """The component of a data set; effects start at the sizes in the data set.

        A mechanism of the data set is an effect of the catalogue, or part of the coefficients.
        """
        catalogue = {
            name: entry
            for name, entry in data.catalogue.items()
            if where == "inside" or not _is_of_vessel(frozenset(entry.acts_as.place.coefficients))
        }
        found = _found(data.effects, catalogue)
        named = found.values()
        start_values = {
            found.get(mechanism, mechanism): sizes for mechanism, sizes in data.effects.items()
        }
        fixed = {
            name: sizes
            for name, sizes in data.effects.items()
            if name not in EFFECTS and name not in found
        }
        theta = coefficients(data.model_copy(update={"effects": fixed}))
        chosen = [*named, *(name for name in catalogue if name not in named)]
        slots = {
            name: InSlot(catalogue[name], slot_at(SLOTS - 1 - number))
            for number, name in enumerate(chosen[: free_slots(theta)])
        }
        effects = _in_order(start_values, where, slots)
        effect_variables = _effect_variables(theta, start_values, effects)
        sources = {**_PORTS, **_VESSEL[where], **_of_slots(slots)}
        for variable, number in effect_variables:
            if number is not None:  # it replaces a coefficient
                sources.setdefault(list(COEFFICIENTS)[number], f"v[{variable.reference}]")
        data_variables = [
            _data_variable(name, float(theta[n])) for n, name in enumerate(COEFFICIENTS)
        ]
        remaining = {
            name: variable
            for name, variable in zip(COEFFICIENTS, data_variables, strict=True)
            if name not in sources
        }
        sources |= {name: f"v[{variable.reference}]" for name, variable in remaining.items()}
        variables = (
            *_ports(theta, where),
            *(variable for variable, _ in effect_variables),
            *remaining.values(),
        )
        left_out = tuple(chosen[len(slots) :])
        return cls(where, variables, sources, tuple(effects.values()), slots, left_out)

    @property
    def parameters(self) -> tuple[Variable, ...]:
        """The variables of a parameter set."""
        return tuple(variable for variable in self.variables if variable.is_parameter)

    def with_data(self, data: DataSet) -> "Component":
        """The component of another data set with the same effects of the catalogue."""
        catalogue = {name: slot.entry for name, slot in self.slots.items()}
        return Component.of(data.model_copy(update={"catalogue": catalogue}), self.where)

    @property
    def remark(self) -> str:
        """What is missing of the catalogue, and why; empty if nothing is."""
        if not self.left_out:
            return ""
        return (
            f"left out of the catalogue: {', '.join(self.left_out)} (no more than {SLOTS}"
            " mechanisms act at once)"
        )


def _found(
    effects: Mapping[str, Mapping[str, float]], catalogue: Mapping[str, CatalogueEffect]
) -> dict[str, str]:
    """The catalogue's effects that a data set has, by the name of their mechanism.

    What was found of them is stored as the mechanism. It is the first one whose bounds hold it.
    """
    found: dict[str, str] = {}
    for name, entry in catalogue.items():
        values = effects.get(entry.mechanism)
        if values is not None and all(
            bounds.low <= values.get(parameter, 0.0) <= bounds.high
            for parameter, bounds in entry.parameters.items()
        ):
            found.setdefault(entry.mechanism, name)
    return found


def _in_order(
    present: Mapping[str, object], where: Where, slots: Mapping[str, InSlot]
) -> dict[str, Effect]:
    """The effects of a component: those of the data set act first, in its order."""
    effects = {
        name: effect
        for name, effect in EFFECTS.items()
        if where == "inside" or not _is_of_vessel(effect.touches)
    } | {name: slot.entry.effect(name) for name, slot in slots.items()}
    names = [*(name for name in present if name in effects), *effects]
    return {name: effects[name] for name in names}


def _is_of_vessel(touched: frozenset[int]) -> bool:
    """Whether what is touched is the vessel alone: an FMU without the vessel does not have it."""
    return {list(COEFFICIENTS)[number] for number in touched} <= _VESSEL["outside"].keys()


def _of_slots(slots: Mapping[str, InSlot]) -> dict[str, str]:
    """The coefficients of slots that effects fill."""
    names = list(COEFFICIENTS)
    return {
        name: "0.0" for slot in slots.values() for name in names[slot.first : slot.first + WIDTH]
    }


def _effect_variables(
    theta: Theta,
    start_values: Mapping[str, Mapping[str, float]],
    effects: Mapping[str, Effect],
) -> list[tuple[Variable, int | None]]:
    """The parameters of effects in the table's order, then the catalogue's.

    Each is with the coefficient that it replaces.
    """
    variables = []
    names = [name for name in EFFECTS if name in effects]
    for effect in (
        effects[name] for name in [*names, *(name for name in effects if name not in EFFECTS)]
    ):
        for parameter in effect.parameters:
            start = start_values.get(effect.name, {}).get(parameter.name, parameter.neutral(theta))
            name, unit = f"effect.{effect.name}.{parameter.name}", plain(parameter.unit)
            bounds = min(parameter.low, start), max(parameter.high, start)
            variable = Variable(name, effect.sentence, Role.SETTING, unit, start, *bounds)
            variables.append((variable, parameter.coefficient))
    return variables


def _data_variable(name: str, value: float) -> Variable:
    unit, words = COEFFICIENTS[name]
    return Variable(f"coefficient.{name.lower()}", words, Role.DATA, plain(unit), value)


def _ports(theta: Theta, where: Where) -> list[Variable]:
    """Inputs, outputs and settings."""
    k = {name: float(theta[number]) for number, name in enumerate(COEFFICIENTS)}
    temperature = k["TEMPERATURE"]
    vessel: Mapping[Where, list[Variable]] = {
        "inside": [
            _pressure("vessel.pressure", "absolute", Role.OUTPUT),
            _flow("vessel.mass_flow", "out of the vessel towards the ejector", Role.OUTPUT),
            _flow("vessel.inflow", "into the vessel from what else hangs on it", Role.INPUT),
            Variable(
                "cups.release",
                "vacuum at which blow-off lets the part go; -5e5: when it ends; -1e6: never",
                Role.DATA,
                "Pa",
                -1e6 if math.isnan(k["RELEASE"]) else k["RELEASE"],
                -1e6,
                1e5,
                "mbar",
            ),
        ],
        "outside": [
            _pressure(
                "vessel.pressure", "absolute, of the vessel outside", Role.INPUT, k["AMBIENT"]
            ),
            _temperature("vessel.temperature", "of the gas in it", Role.INPUT, temperature),
            _flow("vessel.mass_flow", "out of it, mean of the last step", Role.OUTPUT),
            _temperature("line.temperature", "of gas that flows into it", Role.OUTPUT),
        ],
    }
    return [
        _pressure("supply.pressure", "gauge, at the regulator", Role.INPUT, k["SUPPLY"], "bar"),
        _pressure("ambient.pressure", "absolute", Role.INPUT, k["AMBIENT"]),
        _truth("command.suction", "suction is commanded", Role.COMMAND),
        _truth("command.blow_off", "blow-off is commanded; it wins over suction", Role.COMMAND),
        *vessel[where],
        _pressure("port.pressure", "absolute, at the ejector's vacuum port", Role.OUTPUT),
        _pressure("sensor.pressure", "absolute, as the PLC's sensor reads it", Role.OUTPUT),
        _truth("signal.part_present", "H2 is reached", Role.SIGNAL),
        _truth("signal.air_saving", "H1 is reached", Role.SIGNAL),
        _choice("signal.phase", "what the ejector does", PHASES, 0.0, Role.SIGNAL),
        _vacuum("threshold.h1", "nozzle off: air is saved", k["H1"]),
        _vacuum("threshold.h1_hysteresis", "nozzle on again so far below", k["H1"] - k["H1_LOW"]),
        _vacuum("threshold.h2", "part present", k["H2"]),
        _vacuum("threshold.h2_hysteresis", "no more so far below", k["H2"] - k["H2_LOW"]),
        _choice("control.air_saving", "air saving", AIR_SAVING_MODES, k["AIR_SAVING"]),
        Variable(
            "control.permitted_leakage",
            "more of it ends the air saving, with leak monitoring",
            Role.SETTING,
            "Pa/s",
            k["PERMITTED_LEAKAGE"],
            0.0,
        ),
        _choice("control.blow_off", "what starts blow-off", BLOW_OFF_MODES, k["BLOW_OFF_MODE"]),
        Variable("control.blow_off_time", "a pulse", Role.SETTING, "s", k["BLOW_OFF_TIME"], 0.0),
        _choice("control.sensor", "whose it acts on", CONTROL_SENSORS, k["CONTROL_SENSOR"]),
    ]


def _pressure(
    name: str, words: str, role: Role, start: float = 0.0, shown: str = "mbar"
) -> Variable:
    low = 0.0 if name.startswith("supply") else LOWEST
    return Variable(name, words, role, "Pa", start, low, HIGHEST, shown)


def _temperature(name: str, words: str, role: Role, start: float = 0.0) -> Variable:
    return Variable(name, words, role, "K", start, COLDEST, HOTTEST)


def _flow(name: str, words: str, role: Role) -> Variable:
    return Variable(name, words, role, "kg/s", 0.0, -1.0, 1.0, "sl/min")


def _vacuum(name: str, words: str, start: float) -> Variable:
    return Variable(name, words, Role.SETTING, "Pa", start, 0.0, HIGHEST, "mbar")


def _truth(name: str, words: str, role: Role) -> Variable:
    return Variable(name, words, role, low=0.0, high=1.0, truth=True)


def _choice(
    name: str, words: str, choices: Mapping[str, int], start: float, role: Role = Role.SETTING
) -> Variable:
    low, high = min(choices.values()), max(choices.values())
    return Variable(name, words, role, start=start, low=low, high=high, choices=choices)
