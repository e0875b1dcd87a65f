"""The twin's own part of a configuration: the asset, its data set and its log.

The data set has layers; each overrides the one before: the defaults; the object-specific data set
of the type in the asset database; ``[data]``; the instance-specific data set of the unit in the
asset database. Their origin is kept.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError

from twin.assets import provenance
from twin.assets.diagram import FLOW, SUPPLY, VACUUM
from twin.assets.record import Found, Record, UnknownAssetError
from twin.errors import ConfigError, SourceError, known_names
from twin.log.header import LogHeader
from twin.model.catalogue import effects_in
from twin.model.dataset import DataSet
from twin.model.diagram import reduce
from twin.monitor.healthy import Healthy
from twin.monitor.settings import MonitorSettings
from twin.settings import Document, Settings
from twin.signals import MBAR
from twin.validation import findings, path_in_words, without_tags

if TYPE_CHECKING:  # SQLAlchemy loads slowly, and a log that has its own data set does not need it
    from sqlalchemy import URL

    from twin.assets.database import Assets

TABLES = {
    "alarms",
    "asset",
    "assets",
    "data",
    "driver",
    "figures",
    "hil",
    "import",
    "log",
    "monitor",
    "mqtt",
    "notifications",
    "outlets",
    "page",
    "plc",
    "results",
    "webhook",
}
NO_TYPE = "unknown"
FROM_AMBIENT = ("gauge", "vacuum")  # references of a tag
COUNTED_FROM, AMBIENT = "counted_from", "ambient"  # in a log's metadata, of its pressure
IN_A_LOG = {"asset", "data", "driver", "figures", "import", "log", "monitor"}  # used from a log
PLACES = {"url", "password", "keep"}  # keys that are ignored in a log
SHIPPED = "sqlite://"  # the data sets that come with the program
HAND_WRITTEN = "[data] of the configuration"
_WORDS = {"type": "object-specific data", "instance": "instance-specific data"}

Tables = Mapping[str, Any]  # nested like [data]


class Asset(Settings):
    """The ejector: its type (object-specific data) and the one unit (instance-specific data)."""

    type: str = NO_TYPE  # type of the ejector, as in the asset database (twin assets list)
    id: str = ""  # ID of this unit, under which a calibration is stored
    batch: str = ""  # production batch on the nameplate; fleets are compared by it


class LogSettings(Settings):
    """How logs are kept."""

    rotate_mb: float = Field(64.0, gt=0.0)  # a new part begins beyond this size
    keep_days: float | None = Field(
        None, gt=0.0
    )  # older ones are deleted; as long as there is room
    # Largest size of all logs of the unit in the folder.
    keep_gb: float | None = Field(None, gt=0.0)
    # Used share of the disk beyond which the oldest logs are deleted.
    disk_pct: float = Field(80.0, gt=0.0, le=100.0)


class Known(Settings):
    """What is known of an asset, as it is stored: its data set, and what healthy cycles scatter."""

    data: DataSet = DataSet()
    healthy: Healthy = Healthy()


@dataclass(frozen=True)
class Config:
    """A checked configuration, with the document it was read from."""

    document: Document
    asset: Asset
    data: DataSet
    monitor: MonitorSettings
    log: LogSettings
    origin: str = HAND_WRITTEN  # origin of the data set, in words
    instead: str = ""  # what replaces the unit's missing data set, in words
    # Phases that a usable twin follows less well than its record allowed, with times the floor.
    weak: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        document: Document,
        assets: "str | URL" = "",
        unit: str = "",
        *,
        calibrated: bool = True,
        as_of_ns: int | None = None,
        own: str = "",
        to_store: bool = False,
    ) -> "Config":
        """Check all of the twin's tables; ConfigError names file, line and key, or the record.

        ``assets`` and ``unit`` replace the configured database and ID. ConfigError if the database
        does not know ``unit`` and it is not ``own``, the unit of a log. Without ``calibrated`` the
        unit gets its type's data set even if it has its own; it may be new. ``as_of_ns`` (UTC)
        ignores what was stored later. ``to_store`` allows a missing database, and so does one that
        only the configuration names.
        """
        from twin.assets.database_url import name_of, open_chosen

        document.refuse_unknown_tables(TABLES)
        _refuse_calibrated(document)
        asset = _asset(document, unit)
        configured_unit = document.section(Asset, "asset").id
        is_search = calibrated and unit not in ("", own, configured_unit)
        # A database that the configuration names is made when the unit is commissioned.
        is_needed = bool(assets) or as_of_ns is not None or is_search
        to_store = to_store or not calibrated or not is_needed
        with open_chosen(assets, document, write=False, to_store=to_store) as database:
            if is_search:
                _require_unit(database, unit, {own, configured_unit} - {""})
            record = _find_record(
                database, document, asset.type, asset.id if calibrated else "", as_of_ns
            )
            database_name = name_of(assets, document)
        layers = _layers(document, record, database_name)
        config = cls._checked(document, asset, layers, _origin(record, layers))
        if calibrated and not (record and record.used == "instance"):
            config = replace(config, instead=_instead(asset, record, database_name))
        elif calibrated and record:
            weak = provenance.weak_phases(record.record.provenance.get(provenance.WEAK))
            config = replace(config, weak=weak)
        return config

    @classmethod
    def of_log(cls, document: Document, metadata: Mapping[str, str], log: str) -> "Config":
        """The configuration of a log, with the data set of its recording.

        SourceError names ``log`` and the key if this program cannot use either of them.
        """
        if "data" not in metadata:
            return cls.of(document, SHIPPED)
        stored = _stored_in_log(metadata, log)
        with _log_errors(metadata, log):
            document.refuse_unknown_tables(TABLES)
            asset = document.section(Asset, "asset")
            config = cls._checked(document, asset, stored, metadata.get("origin", "the log"))
            return replace(config, weak=_weak_in_log(metadata))

    @classmethod
    def of_recorded(
        cls,
        header: LogHeader,
        log: str,
        instead: Document | None = None,
        assets: str = "",
        unit: str = "",
        as_of_ns: int | None = None,
        *,
        to_store: bool = False,
    ) -> "Config":
        """The configuration in a log, with the data set of its recording; or ``instead``.

        If a database, a unit or a time is named, the data set is looked up anew, as in ``of``. A
        database that does not exist yet is not searched.
        """
        with _log_errors(header.metadata, log):
            document = instead or document_in(header)
        is_lookup = bool(assets)
        if is_lookup and to_store:
            from twin.assets.database_url import is_new

            is_lookup = not is_new(assets, document)
        if instead is not None or is_lookup or unit or as_of_ns is not None:
            own = header.asset_id
            config = cls.of(document, assets, unit, as_of_ns=as_of_ns, own=own, to_store=to_store)
        else:
            config = cls.of_log(document, header.metadata, log)
            # --id may have named another unit than the configuration does.
            names = {"type": header.asset_type, "id": header.asset_id}
            config = replace(config, asset=config.asset.model_copy(update=names))
        return config.of_rows(header)

    def of_rows(self, header: LogHeader) -> "Config":
        """The configuration for the rows of a log, which say what their pressure counts from."""
        is_gauge = header.metadata.get(COUNTED_FROM) == AMBIENT
        return self.with_sensor(is_gauge=True) if is_gauge else self

    @property
    def is_gauge(self) -> bool:
        """Whether the pressure sensor counts from ambient."""
        return self.data.sensor.reference == "gauge"

    def with_sensor(self, *, is_gauge: bool) -> "Config":
        """The configuration of a pressure sensor that counts from ambient, or from zero."""
        if is_gauge == self.is_gauge:
            return self
        return replace(self, data=_with_sensor(self.data, is_gauge=is_gauge))

    def log_header(self, unmeasured: Mapping[str, str] | None = None) -> LogHeader:
        """The header with which a log of this unit can be replayed alone.

        ``unmeasured`` names unmeasured parts of its rows (``LogHeader.unmeasured``).
        """
        metadata = {
            "program": version("ejector-twin"),
            "data_set": self.data.hash,
            "origin": self.origin,
            "data": self.data.model_dump_json(),
            "healthy": self.monitor.healthy.model_dump_json(),
            **({COUNTED_FROM: AMBIENT} if self.is_gauge else {}),
            **({provenance.WEAK: json.dumps(dict(self.weak))} if self.weak else {}),
            **(unmeasured or {}),
        }
        return LogHeader(
            asset_type=self.asset.type,
            asset_id=self.asset.id,
            config_name=Path(self.document.name).name,
            config_text=self.document.text,
            metadata=metadata,
            ambient=self.data.ambient.pressure_mbar * MBAR,
        )

    def refuse_another(self, header: LogHeader, log: str) -> None:
        """ConfigError if this is the configuration of another asset than the log's."""
        recorded = header.asset_type, header.asset_id
        own = self.asset.type, self.asset.id
        if all((*recorded, *own)) and recorded != own:
            raise ConfigError(
                f"{log} is a log of {' '.join(recorded)}, {self.document.name} is for"
                f" {' '.join(own)}",
                "take the log's own configuration (no --config), or say with --id which unit to"
                " compare it with",
            )

    @classmethod
    def _checked(cls, document: Document, asset: Asset, stored: Known, origin: str) -> "Config":
        effects_in(stored.data.catalogue)  # registers its effects by name, for texts and alarms
        monitor = document.section(MonitorSettings, "monitor")
        monitor = monitor.model_copy(update={"healthy": stored.healthy})
        log = document.section(LogSettings, "log")
        data, is_gauge = stored.data, _counts_from_ambient(document.tables)
        if is_gauge is not None:
            data = _with_sensor(data, is_gauge=is_gauge)
        return cls(document, asset, data, monitor, log, origin)


