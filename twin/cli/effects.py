"""``twin effects``: list the effects, and add found ones to a catalogue."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from twin.cli.app import App, read_config, say_if_new
from twin.cli.console import status
from twin.cli.options import JsonAlone
from twin.errors import ConfigError, SourceError
from twin.files import require_writable, write_json

if TYPE_CHECKING:
    from twin.assets.database import Assets
    from twin.assets.record import Record
    from twin.diagnosis.propose import Proposal
    from twin.model.effects import Effect
    from twin.model.mechanism import Place, When

effects_app = App("The ways a real ejector can differ from its data set.", alone=True)


@effects_app.callback(invoke_without_command=True)
def list_(context: typer.Context, json_file: JsonAlone = None) -> None:
    """List the effects, their courses, and what a mechanism that nobody listed can be made of.

    Those that were taken in stand with their type or unit: twin assets show NAME.
    """
    if context.invoked_subcommand:
        if json_file is not None:
            raise ConfigError("--json is for the list of effects", "leave it out")
        return
    require_writable(json_file)
    from twin.model.courses import table as courses
    from twin.model.effects import table
    from twin.model.mechanism import places_table, whens_table

    tables = (text.replace("<br>", "; ") for text in (places_table(), whens_table()))
    heading = "Where and when something can act that is none of these:"
    print(table("; "), courses(), heading, *tables, sep="\n\n")
    if json_file is not None:
        write_json(json_file, _plain())


def _plain() -> dict[str, Any]:
    """The effects, their courses, and what mechanisms can be made of, as JSON."""
    from twin.model.courses import MEANING
    from twin.model.effects import EFFECTS
    from twin.model.mechanism import PLACES, WHENS

    return {
        "effects": [
            _described(effect) | {"look_at": effect.look_at} for effect in EFFECTS.values()
        ],
        "courses": [{"name": str(course), "sentence": MEANING[course]} for course in MEANING],
        "places": [_described(place) for place in PLACES.values()],
        "whens": [_described(when) for when in WHENS.values()],
    }


def _described(part: "Effect | Place | When") -> dict[str, Any]:
    """Name, sentence and parameters with unit and bounds."""
    parameters = [
        {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high} for p in part.parameters
    ]
    return {"name": part.name, "sentence": part.sentence, "parameters": parameters}


@effects_app.command()
def add(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.toml", help="As twin diagnose --propose wrote it.")
    ],
    *,
    unit: Annotated[str, typer.Option("--id", metavar="ID", help="For this unit alone.")] = "",
    kind: Annotated[
        str, typer.Option("--type", metavar="TYPE", help="For all of a type, not the file's.")
    ] = "",
    site: Annotated[
        bool, typer.Option("--site", help="For all types that the database has.")
    ] = False,
    log: Annotated[
        Path | None, typer.Option(metavar="LOG.mcap", help="Where the log of its test is now.")
    ] = None,
    untested: Annotated[bool, typer.Option("--untested", help="Take it without its test.")] = False,
    assets: Annotated[str, typer.Option("--assets", metavar="URL", help="Asset database.")] = "",
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", metavar="CONFIG", help="Take [assets] url, or the file beside it."
        ),
    ] = None,
) -> None:
    """Take an effect that was found into a catalogue: from then on it is searched for, and named.

    Its test comes first: with it in the catalogue, a diagnosis of the log that it was found in must
    name it.
    """
    from twin.assets.catalogue import take_in
    from twin.assets.database_url import open_chosen
    from twin.diagnosis.propose import Proposal

    if sum(map(bool, (unit, kind, site))) > 1:
        raise ConfigError("--id, --type and --site exclude each other", "take one of them")
    proposal = Proposal.read(file)
    document = read_config(config) if config else None
    with open_chosen(assets, document, write=False, to_store=True) as database:
        _targets(database, proposal, unit, kind, site)  # before the test takes its time
    if untested:
        print("not tested", file=sys.stderr)
    else:
        _test(proposal, file, log, assets)
    say_if_new(assets, document)
    entry = proposal.effect.model_dump(mode="json")
    with open_chosen(assets, document, write=True) as database:
        for target in _targets(database, proposal, unit, kind, site):
            record = take_in(database, target, proposal.name, entry, file.name)
            print(f"{record.name}: {proposal.name} added, {record.hash} in {database.name}")


def _targets(
    database: "Assets", proposal: "Proposal", unit: str, kind: str, site: bool
) -> "list[Record]":
    """The records that take the effect into their catalogue."""
    from twin.assets.catalogue import target_of

    if site:
        types = sorted({record.name for record in database.records("type")})
        return [target_of(database, type_name, "") for type_name in types]
    return [target_of(database, kind or proposal.type, unit)]


def _test(proposal: "Proposal", file: Path, log: Path | None, assets: str) -> None:
    """ConfigError if a diagnosis of the effect's log does not name it, or the log differs."""
    from twin.assets.provenance import of_log
    from twin.config import Config
    from twin.diagnosis.propose import named_on
    from twin.log.reader import open_log

    path = log or Path(proposal.test.log)
    skip = "say where it is with --log LOG.mcap, or take the effect without its test: --untested"
    if not path.exists():
        raise SourceError(f"{path}: the log of the test of {file} is not there", skip)
    if of_log(path)["log_sha256"] != proposal.test.log_sha256:
        raise ConfigError(f"{path}: not the log that the effect was found in", skip)
    recorded = open_log(path)
    settings = Config.of_recorded(recorded.header, str(path))
    if settings.data.hash != proposal.effect.found_in.get(
        "data_set"
    ):  # it was found beside another
        settings = Config.of_recorded(recorded.header, str(path), assets=assets, unit=proposal.unit)
    print(f"testing on {path}", file=sys.stderr)
    with status() as say:
        reason = named_on(proposal, settings, recorded, str(path), say)
    if reason:
        raise ConfigError(
            f"{file}: with it in the catalogue, a diagnosis of {path} does not name it: {reason}",
            "widen low and high of its parameters, or take it without its test: --untested",
        )
    print(f"{proposal.name} is named on {path}")
