"""``twin config``: all mistakes of a configuration at once, and its schema for editors."""

import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from twin.cli.app import App
from twin.errors import ConfigError, SourceError
from twin.keys import UNWRITTEN

if TYPE_CHECKING:
    from twin.settings import Document, Settings

config_app = App("Check a configuration, and help editors to write one.")
_SCHEMA = "https://json-schema.org/draft/2020-12/schema"
_LINE_NUMBER = re.compile(r":(\d+): ")


@config_app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="TOML configuration.")],
) -> None:
    """Name all mistakes of a configuration at once: line, key, and what to write."""
    from twin.settings import Document

    document = Document.read(file)
    messages = mistakes(document)
    for mistake in messages:
        print(mistake)
    if messages:
        count = "1 mistake" if len(messages) == 1 else f"{len(messages)} mistakes"
        print(f"twin: {file}: {count}", file=sys.stderr)
        raise typer.Exit(2)
    print(f"{file}: no mistake in {', '.join(f'[{name}]' for name in document.tables)}")


@config_app.command()
def schema() -> None:
    """Print the JSON Schema of configurations, for editors that complete and check TOML."""
    print(json.dumps(json_schema(), indent=1, ensure_ascii=False))


def sections() -> "dict[str, dict[str, type[Settings]]]":
    """The tables of a configuration by name, each with its settings by kind of driver or "".

    Drivers of other packages are left out: what is made of the tables is the same everywhere.
    """
    from drivers.outputs.settings import ResultsSettings
    from drivers.plc.settings import PlcSettings
    from drivers.sources import BUILT_IN
    from twin.alarms.settings import AlarmSettings
    from twin.assets.database_url import AssetsSettings
    from twin.config import Asset, LogSettings
    from twin.figures.settings import FigureSettings
    from twin.model.dataset import DataSet
    from twin.monitor.settings import MonitorSettings
    from twin.notifications.settings import (
        MqttSettings,
        NotificationSettings,
        OutletsSettings,
        WebhookSettings,
    )
    from twin.page.settings import PageSettings
    from twin.tables.settings import ImportSettings

    drivers = {kind: load() for kind, load in BUILT_IN.items()}
    return {
        "asset": {"": Asset},
        "data": {"": DataSet},
        "driver": {kind: driver.settings_class for kind, driver in drivers.items()},
        "import": {"": ImportSettings},
        "monitor": {"": MonitorSettings},
        "log": {"": LogSettings},
        "figures": {"": FigureSettings},
        "alarms": {"": AlarmSettings},
        "page": {"": PageSettings},
        "mqtt": {"": MqttSettings},
        "webhook": {"": WebhookSettings},
        "notifications": {"": NotificationSettings},
        "outlets": {"": OutletsSettings},
        "results": {"": ResultsSettings},
        "assets": {"": AssetsSettings},
        "hil": {
            kind: driver.hil_settings_class
            for kind, driver in drivers.items()
            if driver.hil_settings_class
        },
        "plc": {"": PlcSettings},
    }


def mistakes(document: "Document") -> list[str]:
    """All mistakes of a configuration, one line each, with what to do about it."""
    return sorted(dict.fromkeys(_mistakes(document)), key=_line)


def _mistakes(document: "Document") -> Iterator[str]:
    """The same in the order of the checks; some come more than once."""
    for problem in _checks(document):
        try:
            problem()
        except (ConfigError, SourceError) as error:  # of a file or database that it names
            lines = str(error).splitlines()
            yield from lines[:-1]
            yield lines[-1] + _advice(error)


def _advice(error: ConfigError | SourceError) -> str:
    """The hint of an error, unless its message has it already."""
    from twin.settings import ALL_MISTAKES

    return "" if error.hint in ("", ALL_MISTAKES) else f"; {error.hint}".replace("\n", ";")