def _with_sensor(data: DataSet, *, is_gauge: bool) -> DataSet:
    reference = "gauge" if is_gauge else "absolute"
    sensor = data.sensor.model_copy(update={"reference": reference})
    return data.model_copy(update={"sensor": sensor})


def _counts_from_ambient(tables: Tables) -> bool | None:
    """Whether the pressure counts from ambient; None if no tag and no column says so."""
    with suppress(KeyError, TypeError):
        return bool(tables["driver"]["tags"]["pressure"]["reference"] in FROM_AMBIENT)
    with suppress(KeyError, TypeError):
        columns = tables["import"]["columns"]
        settings = columns.get("pressure")
        gauge = isinstance(settings, Mapping) and settings.get("reference") in FROM_AMBIENT
        return gauge or any(str(name).startswith("vacuum") for name in columns) or None
    return None


def document_in(header: LogHeader) -> Document:
    """The configuration in a log; ConfigError if it is not TOML.

    A log may come from anybody. So keys that name databases, files or services are left out. Older
    logs contain the result of a calibration here, which is in the log's metadata as well.
    """
    document = Document.parse(header.config_text, Path(header.config_name).name)
    document.refuse_unknown_tables(TABLES)
    left_out = {"figures": PLACES, "monitor": {"healthy"}}
    tables = {
        name: _without(table, left_out.get(name, set()))
        for name, table in document.tables.items()
        if name in IN_A_LOG
    }
    return replace(document, tables=tables)


