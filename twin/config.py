"""The twin's own part of a configuration: which asset, what is known of it, when to raise an alarm.

What is known comes from one of three places, and which one is kept: the instance-specific data set
of the unit in the asset database; else its type's object-specific one with what ``[data]`` adds;
else ``[data]`` alone, where nobody knows the type.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import Field, TypeAdapter

from twin.assets.diagram import FLOW, SUPPLY, VACUUM
from twin.assets.place import open_chosen
from twin.assets.record import Record
from twin.errors import ConfigError
from twin.model.dataset import Ambient, DataSet, Supply, System
from twin.model.diagram import reduce
from twin.monitor.detect import MonitorSettings, Scatter
from twin.settings import Document, Settings

TABLES = {"asset", "assets", "data", "driver", "import", "log", "monitor", "plc"}
_HEALTHY = TypeAdapter(dict[str, Scatter])


class Asset(Settings):
    """The ejector: its type (object-specific data) and the one unit (instance-specific data)."""

    type: str = "unknown"
    id: str = ""


class LogSettings(Settings):
    """How logs are kept."""

    rotate_mb: float = Field(64.0, gt=0.0)  # a new part begins beyond this size


@dataclass(frozen=True)
class Config:
    """A checked configuration, with the document it was read from."""

    document: Document
    asset: Asset
    data: DataSet
    monitor: MonitorSettings
    log: LogSettings
    origin: str = "[data] of the configuration"  # where the data set is from, in words

    @classmethod
    def of(
        cls, document: Document, assets: str = "", unit: str = "", *, calibrated: bool = True
    ) -> "Config":
        """Check all of the twin's tables; ConfigError names file, line and key.

        ``assets`` names the database in place of the configuration's, ``unit`` the ID in place of
        its own. Not ``calibrated`` is the unit as its type has it, whatever is known of itself.
        """
        document.refuse_unknown_tables(TABLES)
        asset = document.section(Asset, "asset")
        asset = asset.model_copy(update={"id": unit}) if unit else asset
        monitor = document.section(MonitorSettings, "monitor")
        logs = document.section(LogSettings, "log")
        record = _known(document, asset, assets, calibrated=calibrated)
        if record is None:
            return cls(document, asset, document.section(DataSet, "data"), monitor, logs)
        origin = f"{record.kind}-specific data of {record.name}, record {record.id[:8]}"
        if record.kind == "type":
            known = _merged(_diagram(record), record.data)
            tables = {"data": _merged(known, document.tables.get("data", {}))}
            merged = replace(document, tables={**document.tables, **tables})
            data = merged.section(DataSet, "data")
            return cls(document, asset, data, monitor, logs, f"object-{origin[5:]}")
        data = DataSet.model_validate(record.data)
        _refuse_moved(document, data, asset)
        config = cls(document, asset, data, monitor, logs, origin)
        return config.with_healthy(record.healthy)

    @classmethod
    def of_log(cls, document: Document, metadata: Mapping[str, str]) -> "Config":
        """The configuration of a log, with the data set it was recorded beside."""
        if "data" not in metadata:
            return cls.of(document)
        document.refuse_unknown_tables(TABLES)
        config = cls(
            document,
            document.section(Asset, "asset"),
            DataSet.model_validate_json(metadata["data"]),
            document.section(MonitorSettings, "monitor"),
            document.section(LogSettings, "log"),
            metadata.get("origin", "the log"),
        )
        return config.with_healthy(json.loads(metadata.get("healthy", "{}")))

    def with_healthy(self, healthy: Mapping[str, Any]) -> "Config":
        """The same with what healthy cycles of the unit scatter, if that is known."""
        if not healthy:
            return self
        update = {"healthy": _HEALTHY.validate_python(dict(healthy))}
        return replace(self, monitor=self.monitor.model_copy(update=update))


def _known(document: Document, asset: Asset, assets: str, *, calibrated: bool) -> Record | None:
    """What the database has for the asset; None where it does not know it and [data] does."""
    with open_chosen(assets, document, write=False) as database:
        unit = asset.id if calibrated else ""
        types = {record.name for record in database.records("type")}
        units = {record.name for record in database.records("instance", unit)} if unit else set()
        if asset.type not in types and unit not in units and "data" in document.tables:
            return None
        return database.get(asset.type, unit).record


def _diagram(record: Record) -> Mapping[str, Any]:
    """What a type's characteristic diagram says, where it has one; its data may say it better."""
    if VACUUM not in record.arrays:
        return {}
    ambient = Ambient.model_validate(record.data.get("ambient", {})).pressure_mbar
    nominal = Supply.model_validate(record.data.get("supply", {})).nozzle_bar
    axes = record.arrays[VACUUM], record.arrays[SUPPLY]
    return reduce(*axes, record.arrays[FLOW], nominal, ambient).tables


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with the values of ``over``, table by table."""
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merged(merged[key], value) if both else value
    return merged


def _refuse_moved(document: Document, data: DataSet, asset: Asset) -> None:
    """ConfigError if the unit was calibrated on another system than the configuration has."""
    if "system" not in document.tables.get("data", {}):
        return
    configured = document.section(System, "data", "system").parts
    if configured != data.system.parts:
        raise ConfigError(
            f"{document.name}: {asset.id} was calibrated on another system than"
            " [data.system.parts] has",
            "calibrate it again on this one (twin calibrate), or give it another id",
        )
