"""Effects that were found and taken in: kept in the data set of a type, or of one unit."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from twin.assets.database import Assets
from twin.assets.record import Record, holding
from twin.errors import ConfigError

CATALOGUE = "catalogue"


def carried_on(database: Assets, unit: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """A unit's new data set with the effects that were taken in for that unit alone.

    Its type's come from there, so they are not kept twice.
    """
    before = holding(database.records("instance", unit), time.time_ns())
    own = before.data.get(CATALOGUE, {}) if before else {}
    return {**data, CATALOGUE: own} if own or CATALOGUE in data else dict(data)


def take_in(
    database: Assets, target: Record, name: str, effect: Mapping[str, Any], file: str
) -> Record:
    """Add a record like ``target`` with one effect more; it holds from when that one does."""
    catalogue = {**target.data.get(CATALOGUE, {}), name: dict(effect)}
    provenance = {"effect": name, "file": file, "over": target.id[:8]}
    data = {**target.data, CATALOGUE: catalogue}
    return database.add(replace(target, data=data, provenance=provenance))


def target_of(database: Assets, kind: str, unit: str) -> Record:
    """The record that an effect is taken into; ConfigError where a unit has none of its own."""
    if not unit:
        return database.get(kind).record
    found = database.get(kind, unit)
    if found.used == "type":
        raise ConfigError(
            f"{database.name}: nothing is known of {unit!r} alone",
            f"commission it first, or take the effect in for all of its type: --type {kind}",
        )
    return found.record