def _without(table: Any, keys: set[str]) -> Any:
    if not isinstance(table, Mapping):
        return table
    return {key: value for key, value in table.items() if key not in keys}


def check_asset(document: Document, record: Record, database: "Assets") -> None:
    """ConfigError with file, line and key if a record read from a file cannot be used.

    A unit is checked together with its type's data set in the database.
    """
    type_tables: Tables = {}
    if record.kind == "instance":
        type_record = database.get(record.type).record
        type_tables = _overlay_record(
            type_record, {}, partial(_checked_record, type_record, database.name)
        )
    _overlay_record(record, type_tables, partial(_checked_file, document))
    replace(document, tables={"healthy": record.healthy}).section(Known)


def _refuse_calibrated(document: Document) -> None:
    """ConfigError if a person's file contains results of a calibration."""
    monitor = document.tables.get("monitor", {})
    if isinstance(monitor, Mapping) and "healthy" in monitor:
        raise ConfigError(
            f"{document.name}: [monitor.healthy]: what a calibration found is in the asset"
            " database, not in a configuration",
            "remove the table; twin commission and twin calibrate store it",
        )


# --- which records ------------------------------------------------------------------------------


def _asset(document: Document, unit: str) -> Asset:
    asset = document.section(Asset, "asset")
    asset = asset.model_copy(update={"id": unit}) if unit else asset
    if asset.id and asset.type in ("", NO_TYPE):
        raise ConfigError(
            f"{document.name}: asset {asset.id!r} has no type",
            'say which type of ejector it is: type = "..." under [asset]',
        )
    return asset


