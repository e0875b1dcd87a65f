"""``twin assets``: show the asset database, add to it, export and import it."""

import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from twin.cli.app import App, read_config, say_if_new
from twin.cli.options import AASX, FMU, JSON, chosen, written_as
from twin.cli.options import output as output_option
from twin.errors import ConfigError, SourceError, known_names
from twin.extras import require
from twin.files import write_whole

if TYPE_CHECKING:
    from types import ModuleType

    from twin.assets.database import Assets
    from twin.assets.record import Record
    from twin.exchange.fmu_file import Fmu

assets_app = App("The asset database: type and ID to data sets.")

Url = Annotated[
    str,
    typer.Option("--assets", metavar="URL", help="Database: sqlite:///FILE, postgresql://..."),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="CONFIG", help="Take [assets] url, or the file beside it."),
]
Time = Annotated[str, typer.Option(metavar="TIME", help="UTC, for example 2026-05-31T14:00.")]


@assets_app.command("list")
def list_(assets: Url = "", config: ConfigFile = None) -> None:
    """List all types and units, each with the data set that holds now."""
    with _open(assets, config, write=False) as database:
        records = database.records()
    print(_table(records, time.time_ns(), _recorded_in(database)))


@assets_app.command()
def show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A type, or the ID of a unit.")],
    at: Time = "",
    as_of: Time = "",
    history: Annotated[bool, typer.Option("--history", help="All records, oldest first.")] = False,
    assets: Url = "",
    config: ConfigFile = None,
) -> None:
    """Show the data set of a type or unit, in the form that `add` takes.

    It is the one that holds now, or --at another time; with --as-of as it was known then.
    """
    from twin.assets.file import parse_time

    now = parse_time(at) if at else time.time_ns()
    as_of_ns = parse_time(as_of) if as_of else None
    with _open(assets, config, write=False) as database:
        records = database.records(name=name, as_of_ns=as_of_ns)
        _require(records, name, database)
    recorded = _recorded_in(database)
    if history:
        print("\n".join(_line_of_history(record, recorded) for record in records))
        return
    holding = _holding_each(records, now)
    if not holding:
        raise ConfigError(f"no data set of {name!r} holds at that time", "see --history")
    print("\n".join(_in_full(record, recorded) for record in holding), end="")


@assets_app.command()
def add(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="As `show` prints it.")],
    assets: Url = "",
    config: ConfigFile = None,
) -> None:
    """Add a data set of a type or unit; what was there stays and can be asked for.

    Without valid_from the first data set of an asset always holds, a later one from now on.
    """
    from importlib.metadata import version

    from twin.assets.file import read_asset, show_time
    from twin.assets.record import checked, holding
    from twin.config import check_asset
    from twin.settings import Document

    document = Document.read(file)
    provenance = {"file": file.name, "code": f"ejector-twin {version('ejector-twin')}"}
    unchecked, dated = read_asset(document, provenance)
    record = checked(unchecked)
    with _to_store(assets, config) as database:
        check_asset(document, record, database)  # before a new one is made
    with _open(assets, config, write=True) as database:
        before = database.records(record.kind, record.name)
        if before and not dated:
            record = replace(record, valid_from_ns=time.time_ns())
        present = holding(before, record.valid_from_ns)
        if present and (present.hash, present.type) == (record.hash, record.type):
            print(f"{present.name}: unchanged, {present.hash} already holds")
            return
        added = database.add(record)
        since = show_time(added.valid_from_ns)
        print(f"{added.name}: added {added.hash} to {database.name}, valid from: {since}")


