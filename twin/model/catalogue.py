"""Effects that a diagnosis found and a person took in: mechanisms with a name of their own.

They stand in a data set's ``catalogue``, so they come with a type or a unit wherever its data set
goes. From then on the search for causes has them beside the table of effects.
"""

import re
from collections.abc import Iterable, Mapping
from typing import Annotated

from pydantic import Field, StringConstraints, model_validator

from twin.errors import ConfigError, known_names
from twin.model.effects import EFFECTS, UNKNOWN, Effect, Parameter, add_beside
from twin.model.mechanism import MECHANISMS, Mechanism, free_slots
from twin.model.theta import Theta
from twin.settings import Settings

Words = Annotated[str, StringConstraints(min_length=1, max_length=300, pattern=r"^[^\x00-\x1f]+$")]
NAME = re.compile(r"[a-z][a-z0-9_]{2,40}")
TAKEN = {UNKNOWN, "unlisted", "none", "healthy"}  # words that answers have for something else


class Range(Settings):
    """One number of an effect that was taken in: from where to where, and what it was at first."""

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
    """A mechanism that was found, with words for people and the range of each of its numbers."""

    mechanism: str  # what acts where and when; docs/mechanisms.md lists them
    sentence: Words  # what it is, as answers say it
    look_at: Words = "what was found where it was seen first"  # what to look at first
    parameters: Mapping[str, Range]  # of the mechanism: its sizes, and what shapes it
    found_in: Mapping[str, str] = Field(default_factory=dict)  # unit, log, data set, program

    @model_validator(mode="after")
    def _is_one_of_the_mechanisms(self) -> "CatalogueEffect":
        if self.mechanism not in MECHANISMS:
            raise ValueError(
                f"mechanism {self.mechanism!r} is none; {known_names(self.mechanism, MECHANISMS)}"
            )
        table = {one.name: one for one in MECHANISMS[self.mechanism].effect.parameters}
        if self.parameters.keys() != table.keys():
            raise ValueError(f"{self.mechanism} needs the parameters {', '.join(table)}, no others")
        sizes = {one.name for one in MECHANISMS[self.mechanism].place.parameters}
        for name, mine in self.parameters.items():
            widest = table[name]
            if mine.low < widest.low or mine.high > widest.high:
                raise ValueError(
                    f"{name} can be {widest.low:g} to {widest.high:g} {widest.unit} at most"
                )
            if name in sizes and not mine.low <= 0.0 <= mine.high:
                raise ValueError(f"{name} is a size: 0 must lie within low and high")
        return self

    @property
    def acts_as(self) -> Mechanism:
        """What it is in the model."""
        return MECHANISMS[self.mechanism]

    def effect(self, name: str) -> Effect:
        """The same as an entry of the table of effects; what shapes it is near what was found."""
        sizes = {one.name for one in self.acts_as.place.parameters}
        parameters = tuple(
            Parameter(
                one.name,
                one.unit,
                mine.low,
                mine.high,
                one.typical,
                ratio=one.ratio,
                usual=None if one.name in sizes else mine.found,
            )
            for one in self.acts_as.effect.parameters
            for mine in (self.parameters[one.name],)
        )
        act = self.acts_as.effect.act
        return Effect(name, self.sentence, self.look_at, parameters, act, acts=_has_room)


def _has_room(theta: Theta) -> bool:
    return free_slots(theta) > 0


_REGISTERED: dict[str, CatalogueEffect] = {}


def refuse_name(name: str) -> None:
    """ConfigError for what cannot be the name of an effect beside the table."""
    if name in EFFECTS or name in MECHANISMS or name in TAKEN:
        raise ConfigError(f"{name!r} is the name of something else", "twin effects lists the names")
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} cannot be the name of an effect",
            "3 to 41 small letters, digits and _, a letter first",
        )


def effects_in(catalogue: Mapping[str, CatalogueEffect]) -> list[Effect]:
    """The effects of a catalogue; from then on they are known by name in this process.

    ConfigError where a name stands for another mechanism already.
    """
    found = []
    for name, one in catalogue.items():
        if _REGISTERED.setdefault(name, one).mechanism != one.mechanism:
            raise ConfigError(
                f"{name}: another catalogue has another mechanism under this name",
                "give one of them another name: twin effects add",
            )
        _REGISTERED[name] = one
        found.append(one.effect(name))
    add_beside({one.name: one for one in found})
    return found


def mechanism_of(name: str) -> str:
    """The mechanism that an effect is in the model; the name itself where it is in the table."""
    return _REGISTERED[name].mechanism if name in _REGISTERED else name


def has_room(theta: Theta, effects: Iterable[str], more: int = 0) -> bool:
    """Whether those of the effects that are beside the table, and so many more, can act at once."""
    return more + sum(one not in EFFECTS for one in effects) <= free_slots(theta)
