"""Store a calibration as a record of the asset database, with its provenance."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from twin.assets import provenance
from twin.assets.catalogue import carried_on
from twin.assets.database import Assets
from twin.assets.database_url import open_chosen
from twin.assets.record import Record
from twin.calibration.calibrate import Calibration
from twin.calibration.commission import Commissioned
from twin.calibration.verdict import Verdict
from twin.config import Config
from twin.signals import MBAR

OF_TYPE = ("supply", "ejector")  # tables of a data set that belong to the type


def store(calibration: Calibration, config: Config, assets: str, log: Path) -> tuple[Record, str]:
    """Add the unit's data set to the database; give the record and the database's name.

    The provenance has the verdict, and times the floor for each weak phase.
    """
    with open_chosen(assets, config.document, write=True) as database:
        return add(database, record_of(calibration, config, log)), database.name


def store_first(
    commissioned: Commissioned, config: Config, assets: str, log: Path
) -> tuple[Record, str]:
    """Store the data set of a unit; add its type with the unit's values if that is unknown.

    Both have the verdict in their provenance, as ``store`` does.
    """
    with open_chosen(assets, config.document, write=True) as database:
        unit = record_of(commissioned.calibration, config, log)
        if not database.records("type", unit.type):
            type_data = {table: unit.data[table] for table in OF_TYPE}
            note = {"note": f"begun with the commissioning of {unit.name}"}
            type_provenance = dict(unit.provenance) | note
            type_record = Record(
                "type", unit.type, unit.type, type_data, provenance=type_provenance
            )
            database.add(type_record)
        return add(database, unit), database.name


def _judged(verdict: Verdict) -> dict[str, Any]:
    """A verdict for the provenance, with the phases that weaken it, the worst first."""
    weak = {phase.name.lower(): round(verdict.residuals[phase].times, 2) for phase in verdict.weak}
    return {provenance.VERDICT: verdict.word, **({provenance.WEAK: weak} if weak else {})}


def add(database: Assets, unit: Record) -> Record:
    """Add a calibrated unit's record; mechanisms stored for this unit stay in its catalogue."""
    return database.add(replace(unit, data=carried_on(database, unit.name, unit.data)))


def record_of(calibration: Calibration, config: Config, log: Path) -> Record:
    """The record of the unit's data set; it is valid from the time of the log on."""
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
                for free, is_determined in zip(fitted.free, fitted.determined, strict=True)
                if is_determined
            ],
            "left_mbar": round(fitted.left / MBAR, 3),
            **_judged(calibration.verdict),
        },
        valid_from_ns=provenance.valid_from(calibration.first_ns),
    )