@assets_app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="What `export` wrote.")],
    fmu: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", callback=written_as(FMU), help="Write the FMU of an .aasx to a file."
        ),
    ] = None,
    assets: Url = "",
    config: ConfigFile = None,
) -> None:
    """Take over the records of an exported database that are not here yet: JSON or .aasx."""
    if file.suffix.lower() == AASX:
        package = _shells().read_package(file)
        document, fmus = package.document, package.fmus
    else:
        document, fmus = _read_json(file), {}
    model = _only_fmu(file, fmus) if fmu is not None else b""
    with _to_store(assets, config, shipped=False) as database:
        database.refuse(document)  # before a new one is made
    with _open(assets, config, write=True, shipped=False) as database:
        count = database.import_(document)
        print(f"{count} new of {len(document['records'])} records, in {database.name}")
    if fmu is not None:
        write_whole(fmu, model)
        print(f"the FMU in {fmu}")
    elif fmus:
        print(f"not taken: {', '.join(sorted(fmus))}; --fmu FILE writes it", file=sys.stderr)


@assets_app.command()
def export(
    output: Annotated[Path | None, output_option(JSON, AASX)] = None,
    aasx: Annotated[
        Path | None,
        typer.Option(
            "--aasx",
            metavar="FILE.aasx",
            callback=written_as(AASX),
            help="Write Asset Administration Shells.",
        ),
    ] = None,
    unit: Annotated[
        str, typer.Option("--id", metavar="ID", help="Only this unit and its type.")
    ] = "",
    fmu: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The unit's simulation model, for --aasx.")
    ] = None,
    logs: Annotated[str, typer.Option(metavar="URL", help="Where logs are kept, for --aasx.")] = "",
    assets: Url = "",
    config: ConfigFile = None,
) -> None:
    """Write the database as one JSON document, or as shells in an AASX package.

    Without a file it is JSON on stdout.
    """
    aasx, output = chosen(output, "--aasx", aasx, AASX), chosen(output, "-o", None, JSON)
    _require_options(output, aasx, unit, fmu, logs)
    with _open(assets, config, write=False) as database:
        records = _of_unit(database, unit) if unit else database.records()
    if aasx is not None:
        models = {unit: _read_fmu(fmu)} if fmu is not None else {}
        content = _shells().write_package(records, time.time_ns(), models, logs)
        write_whole(aasx, content)
        print(f"{len(records)} records in {aasx}")
        return
    from twin.assets.exchange import to_export

    text = json.dumps(to_export(records), indent=1, ensure_ascii=False)
    if output is None:
        print(text)
    else:
        write_whole(output, f"{text}\n".encode())
        print(f"{len(records)} records in {output}")


# --- what the commands share --------------------------------------------------------------------


def _to_store(url: str, config: Path | None, *, shipped: bool = True) -> "Assets":
    """The database in which something will be stored, opened for reading; it may be new."""
    from twin.assets.database_url import open_chosen

    document = read_config(config) if config else None
    return open_chosen(url, document, write=False, shipped=shipped, to_store=True)


def _open(url: str, config: Path | None, *, write: bool, shipped: bool = True) -> "Assets":
    from twin.assets.database_url import open_chosen

    document = read_config(config) if config else None
    if write:
        say_if_new(url, document)
    database = open_chosen(url, document, write=write, shipped=shipped)
    print(f"asset database: {database.name}", file=sys.stderr)
    return database


def _holding_each(records: "Iterable[Record]", now: int) -> "list[Record]":
    """The valid record of every type, then of every unit."""
    from twin.assets.record import holding

    assets: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        assets.setdefault((record.kind, record.name), []).append(record)
    in_order = sorted(assets, key=lambda asset: (asset[0] == "instance", asset[1]))
    valid = (holding(assets[asset], now) for asset in in_order)
    return [record for record in valid if record is not None]


def _require(records: "list[Record]", name: str, database: "Assets") -> None:
    if not records:
        if database.records(name=name):
            raise ConfigError(
                f"{database.name}: nothing was known of {name!r} at that time", "see --history"
            )
        hint = known_names(name, (record.name for record in database.records()))
        raise ConfigError(f"{database.name}: no type or unit is called {name!r}", hint)


def _recorded_in(database: "Assets") -> "Callable[[Record], str]":
    """A function for the time at which a record was stored; shipped records never were."""
    from twin.assets.file import show_time

    if database.in_memory:
        return lambda _: "no, shipped"
    return lambda record: show_time(record.recorded_ns)


