"""The twin's own part of a configuration: which asset, what is known of it, when to raise an alarm.

What is known lies in layers, each over the one before: the defaults; the object-specific data set
of the type in the asset database; ``[data]``; the instance-specific data set of the unit in the
asset database. Where they came from is kept.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError

from twin.assets.diagram import FLOW, SUPPLY, VACUUM
from twin.assets.record import Found, Record, UnknownAssetError
from twin.errors import ConfigError, SourceError, known_names
from twin.log.header import LogHeader
from twin.model.catalogue import effects_in
from twin.model.dataset import DataSet
from twin.model.diagram import reduce
from twin.monitor.healthy import Healthy
from twin.monitor.monitor import MonitorSettings
from twin.settings import Document, Settings
from twin.signals import MBAR
from twin.validation import findings, path_in_words, without_tags

if TYPE_CHECKING:  # a log brings its own data set, and need not wait for its SQLAlchemy
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
    "outlets",
    "page",
    "plc",
    "results",
    "webhook",
}
NO_TYPE = "unknown"
FROM_AMBIENT = ("gauge", "vacuum")  # references of a tag
COUNTED_FROM, AMBIENT = "counted_from", "ambient"  # in a log's metadata, of its pressure
IN_A_LOG = {"asset", "data", "driver", "figures", "import", "log", "monitor"}  # heeded in one
PLACES = {"url", "password", "keep"}  # keys of them that are not
SHIPPED = "sqlite://"  # the data sets that come with the program
HAND_WRITTEN = "[data] of the configuration"
_WORDS = {"type": "object-specific data", "instance": "instance-specific data"}

Tables = Mapping[str, Any]  # as [data] has them


class Asset(Settings):
    """The ejector: its type (object-specific data) and the one unit (instance-specific data)."""

    type: str = NO_TYPE  # of the ejector, as in the asset database (twin assets list)
    id: str = ""  # of this one unit, as a calibration stores it
    batch: str = ""  # of production, as on the nameplate: what fleets are compared by


class LogSettings(Settings):
    """How logs are kept."""

    rotate_mb: float = Field(64.0, gt=0.0)  # a new part begins beyond this size
    keep_days: float | None = Field(
        None, gt=0.0
    )  # older ones are deleted; as long as there is room
    keep_gb: float | None = Field(None, gt=0.0)  # of all logs of the unit in the folder
    disk_pct: float = Field(80.0, gt=0.0, le=100.0)  # of the disk in use; beyond it the oldest go


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
    origin: str = HAND_WRITTEN  # where the data set is from, in words
    instead: str = ""  # of the unit's own data set, which nobody has: what is used, in words
    gauge: bool = False  # whether the pressure sensor counts from ambient, as far as is known

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

        ``assets`` names the database in place of the configuration's, ``unit`` the ID in place of
        its own: ConfigError if the database does not know it and it is not ``own``, that of a log.
        Not ``calibrated`` is the unit as its type has it, whatever is known of itself: it may be
        new. ``as_of_ns`` (UTC) takes what the database knew then. ``to_store`` allows a database
        that is not there yet.
        """
        from twin.assets.database_url import open_chosen

        document.refuse_unknown_tables(TABLES)
        _refuse_calibrated(document)
        asset = _asset(document, unit)
        to_store = to_store or not calibrated  # what is not, is read to be calibrated and stored
        with open_chosen(assets, document, write=False, to_store=to_store) as database:
            if unit and calibrated and unit not in (own, document.section(Asset, "asset").id):
                _require_unit(database, unit, {own, document.section(Asset, "asset").id} - {""})
            found = _find(database, document, asset.type, asset.id if calibrated else "", as_of_ns)
            where = database.name
        known = _layered(document, found, where)
        config = cls._checked(document, asset, known, _origin(found, known))
        if calibrated and not (found and found.used == "instance"):
            config = replace(config, instead=_instead(asset, found, where))
        return config

    @classmethod
    def of_log(cls, document: Document, metadata: Mapping[str, str], log: str) -> "Config":
        """The configuration of a log, with the data set it was recorded beside.

        SourceError names ``log`` and the key where this program cannot take either of them.
        """
        if "data" not in metadata:
            return cls.of(document, SHIPPED)
        known = _of_log(metadata, log)
        with _in_log(metadata, log):
            document.refuse_unknown_tables(TABLES)
            asset = document.section(Asset, "asset")
            return cls._checked(document, asset, known, metadata.get("origin", "the log"))

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
        """The configuration a log carries, with the data set it was made with; or ``instead``.

        Where a database, a unit or a time is named the data set is looked up anew, as in ``of``.
        A database that is to be made knows nothing to look up.
        """
        from twin.assets.database_url import is_new

        with _in_log(header.metadata, log):
            document = instead or document_in(header)
        known = bool(assets) and not (to_store and is_new(assets, document))
        if instead is not None or known or unit or as_of_ns is not None:
            own = header.asset_id
            config = cls.of(document, assets, unit, as_of_ns=as_of_ns, own=own, to_store=to_store)
        else:
            config = cls.of_log(document, header.metadata, log)
            # --id may have named another unit than the configuration does.
            named = {"type": header.asset_type, "id": header.asset_id}
            config = replace(config, asset=config.asset.model_copy(update=named))
        return config.of_rows(header)

    def of_rows(self, header: LogHeader) -> "Config":
        """The same for the rows of a log: they say what their pressure counts from."""
        gauge = self.gauge or header.metadata.get(COUNTED_FROM) == AMBIENT
        return self if gauge == self.gauge else replace(self, gauge=gauge)

    def log_header(self, unmeasured: Mapping[str, str] | None = None) -> LogHeader:
        """What a log of this unit must carry to be replayed alone.

        ``unmeasured`` says what of its rows was not measured (``LogHeader.unmeasured``).
        """
        metadata = {
            "program": version("ejector-twin"),
            "data_set": self.data.hash,
            "origin": self.origin,
            "data": self.data.model_dump_json(),
            "healthy": self.monitor.healthy.model_dump_json(),
            **({COUNTED_FROM: AMBIENT} if self.gauge else {}),
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
        asked = self.asset.type, self.asset.id
        if all((*recorded, *asked)) and recorded != asked:
            raise ConfigError(
                f"{log} is a log of {' '.join(recorded)}, {self.document.name} is for"
                f" {' '.join(asked)}",
                "take the log's own configuration (no --config), or say with --id which unit to"
                " compare it with",
            )

    @classmethod
    def _checked(cls, document: Document, asset: Asset, known: Known, origin: str) -> "Config":
        effects_in(known.data.catalogue)  # known by name from here on, in words as in alarms
        monitor = document.section(MonitorSettings, "monitor")
        monitor = monitor.model_copy(update={"healthy": known.healthy})
        log = document.section(LogSettings, "log")
        gauge = _counts_from_ambient(document.tables)
        return cls(document, asset, known.data, monitor, log, origin, gauge=gauge)


def _counts_from_ambient(tables: Tables) -> bool:
    """Whether the tag, or the column, of the pressure is said to count from ambient."""
    with suppress(KeyError, TypeError):
        return bool(tables["driver"]["tags"]["pressure"]["reference"] in FROM_AMBIENT)
    with suppress(KeyError, TypeError):
        columns = tables["import"]["columns"]
        said = columns.get("pressure")
        gauge = isinstance(said, Mapping) and said.get("reference") in FROM_AMBIENT
        return gauge or any(str(name).startswith("vacuum") for name in columns)
    return False


def document_in(header: LogHeader) -> Document:
    """The configuration that a log carries; ConfigError if it is not TOML.

    A log may be anybody's. So what names places to open is left out: databases, files, services.
    Older ones have what a calibration found, which stands in the log itself as well.
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
    """ConfigError with file, line and key if a record read from a file would be of no use.

    A unit is checked over what the database has of its type.
    """
    below: Tables = {}
    if record.kind == "instance":
        kind = database.get(record.type).record
        below = _laid(kind, {}, partial(_in_record, kind, database.name))
    _laid(record, below, partial(_in_file, document))
    replace(document, tables={"healthy": record.healthy}).section(Known)


def _refuse_calibrated(document: Document) -> None:
    """ConfigError if a person's file has what only a calibration can know."""
    monitor = document.tables.get("monitor", {})
    if isinstance(monitor, Mapping) and "healthy" in monitor:
        raise ConfigError(
            f"{document.name}: [monitor.healthy]: what a calibration found stands in the asset"
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


def _require_unit(database: "Assets", unit: str, others: set[str]) -> None:
    """ConfigError if nothing was ever known of ``unit``: its name is taken for a mistyped one.

    ``others`` may be meant too: the unit of the log and that of the configuration.
    """
    if not database.records("instance", unit):
        stored = {record.name for record in database.records("instance")}
        units = known_names(unit, stored | others)
        raise ConfigError(
            f"{database.name}: no unit is called {unit!r}",
            f"{units}\n  a new unit is named by [asset] id in the configuration; twin calibrate"
            " stores its data set",
        )


def _find(
    database: "Assets", document: Document, type_name: str, unit: str, as_of_ns: int | None
) -> Found | None:
    """What the database has; None where it knows neither unit nor type, but [data] does."""
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


def _origin(found: Found | None, known: Known) -> str:
    """Where the data set is from, in words."""
    if found is None:
        return HAND_WRITTEN
    words = _named(found.record)
    if found.base and any(_left_out(known.data.model_dump(), found.record.data)):
        words += f", over {_named(found.base)}"
    return words


def _named(record: Record) -> str:
    return f"{_WORDS[record.kind]} of {record.name}, record {record.id[:8]}"


def _instead(asset: Asset, found: Found | None, where: str) -> str:
    if not asset.id:
        return ""
    if found is None:
        nobody = f"no data set of {asset.id!r} or its type {asset.type!r} in {where}"
        return f"{nobody}; using {HAND_WRITTEN}"
    nobody = f"no instance-specific data set of {asset.id!r} in {where}"
    return f"{nobody}; using the type's {asset.type!r}"


# --- layers -------------------------------------------------------------------------------------


def _layered(document: Document, found: Found | None, where: str) -> Known:
    """What is known of an asset; every layer is checked by itself, so that the right one is named.

    ConfigError too if the unit was calibrated on another system than the configuration has.
    """
    kind = found.base or found.record if found else None
    below = _laid(kind, {}, partial(_in_record, kind, where)) if kind else {}
    tables = _merged(below, document.tables.get("data", {}))
    known = _in_file(document, tables)
    if found is None or found.used == "type":
        return known
    unit = found.record
    check = partial(_in_record, unit, where)
    own = check(_laid(unit, tables, check))
    configured = "parts" in document.tables.get("data", {}).get("system", {})
    if configured and own.data.system.parts != known.data.system.parts:
        raise ConfigError(
            f"{document.name}: {unit.name} was calibrated on another system than"
            " [data.system.parts] has",
            "calibrate it again on this one (twin calibrate), or give it another id",
        )
    return own


def _laid(record: Record, below: Tables, check: Callable[[Tables], object]) -> Tables:
    """A record over what lies ``below``; what it says outright holds over what its diagram says."""
    tables: Tables = _merged(below, record.data)
    check(tables)
    if VACUUM not in record.arrays:
        return tables
    try:
        diagram = _reduced(record, DataSet.model_validate(tables))
        tables = _merged(_merged(below, diagram), record.data)
        DataSet.model_validate(tables)
    except (ConfigError, ValidationError) as error:
        why = _in_words(error, DataSet) if isinstance(error, ValidationError) else str(error)
        raise ConfigError(
            f"{record.kind} {record.name!r}: the model cannot follow its characteristic diagram:"
            f" {why}",
            "check its rows: one peak over operating pressure, and capacity that falls with vacuum",
        ) from error
    return tables


def _reduced(record: Record, data: DataSet) -> Tables:
    """What a record's characteristic diagram says."""
    axes = record.arrays[VACUUM], record.arrays[SUPPLY]
    nominal, ambient = data.supply.nozzle_bar, data.ambient.pressure_mbar
    return reduce(*axes, record.arrays[FLOW], nominal, ambient).tables


def _merged(base: Any, over: Any) -> Any:
    """``over`` laid over ``base``, table by table."""
    if not (isinstance(base, Mapping) and isinstance(over, Mapping)):
        return over
    return {**base, **{key: _merged(base.get(key), value) for key, value in over.items()}}


# --- checks, each naming where a wrong key stands -----------------------------------------------


def _in_file(document: Document, tables: Tables) -> Known:
    merged = replace(document, tables={**document.tables, "data": tables})
    return Known(data=merged.section(DataSet, "data"))


def _in_record(record: Record, where: str, tables: Tables) -> Known:
    try:
        return Known.model_validate({"data": tables, "healthy": record.healthy})
    except ValidationError as error:
        unfit = f"record {record.id[:8]} of {record.kind} {record.name!r} cannot be used"
        raise ConfigError(
            f"{where}: {unfit}: {_in_words(error)}",
            f"twin assets show {record.name} prints it; add one that is right: twin assets add",
        ) from error


@contextmanager
def _in_log(metadata: Mapping[str, str], log: str) -> Iterator[None]:
    """Say of a configuration's faults that it stands in a log: there is no file to mend."""
    try:
        yield
    except ConfigError as error:
        message = f"{log}: the configuration in it cannot be used: {error}"
        raise SourceError(message, _instead_of_its_own(metadata)) from error


def _instead_of_its_own(metadata: Mapping[str, str]) -> str:
    return (
        "give another one with --config CONFIG, or use the ejector-twin that made the log"
        f" ({metadata.get('program', 'of unknown version')})"
    )


def _of_log(metadata: Mapping[str, str], log: str) -> Known:
    """All that a log says of the data set; nothing is made up where it leaves something out."""
    try:
        stored = {key: json.loads(metadata[key]) for key in ("data", "healthy") if key in metadata}
        known = Known.model_validate(stored)
        missing = list(_left_out(known.data.model_dump(mode="json"), stored["data"], "data"))
        problem = f"{', '.join(missing)}: missing" if missing else ""
        if not problem and metadata.get("data_set", known.data.hash) != known.data.hash:
            problem = "it is not as it was written: its hash is another one"
    except ValidationError as error:
        problem = _in_words(error)
    except (ValueError, RecursionError) as error:  # no JSON
        problem = str(error)
    if problem:
        message = f"{log}: its data set cannot be used: {problem}"
        raise SourceError(message, _instead_of_its_own(metadata))
    return known


def _in_words(error: ValidationError, kind: type[Settings] = Known) -> str:
    """What is wrong with stored tables: key, what, and what stands there."""
    return "; ".join(
        f"{path_in_words(without_tags(kind, problem['loc']))}: {what}"
        for problem, what in findings(error, kind)
    )


def _left_out(whole: Any, given: Any, at: str = "") -> Iterator[str]:
    """The keys of ``whole`` that are not in ``given``, where both have tables or lists.

    An empty catalogue of effects may be left out: it says nothing of the pressure.
    """
    if isinstance(whole, Mapping) and isinstance(given, Mapping):
        for key, value in whole.items():
            here = f"{at}.{key}".removeprefix(".")
            if key in given:
                yield from _left_out(value, given[key], here)
            elif value or key != "catalogue":
                yield here
    elif isinstance(whole, list | tuple) and isinstance(given, list | tuple):
        for number, (one, other) in enumerate(zip(whole, given, strict=True)):
            yield from _left_out(one, other, f"{at}.{number}")
