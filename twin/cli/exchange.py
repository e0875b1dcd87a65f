"""``twin export-fmu``: the model of one ejector for other people's simulations."""

import sys
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.console import status
from twin.cli.options import FMU, SSP
from twin.cli.options import output as output_option
from twin.errors import ConfigError, known_names
from twin.files import write_whole

if TYPE_CHECKING:
    from twin.config import Config
    from twin.exchange.variables import Component
    from twin.settings import Document


class Vessel(StrEnum):
    """Where the vessel is simulated."""

    INSIDE = "inside"
    OUTSIDE = "outside"


class Fmi(StrEnum):
    """Version of the standard."""

    THREE = "3"
    TWO = "2"


def export_fmu(
    config: Annotated[
        Path | None, typer.Option(metavar="CONFIG", help="Its unit, data and asset database.")
    ] = None,
    unit: Annotated[
        str, typer.Option("--id", metavar="ID", help="Unit or type; default: of the configuration.")
    ] = "",
    assets: Annotated[
        str, typer.Option("--assets", metavar="URL", help="Asset database, instead of the default.")
    ] = "",
    output: Annotated[Path | None, output_option(FMU, SSP)] = None,
    fmi: Annotated[Fmi, typer.Option(help="3.0, or 2.0 for older tools.")] = Fmi.THREE,
    vessel: Annotated[
        Vessel, typer.Option(help="Part of the FMU, or somebody else's at its port.")
    ] = Vessel.INSIDE,
    sources_only: Annotated[bool, typer.Option("--sources-only", help="Compile nothing.")] = False,
) -> None:
    """Write an ejector as an FMU for co-simulation: C from the twin's model, no Python inside.

    The default is ID.fmu. An .ssp has the FMU and two parameter sets: the type's, and over it what
    is the unit's own.
    """
    from importlib.metadata import version

    from twin.config import Config
    from twin.exchange.fmu import make_fmu
    from twin.exchange.ssp import make_ssp
    from twin.exchange.variables import Component

    document, requested = _document(config, unit, assets)
    settings = Config.of(document, assets, requested)
    name = settings.asset.id or settings.asset.type
    program = f"ejector-twin {version('ejector-twin')}"
    component = Component.of(settings.data, vessel.value)
    with status() as say:
        say("translating the model to C" + ("" if sources_only else " and compiling it"))
        fmu = make_fmu(
            component, name, settings.origin, program, int(fmi.value), compiled=not sources_only
        )
    target = output or Path(fmu.name)
    content = fmu.content
    if target.suffix.lower() == SSP:
        kind = Config.of(document, assets, requested, calibrated=False)
        content = make_ssp(fmu, name, component, component.with_data(kind.data))
    write_whole(target, content)
    _remark(settings, component, binary=fmu.binary, is_compiled=not sources_only)
    print(f"{name} in {target}: FMI {fmi.value}.0, {settings.origin}")


def _document(config: Path | None, name: str, assets: str) -> "tuple[Document, str]":
    """The configuration, and the unit that replaces its own.

    Without a configuration it is one that names a unit or type of the database.
    """
    from twin.assets.database_url import open_chosen
    from twin.settings import Document

    if config is not None:
        document = Document.read(config)
        asset = document.tables.get("asset", {})
        if name and name == asset.get("type"):
            return replace(document, tables={**document.tables, "asset": {"type": name}}), ""
        return document, name
    if not name:
        raise ConfigError("of which ejector?", "name it with --id, or give a --config")
    with open_chosen(assets, None, write=False) as database:
        records = database.records(name=name)
        if not records:
            hint = known_names(name, (record.name for record in database.records()))
            raise ConfigError(f"{database.name}: no type or unit is called {name!r}", hint)
    newest = max(records, key=lambda record: record.recorded_ns)
    asset = {"type": newest.type, "id": name if newest.kind == "instance" else ""}
    return Document("", "", {"asset": asset}), ""


def _remark(settings: "Config", component: "Component", *, binary: str, is_compiled: bool) -> None:
    """Print remarks on the FMU."""
    if settings.instead:
        print(settings.instead, file=sys.stderr)
    if settings.data.terms:
        print(
            "the data set's terms are left out: what data gave and no physics explains is not in"
            " the FMU",
            file=sys.stderr,
        )
    if component.remark:
        print(component.remark, file=sys.stderr)
    if is_compiled:
        text = f"compiled: {binary}" if binary else "no C compiler for this platform: sources alone"
        print(text, file=sys.stderr)
