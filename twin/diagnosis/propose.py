"""A mechanism that was found, as a readable file with an entry for a catalogue of effects.

The log in which it was found is its test: with the entry in the catalogue, a diagnosis of that log
must name it.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import tomli_w

from twin.assets import provenance
from twin.config import Config
from twin.diagnosis.answer import Diagnosis, diagnose
from twin.errors import ConfigError
from twin.log.reader import Log
from twin.model.catalogue import CatalogueEffect, Range, refuse_name
from twin.model.effects import Parameter
from twin.model.mechanism import MECHANISMS, Mechanism
from twin.settings import Document, Settings

FORMAT = "ejector-twin-effect/1"
# Factor by which shape parameters may differ on another unit. Chosen: a lip lifts off, water boils
# and ice grows at other vacuums and rates on other machines, but not at arbitrary ones.
OTHERWISE = 3.0
INTRODUCTION = """\
# An effect that is not in the table of effects, as twin diagnose found it in a log:
#   {sentence}
# Read it, give it a name and a sentence of your own, and say what to look at first. Then
#   twin effects add {file}
# has it searched for, and named, on every ejector of this type (--id: of this unit alone).
# A size may be from low to high; what shapes the effect is looked for between low and high,
# and begins where it was found.
"""


class Test(Settings):
    """What must come out: on this log the diagnosis names the effect."""

    log: str
    log_sha256: str


class Proposal(Settings):
    """The file: what ``twin diagnose --propose`` writes and ``twin effects add`` takes."""

    format: Literal["ejector-twin-effect/1"]
    name: str  # as answers call it
    type: str  # of the ejectors that it was found on
    unit: str = ""  # on which it was found
    effect: CatalogueEffect
    test: Test

    @classmethod
    def read(cls, path: Path) -> "Proposal":
        """Read and check a file; ConfigError with its line and key."""
        document = Document.read(path)
        proposal = document.section(cls)
        try:
            refuse_name(proposal.name)
        except ConfigError as error:
            raise ConfigError(f"{path}: name: {error}", error.hint) from error
        return proposal


def proposed(diagnosis: Diagnosis, config: Config, log: Path, file: Path) -> str | None:
    """The text of the file for the mechanism that a diagnosis found; None if it found none."""
    if diagnosis.mechanism is None:
        return None
    mechanism = MECHANISMS[diagnosis.mechanism.cause.effect]
    values = dict(diagnosis.mechanism.cause.values)
    answered = diagnosis.json["unlisted"]["mechanism"]["parameters"]
    of_log = provenance.of_log(log)
    tables: dict[str, Any] = {
        "format": FORMAT,
        "name": file.stem if _can_be_a_name(file.stem) else f"new_{mechanism.name}",
        "type": config.asset.type,
        "unit": config.asset.id,
        "effect": {
            "mechanism": mechanism.name,
            "sentence": _sentence(mechanism),
            "look_at": CatalogueEffect.model_fields["look_at"].default,
            "parameters": {
                parameter.name: _range(
                    mechanism, parameter, values[parameter.name], answered.get(parameter.name)
                )
                for parameter in mechanism.effect.parameters
            },
            "found_in": {**of_log, "data_set": diagnosis.data_set},
        },
        "test": {"log": str(log.resolve()), "log_sha256": of_log["log_sha256"]},
    }
    CatalogueEffect.model_validate(
        tables["effect"]
    )  # never propose what ``effects add`` would refuse
    sentence = diagnosis.json["unlisted"]["mechanism"]["sentence"]
    return INTRODUCTION.format(sentence=sentence, file=file) + "\n" + tomli_w.dumps(tables)


def named_on(
    proposal: Proposal, config: Config, log: Log, where: str, progress: Callable[[str], None]
) -> str:
    """The diagnosis' answer if the test of an entry fails; empty if the effect is named."""
    catalogue = {**config.data.catalogue, proposal.name: proposal.effect}
    config = replace(config, data=config.data.model_copy(update={"catalogue": catalogue}))
    blocks = (rows for rows, _ in log.blocks())
    answer = diagnose(config, blocks, where, progress).json
    names = [cause["effect"] for cause in answer["causes"]]
    if proposal.name in names:
        return ""
    return f"{answer['verdict']}{': ' if names else ''}{', '.join(names)}"


def _can_be_a_name(name: str) -> bool:
    try:
        refuse_name(name)
    except ConfigError:
        return False
    return True


def _sentence(mechanism: Mechanism) -> str:
    """The sentence of a mechanism, without the values of this log."""
    begin = mechanism.place.sentence
    return f"{begin[0].upper()}{begin[1:]}, {mechanism.when.briefly or mechanism.when.sentence}"


def _range(
    mechanism: Mechanism, parameter: Parameter, value: float, answered: dict[str, Any] | None
) -> dict[str, float]:
    """Range of a parameter: a size up to its bound in that direction, a shape about its value.

    If the log does not show a shape, or the shape is of this log alone, its range is as wide as its
    bounds.
    """
    if parameter in mechanism.place.parameters:
        low, high = (0.0, parameter.high) if value >= 0.0 else (parameter.low, 0.0)
    elif answered is None or value <= 0.0 or parameter.is_of_the_log:
        low, high = parameter.low, parameter.high
    else:
        low = max(min(answered["low95"], value / OTHERWISE), parameter.low)
        high = min(max(answered["high95"], value * OTHERWISE), parameter.high)
    rounded = Range(low=_short(low), high=_short(high), found=min(max(_short(value), low), high))
    return rounded.model_dump()


def _short(value: float) -> float:
    return float(f"{value:.4g}")
