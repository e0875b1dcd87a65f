"""A calibration becomes a record of the asset database, with where it came from."""

from dataclasses import replace
from pathlib import Path

from twin.assets import provenance
from twin.assets.catalogue import carried_on
from twin.assets.database import Assets
from twin.assets.database_url import open_chosen
from twin.assets.record import Record
from twin.calibration.calibrate import Calibration
from twin.config import Config
from twin.signals import MBAR

OF_TYPE = ("supply", "ejector")  # tables of a data set that say what a type is


def store(calibration: Calibration, config: Config, assets: str, log: Path) -> tuple[Record, str]:
    """Add the unit's data set to the database; give the record and the database's name."""
    with open_chosen(assets, config.document, write=True) as database:
        return add(database, record_of(calibration, config, log)), database.name


def store_first(
    calibration: Calibration, config: Config, assets: str, log: Path
) -> tuple[Record, str]:
    """The same for a unit whose type may be unknown: its first unit then says what the type is."""
    with open_chosen(assets, config.document, write=True) as database:
        unit = record_of(calibration, config, log)
        if not database.records("type", unit.type):
            own = {table: unit.data[table] for table in OF_TYPE}
            note = {"note": f"begun with the commissioning of {unit.name}"}
            provenance_ = dict(unit.provenance) | note
            kind = Record("type", unit.type, unit.type, own, provenance=provenance_)
            database.add(kind)
        return add(database, unit), database.name


def add(database: Assets, unit: Record) -> Record:
    """Add a calibrated unit's record; what was taken in for this unit alone stays with it."""
    return database.add(replace(unit, data=carried_on(database, unit.name, unit.data)))


def record_of(calibration: Calibration, config: Config, log: Path) -> Record:
    """The unit's data set as it is stored; it holds from the time the log was recorded on."""
    fitted = calibration.fitted
    return Record(
        kind="instance",
        name=config.asset.id,
        type=config.asset.type,
        data=fitted.data.model_dump(),
        healthy=calibration.healthy.model_dump(mode="json"),
        arrays={"covariance": fitted.covariance},
        provenance=provenance.of_log(log)
        | {
            "cycles": calibration.cycles,
            "from": config.origin,
            "parameters": [free.name for free in fitted.free],
            "determined": [
                free.name
                for free, known in zip(fitted.free, fitted.determined, strict=True)
                if known
            ],
            "left_mbar": round(fitted.left / MBAR, 3),
        },
        valid_from_ns=provenance.valid_from(calibration.first_ns),
    )
