"""A small fleet's logs."""

from dataclasses import replace
from pathlib import Path

import rigs

from tools.fleet_trial import write_log
from twin.assets.database import open_assets
from twin.assets.record import Record

CYCLES = 5
RIG = rigs.config("test_rig")


def commission(database: Path, *units: str) -> None:
    """Have units in a database that are as the tank rig is."""
    data, healthy = RIG.data.model_dump(mode="json"), RIG.monitor.healthy.model_dump(mode="json")
    with open_assets(database) as assets:
        for unit in units:
            assets.add(Record("instance", unit, RIG.asset.type, data, healthy))


def write(
    folder: Path, unit: str, seed: int, faults: tuple[str, ...] = (), cycles: int = CYCLES
) -> Path:
    """A log of a unit on the tank rig."""
    config = replace(RIG, asset=RIG.asset.model_copy(update={"id": unit}))
    samples, _ = rigs.recorded("test_rig", 3.1 * (cycles + 1.2), faults, seed)
    path = folder / f"{unit}-{seed}.mcap"
    write_log(path, config, samples)
    return path
