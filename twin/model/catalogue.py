"""Effects that a diagnosis has found and a person has accepted: mechanisms with their own names.

They are in the ``catalogue`` of a data set, so they go with a type or a unit wherever its data set
goes. The search for causes then tries them beside the table of effects.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Annotated

from pydantic import Field, StringConstraints, model_validator

from twin.errors import ConfigError, known_names
from twin.model.effects import EFFECTS, UNKNOWN, Effect, add_beside
from twin.model.mechanism import MECHANISMS, Mechanism, free_slots
from twin.model.theta import Theta
from twin.settings import Settings

Words = Annotated[str, StringConstraints(min_length=1, max_length=300, pattern=r"^[^\x00-\x1f]+$")]
NAME = re.compile(r"[a-z][a-z0-9_]{2,40}")
TAKEN = {UNKNOWN, "unlisted", "none", "healthy"}  # words with another meaning in answers


class Range(Settings):
    """Bounds of one parameter of an accepted effect, and its value when it was found."""

    low: float  # the least that it can be, in the mechanism's unit
    high: float  # the most
    found: float  # what it was where it was found: the search begins there

    @model_validator(mode="after")
    def _in_order(self) -> "Range":
        if not self.low <= self.found <= self.high or self.low == self.high:
            raise ValueError(
                f"found = {self.found:g} must lie within {self.low:g} to {self.high:g}"
            )
        return self


class CatalogueEffect(Settings):
    """A mechanism that was found, with texts for people and the range of each parameter."""

    mechanism: str  # what acts where and when; docs/mechanisms.md lists them
    sentence: Words  # what it is, as answers say it
    look_at: Words = "what was found where it was seen first"  # what to look at first
    parameters: Mapping[str, Range]  # sizes of the mechanism, and the parameters that shape it
    found_in: Mapping[str, str] = Field(default_factory=dict)  # unit, log, data set, program

    @model_validator(mode="after")
    def _is_one_of_the_mechanisms(self) -> "CatalogueEffect":
        if self.mechanism not in MECHANISMS:
            raise ValueError(
                f"mechanism {self.mechanism!r} is none; {known_names(self.mechanism, MECHANISMS)}"
            )
        table = {
            parameter.name: parameter for parameter in MECHANISMS[self.mechanism].effect.parameters
        }
        if self.parameters.keys() != table.keys():
            raise ValueError(f"{self.mechanism} needs the parameters {', '.join(table)}, no others")
        sizes = {parameter.name for parameter in MECHANISMS[self.mechanism].place.parameters}
        for name, bounds in self.parameters.items():
            widest = table[name]
            if bounds.low < widest.low or bounds.high > widest.high:
                raise ValueError(
                    f"{name} can be {widest.low:g} to {widest.high:g} {widest.unit} at most"
                )
            if name in sizes and not bounds.low <= 0.0 <= bounds.high:
                raise ValueError(f"{name} is a size: 0 must lie within low and high")
        return self

    @property
    def acts_as(self) -> Mechanism:
        """The mechanism that it is in the model."""
        return MECHANISMS[self.mechanism]

    def effect(self, name: str) -> Effect:
        """It as an effect with a name; values beside its sizes start from those found."""
        sizes = {parameter.name for parameter in self.acts_as.place.parameters}
        parameters = tuple(
            replace(
                parameter,
                low=bounds.low,
                high=bounds.high,
                usual=None if parameter.name in sizes else bounds.found,
            )
            for parameter in self.acts_as.effect.parameters
            for bounds in (self.parameters[parameter.name],)
        )
        act = self.acts_as.effect.act
        return Effect(name, self.sentence, self.look_at, parameters, act, acts=_has_room)


def _has_room(theta: Theta) -> bool:
    return free_slots(theta) > 0


_REGISTERED: dict[str, CatalogueEffect] = {}


def refuse_name(name: str) -> None:
    """Raise ConfigError if the name of an effect beside the table is taken or malformed."""
    if name in EFFECTS or name in MECHANISMS or name in TAKEN:
        raise ConfigError(f"{name!r} is the name of something else", "twin effects lists the names")
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} cannot be the name of an effect",
            "3 to 41 small letters, digits and _, a letter first",
        )


def effects_in(catalogue: Mapping[str, CatalogueEffect]) -> list[Effect]:
    """The effects of a catalogue; this process then finds them by name.

    ConfigError if a name is already that of another mechanism.
    """
    effects = []
    for name, entry in catalogue.items():
        if _REGISTERED.setdefault(name, entry).mechanism != entry.mechanism:
            raise ConfigError(
                f"{name}: another catalogue has another mechanism under this name",
                "give one of them another name: twin effects add",
            )
        _REGISTERED[name] = entry
        effects.append(entry.effect(name))
    add_beside({entry.name: entry for entry in effects})
    return effects


def mechanism_of(name: str) -> str:
    """Name of the mechanism of an effect; the name itself if the effect is in the table."""
    return _REGISTERED[name].mechanism if name in _REGISTERED else name


def has_room(theta: Theta, effects: Iterable[str], more: int = 0) -> bool:
    """Whether the effects beside the table, and ``more`` others, can all act at once."""
    return more + sum(name not in EFFECTS for name in effects) <= free_slots(theta)
