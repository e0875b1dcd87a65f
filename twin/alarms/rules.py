"""Alarm rules: when an alarm is raised and cleared, and what a person is to do about it; TOML."""

from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from importlib import resources
from typing import Annotated, Self

import tomli_w
from pydantic import Field, model_validator

from twin.alarms.causes import CAUSES, DEVIATION, value_of
from twin.errors import ConfigError
from twin.settings import Document, Settings

Seconds = Annotated[float, Field(ge=0.0, le=86_400.0)]


class Priority(StrEnum):
    """How soon somebody must act."""

    LOW = "low"  # in this shift
    MEDIUM = "medium"  # within the hour
    HIGH = "high"  # at once


class Rule(Settings):
    """One alarm. ``value`` names what it watches; above or below its limit it is to be raised.

    It is raised after ``on_delay_s`` beyond the limit without a break, and cleared after
    ``off_delay_s`` within it by the dead band. A latching one stands until it is acknowledged too.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    value: str = Field(min_length=1)
    above: float | None = None
    below: float | None = None
    dead_band: float = Field(0.0, ge=0.0)
    on_delay_s: Seconds = 0.0
    off_delay_s: Seconds = 0.0
    latching: bool = False
    priority: Priority = Priority.LOW
    consequence: str = ""  # what happens if nobody acts
    action: str = ""  # what to do
    suppressed_by: tuple[str, ...] = ()  # rules or alarms while which it says nothing, by design
    longest_shelving_s: Seconds = 8 * 3600.0

    @model_validator(mode="after")
    def _one_limit(self) -> Self:
        if (self.above is None) == (self.below is None):
            raise ValueError("needs one limit: above or below")
        return self

    @property
    def alarms(self) -> tuple[str, ...]:
        """The names of its alarms: one for each cause of a deviation, else only its own name."""
        if self.value != DEVIATION:
            return (self.name,)
        return tuple(f"{self.name}_{cause}" for cause in CAUSES)

    def is_beyond(self, value: float, was_beyond: bool) -> bool:
        """Whether a value is beyond the limit; it returns only past the dead band."""
        margin = self.dead_band if was_beyond else 0.0
        if self.above is not None:
            return value > self.above - margin
        assert self.below is not None
        return value < self.below + margin


class RuleFile(Settings):
    """The rules as a file has them: ``[[alarm]]`` for each."""

    alarm: tuple[Rule, ...] = ()

    @model_validator(mode="after")
    def _names_fit(self) -> Self:
        names = [rule.name for rule in self.alarm]
        if duplicates := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"several alarms are called {', '.join(sorted(duplicates))}")
        valid_names = {*names, *(alarm for rule in self.alarm for alarm in rule.alarms)}
        for rule in self.alarm:
            if unknown := set(rule.suppressed_by) - valid_names:
                raise ValueError(
                    f"{rule.name} is suppressed by {', '.join(sorted(unknown))}: no such alarm"
                )
            if rule.name in rule.suppressed_by:
                raise ValueError(f"{rule.name} suppresses itself")
        return self


def read_rules(document: Document) -> tuple[Rule, ...]:
    """The rules of a file; ConfigError names file, line and key."""
    document.refuse_unknown_tables({"alarm"})
    rules = document.section(RuleFile).alarm
    if not rules:
        raise ConfigError(f"{document.name}: no alarm in it", "write one table [[alarm]] for each")
    return rules


def default_rules() -> tuple[Rule, ...]:
    """The rules that come with the program."""
    text = resources.files("twin.alarms").joinpath("default_rules.toml").read_text(encoding="utf-8")
    return read_rules(Document.parse(text, "default_rules.toml"))


def write_rules(rules: Sequence[Rule]) -> str:
    """The rules as the text of a rule file."""
    tables = [rule.model_dump(mode="json", exclude_defaults=True) for rule in rules]
    return tomli_w.dumps({"alarm": tables})


def by_cause(rules: Sequence[Rule]) -> tuple[Rule, ...]:
    """The rules for a board, one for each alarm; ``suppressed_by`` names alarms, not rules."""
    of_name = {rule.name: rule.alarms for rule in rules}
    return tuple(
        alarm_rule.model_copy(
            update={"suppressed_by": tuple(_alarms(alarm_rule.suppressed_by, of_name))}
        )
        for rule in rules
        for alarm_rule in _of_causes(rule)
    )


def _alarms(names: Sequence[str], of_name: Mapping[str, Sequence[str]]) -> Iterator[str]:
    for name in names:
        yield from of_name.get(name, (name,))


def _of_causes(rule: Rule) -> Iterator[Rule]:
    if rule.value != DEVIATION:
        yield rule
        return
    for cause, name in zip(CAUSES, rule.alarms, strict=True):
        yield rule.model_copy(update={"name": name, "value": value_of(cause)})
