"""The catalogue of effects that people added, in the data set of a type or of one unit."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from twin.assets.database import Assets
from twin.assets.provenance import of_verdict
from twin.assets.record import Record, holding
from twin.errors import ConfigError

CATALOGUE = "catalogue"


def carried_on(database: Assets, unit: str, data: Mapping[str, Any]) -> dict[str, Any]:
    """A unit's new data set with the catalogue of its present one.

    Effects of the type stay in the type's data set, so they are not stored twice.
    """
    current = holding(database.records("instance", unit), time.time_ns())
    catalogue = current.data.get(CATALOGUE, {}) if current else {}
    return {**data, CATALOGUE: catalogue} if catalogue or CATALOGUE in data else dict(data)


def take_in(
    database: Assets, target: Record, name: str, effect: Mapping[str, Any], file: str
) -> Record:
    """Add a record like ``target`` with one more effect and the same valid time."""
    catalogue = {**target.data.get(CATALOGUE, {}), name: dict(effect)}
    provenance = {"effect": name, "file": file, "over": target.id[:8]}
    provenance |= of_verdict(target.provenance)
    data = {**target.data, CATALOGUE: catalogue}
    return database.add(replace(target, data=data, provenance=provenance))


def target_of(database: Assets, kind: str, unit: str) -> Record:
    """The record that an effect is added to; ConfigError if a unit has none of its own."""
    if not unit:
        return database.get(kind).record
    entry = database.get(kind, unit)
    if entry.used == "type":
        raise ConfigError(
            f"{database.name}: nothing is known of {unit!r} alone",
            f"commission it first, or take the effect in for all of its type: --type {kind}",
        )
    return entry.record