def _require_unit(database: "Assets", unit: str, alternatives: set[str]) -> None:
    """ConfigError if the database does not know ``unit``: the name is probably mistyped.

    The hint also suggests ``alternatives``: the units of the log and of the configuration.
    """
    if not database.records("instance", unit):
        stored = {record.name for record in database.records("instance")}
        units = known_names(unit, stored | alternatives)
        raise ConfigError(
            f"{database.name}: no unit is called {unit!r}",
            f"{units}\n  a new unit is named by [asset] id in the configuration; twin calibrate"
            " stores its data set",
        )


def _find_record(
    database: "Assets", document: Document, type_name: str, unit: str, as_of_ns: int | None
) -> Found | None:
    """The database's entry; None if it knows neither unit nor type, but there is a [data]."""
    try:
        return database.get(type_name, unit, as_of_ns=as_of_ns)
    except UnknownAssetError:
        if "data" not in document.tables:
            if type_name in ("", NO_TYPE):
                raise ConfigError(
                    f"{document.name}: neither [asset] type nor [data] says what ejector this is",
                    "write a file to begin with: twin init",
                ) from None
            raise
        return None


def _origin(record: Found | None, stored: Known) -> str:
    """The origin of the data set, in words."""
    if record is None:
        return HAND_WRITTEN
    words = _record_name(record.record)
    if record.base and any(_missing_keys(stored.data.model_dump(), record.record.data)):
        words += f", over {_record_name(record.base)}"
    return words


def _record_name(record: Record) -> str:
    return f"{_WORDS[record.kind]} of {record.name}, record {record.id[:8]}"


def _instead(asset: Asset, record: Found | None, database_name: str) -> str:
    if not asset.id:
        return ""
    if record is None:
        missing = f"no data set of {asset.id!r} or its type {asset.type!r} in {database_name}"
        return f"{missing}; using {HAND_WRITTEN}"
    missing = f"no instance-specific data set of {asset.id!r} in {database_name}"
    return f"{missing}; using the type's {asset.type!r}"


# --- layers -------------------------------------------------------------------------------------


def _layers(document: Document, record: Found | None, database_name: str) -> Known:
    """The layered data set; each layer is checked by itself, so that errors name the right one.

    ConfigError also if the unit was calibrated on another system than the configured one.
    """
    type_record = record.base or record.record if record else None
    type_tables = (
        _overlay_record(type_record, {}, partial(_checked_record, type_record, database_name))
        if type_record
        else {}
    )
    tables = _merged(type_tables, document.tables.get("data", {}))
    type_layer = _checked_file(document, tables)
    if record is None or record.used == "type":
        return type_layer
    unit = record.record
    check = partial(_checked_record, unit, database_name)
    unit_layer = check(_overlay_record(unit, tables, check))
    configured = "parts" in document.tables.get("data", {}).get("system", {})
    if configured and unit_layer.data.system.parts != type_layer.data.system.parts:
        raise ConfigError(
            f"{document.name}: {unit.name} was calibrated on another system than"
            " [data.system.parts] has",
            "calibrate it again on this one (twin calibrate), or give it another id",
        )
    return unit_layer


def _overlay_record(record: Record, base: Tables, check: Callable[[Tables], object]) -> Tables:
    """A record laid over ``base``; its explicit values override those from its diagram."""
    tables: Tables = _merged(base, record.data)
    check(tables)
    if VACUUM not in record.arrays:
        return tables
    try:
        diagram = _tables_of_diagram(record, DataSet.model_validate(tables))
        tables = _merged(_merged(base, diagram), record.data)
        DataSet.model_validate(tables)
    except (ConfigError, ValidationError) as error:
        cause = _in_words(error, DataSet) if isinstance(error, ValidationError) else str(error)
        raise ConfigError(
            f"{record.kind} {record.name!r}: the model cannot follow its characteristic diagram:"
            f" {cause}",
            "check its rows: one peak over operating pressure, and capacity that falls with vacuum",
        ) from error
    return tables