def _table(records: "list[Record]", now: int, recorded: "Callable[[Record], str]") -> str:
    from twin.assets.file import show_time

    rows = [("kind", "name", "type", "valid from", "recorded", "hash")]
    for record in _holding_each(records, now):
        times = show_time(record.valid_from_ns), recorded(record)
        rows.append((record.kind, record.name, record.type, *times, record.hash))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _line_of_history(record: "Record", recorded: "Callable[[Record], str]") -> str:
    from twin.assets.file import show_time

    since = show_time(record.valid_from_ns)
    source = ", ".join(f"{key} {value}" for key, value in record.provenance.items())
    times = f"recorded {recorded(record)}  valid from {since:<20}"
    return f"{times}  {record.kind}  {record.hash}  {source}"


def _in_full(record: "Record", recorded: "Callable[[Record], str]") -> str:
    from twin.assets.file import write_asset
    from twin.assets.provenance import VERDICT, WEAK, weak_phases
    from twin.diagnosis.text import weakness

    shown = {key: text for key, text in record.provenance.items() if key not in (VERDICT, WEAK)}
    judged = weakness(weak_phases(record.provenance.get(WEAK)))
    lines = [
        f"hash {record.hash}, recorded {recorded(record)}, id {record.id}",
        *(f"{key}: {value}" for key, value in shown.items()),
        *([judged] if judged else []),
        *(f"array {name}: shape {array.shape}" for name, array in record.arrays.items()),
    ]
    comments = "".join(f"# {line}\n" for text in lines for line in text.splitlines())
    return comments + write_asset(record)


def _read_json(file: Path) -> dict[str, Any]:
    """The document in a JSON file; the database checks whether it is an export."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        message = f"{file}: cannot be read: {error.strerror}"
        raise SourceError(message, "check the path") from error
    except UnicodeDecodeError as error:
        message = f"{file}: not a text file, so not an export"
        raise SourceError(message, "twin assets export makes one") from error
    except (ValueError, RecursionError) as error:
        hint = "twin assets export makes it"
        raise ConfigError(f"{file}: not valid JSON: {error}", hint) from error
    if not isinstance(document, dict):
        raise ConfigError(f"{file}: not an export of an asset database")
    return document


def _require_options(
    output: Path | None, aasx: Path | None, unit: str, fmu: Path | None, logs: str
) -> None:
    """ConfigError for options that do not fit together."""
    if aasx is not None and output is not None:
        raise ConfigError("-o and --aasx exclude each other", "export twice")
    if aasx is not None and aasx.suffix.lower() != AASX:
        raise ConfigError(f"{aasx}: not a package of shells", f"let it end in {AASX}")
    if aasx is None and (fmu is not None or logs):
        raise ConfigError("--fmu and --logs are for shells", "say --aasx FILE.aasx as well")
    if fmu is not None and not unit:
        raise ConfigError("the FMU is of one unit", "say which one with --id ID")


def _of_unit(database: "Assets", unit: str) -> "list[Record]":
    """The records of a unit and of its type, in order of recording."""
    of_unit = database.records("instance", unit)
    _require(of_unit, unit, database)
    types = {record.type for record in of_unit}
    return [
        record
        for record in database.records()
        if record.name in (types if record.kind == "type" else {unit})
    ]


def _only_fmu(file: Path, fmus: Mapping[str, bytes]) -> bytes:
    if len(fmus) != 1:
        names = ", ".join(sorted(fmus)) or "none"
        raise ConfigError(f"{file}: --fmu writes one FMU, and in it are: {names}", "leave it out")
    return next(iter(fmus.values()))


def _shells() -> "ModuleType":
    """The module for Asset Administration Shells; ConfigError if its library is not installed."""
    require("aas", "an Asset Administration Shell")
    from twin.exchange import aas

    return aas


def _read_fmu(path: Path) -> "Fmu":
    require("aas", "an FMU of a shell")
    from twin.exchange.fmu_file import read_fmu

    return read_fmu(path)