def _checks(document: "Document") -> Iterator[Callable[[], Any]]:
    """Checks that may raise ConfigError: of each table, then of several tables together."""
    from drivers.sources import hil_settings_of, settings_of
    from twin.alarms.settings import chosen_rules
    from twin.config import TABLES, Config
    from twin.notifications.settings import chosen, chosen_upload
    from twin.page.alarm_mail import mail_language

    for name in document.tables:
        yield partial(document.refuse_unknown_tables, TABLES | set(document.tables) - {name})
    for name, kinds in sections().items():
        if name in document.tables and name != "data" and "" in kinds:
            yield partial(document.section, kinds[""], name)
    if "driver" in document.tables:
        yield partial(settings_of, document)
    if "hil" in document.tables:
        yield partial(hil_settings_of, document)
    yield partial(Config.of, document, to_store=True)
    if "data" in document.tables:  # a mistake in [asset] would hide those of [data]
        nobody = {name: document.tables[name] for name in TABLES & set(document.tables) - {"asset"}}
        yield partial(Config.of, replace(document, tables=nobody), to_store=True)
    yield partial(chosen_rules, document)
    yield partial(chosen, document)
    yield partial(chosen_upload, document)
    yield partial(mail_language, document)


def _line(mistake: str) -> int:
    match = _LINE_NUMBER.search(mistake)
    return int(match[1]) if match else 0


# --- schema -------------------------------------------------------------------------------------


def json_schema() -> dict[str, Any]:
    """The JSON Schema (2020-12) of a configuration, made from the settings' classes.

    It does not have rules on several keys at once; ``twin config check`` checks those too.
    """
    from pydantic.json_schema import models_json_schema

    from twin.keys import comments_of, defaults_of, tables_below

    kinds = sections()
    all_kinds = {
        table: None
        for by_kind in kinds.values()
        for kind in by_kind.values()
        for _, table in tables_below(kind)
    }
    names, schema = models_json_schema(
        [(kind, "validation") for kind in all_kinds], ref_template="#/$defs/{model}"
    )
    definitions = schema["$defs"]
    for kind in all_kinds:
        name = names[(kind, "validation")]["$ref"].rpartition("/")[2]
        _describe(definitions[name], comments_of(kind), defaults_of(kind))
    tables = {}
    for name, by_kind in kinds.items():
        refs = [names[(kind, "validation")] for kind in by_kind.values()]
        tables[name] = refs[0] if len(refs) == 1 else {"anyOf": refs}
    other = _other_than(kinds["driver"])
    tables["driver"]["anyOf"].append(other)
    of_built_in = {"properties": {"hil": tables["hil"]}}
    tables["hil"] = {"anyOf": [tables["hil"], {"type": "object"}]}  # what an editor offers
    reachable = _referenced(tables, definitions)
    return {
        "$schema": _SCHEMA,
        "title": "Configuration of ejector-twin",
        "type": "object",
        "properties": tables,
        "additionalProperties": False,
        "if": {"properties": {"driver": other}, "required": ["driver"]},
        "else": of_built_in,
        "$defs": {name: table for name, table in definitions.items() if name in reachable},
    }


def _other_than(kinds: Iterable[str]) -> dict[str, Any]:
    """The schema of a driver of another package: its keys are known to that package alone."""
    kind = {"type": "string", "not": {"enum": list(kinds)}}
    return {"type": "object", "properties": {"kind": kind}, "required": ["kind"]}


def _referenced(schema: Any, definitions: dict[str, Any]) -> set[str]:
    """Names of the definitions that a schema refers to, directly or indirectly."""
    names: set[str] = set()
    pending = [schema]
    while pending:
        new_names = set(re.findall(r'#/\$defs/(\w+)"', json.dumps(pending))) - names
        names |= new_names
        pending = [definitions[name] for name in new_names]
    return names


def _describe(table: dict[str, Any], comments: dict[str, str], defaults: dict[str, Any]) -> None:
    """Add descriptions of the keys to a table's schema, and defaults in the file's form."""
    for key in UNWRITTEN & set(table["properties"]):
        del table["properties"][key]
    for key, schema in table["properties"].items():
        schema.pop("title", None)
        schema.pop("default", None)
        if comments[key]:
            schema["description"] = comments[key]
        if defaults.get(key) is not None:
            schema["default"] = defaults[key]