def _tables_of_diagram(record: Record, data: DataSet) -> Tables:
    """The values that follow from a record's characteristic diagram."""
    axes = record.arrays[VACUUM], record.arrays[SUPPLY]
    nominal, ambient = data.supply.nozzle_bar, data.ambient.pressure_mbar
    return reduce(*axes, record.arrays[FLOW], nominal, ambient).tables


def _merged(base: Any, overlay: Any) -> Any:
    """``overlay`` merged into ``base``, table by table."""
    if not (isinstance(base, Mapping) and isinstance(overlay, Mapping)):
        return overlay
    return {**base, **{key: _merged(base.get(key), value) for key, value in overlay.items()}}


# --- checks; each error names the place of the wrong key ----------------------------------------


def _checked_file(document: Document, tables: Tables) -> Known:
    merged = replace(document, tables={**document.tables, "data": tables})
    return Known(data=merged.section(DataSet, "data"))


def _checked_record(record: Record, database_name: str, tables: Tables) -> Known:
    try:
        return Known.model_validate({"data": tables, "healthy": record.healthy})
    except ValidationError as error:
        problem = f"record {record.id[:8]} of {record.kind} {record.name!r} cannot be used"
        raise ConfigError(
            f"{database_name}: {problem}: {_in_words(error)}",
            f"twin assets show {record.name} prints it; add one that is right: twin assets add",
        ) from error


@contextmanager
def _log_errors(metadata: Mapping[str, str], log: str) -> Iterator[None]:
    """Turn errors of a log's configuration into SourceErrors, since no file can be corrected."""
    try:
        yield
    except ConfigError as error:
        message = f"{log}: the configuration in it cannot be used: {error}"
        raise SourceError(message, _log_hint(metadata)) from error


def _log_hint(metadata: Mapping[str, str]) -> str:
    return (
        "give another one with --config CONFIG, or use the ejector-twin that made the log"
        f" ({metadata.get('program', 'of unknown version')})"
    )


def _stored_in_log(metadata: Mapping[str, str], log: str) -> Known:
    """The data set in a log; SourceError if it is incomplete, since defaults would be wrong."""
    try:
        stored = {key: json.loads(metadata[key]) for key in ("data", "healthy") if key in metadata}
        content = Known.model_validate(stored)
        missing = list(_missing_keys(content.data.model_dump(mode="json"), stored["data"], "data"))
        problem = f"{', '.join(missing)}: missing" if missing else ""
        if not problem and metadata.get("data_set", content.data.hash) != content.data.hash:
            problem = "it is not as it was written: its hash is another one"
    except ValidationError as error:
        problem = _in_words(error)
    except (ValueError, RecursionError) as error:  # no JSON
        problem = str(error)
    if problem:
        message = f"{log}: its data set cannot be used: {problem}"
        raise SourceError(message, _log_hint(metadata))
    return content


def _weak_in_log(metadata: Mapping[str, str]) -> dict[str, float]:
    """Weak phases of the twin of a recording; none if the log has nothing that can be read."""
    with suppress(ValueError, RecursionError):
        return provenance.weak_phases(json.loads(metadata.get(provenance.WEAK, "{}")))
    return {}


def _in_words(error: ValidationError, kind: type[Settings] = Known) -> str:
    """The errors of stored tables in words: key, problem and value."""
    return "; ".join(
        f"{path_in_words(without_tags(kind, problem['loc']))}: {finding}"
        for problem, finding in findings(error, kind)
    )


def _missing_keys(whole: Any, given: Any, prefix: str = "") -> Iterator[str]:
    """The keys of ``whole`` that are missing in ``given``, through nested tables and lists.

    An empty catalogue of effects may be missing: it does not affect the pressure.
    """
    if isinstance(whole, Mapping) and isinstance(given, Mapping):
        for key, value in whole.items():
            path = f"{prefix}.{key}".removeprefix(".")
            if key in given:
                yield from _missing_keys(value, given[key], path)
            elif value or key != "catalogue":
                yield path
    elif isinstance(whole, list | tuple) and isinstance(given, list | tuple):
        for number, (item, given_item) in enumerate(zip(whole, given, strict=True)):
            yield from _missing_keys(item, given_item, f"{prefix}.{number}")
