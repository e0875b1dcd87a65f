"""``twin fleet``: thousands of logs, each processed once, and compared."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from twin.cli.app import App, read_config, say_if_cut, say_if_new
from twin.cli.options import (
    JSON,
    PAGE,
    JsonAlone,
    JsonFile,
    LanguageCode,
    PageFile,
    written_as,
)
from twin.cli.options import chosen as chosen_file
from twin.cli.options import output as output_option
from twin.errors import ConfigError, SourceError
from twin.extras import require
from twin.files import require_writable, write_json
from twin.languages.choice import language_of
from twin.languages.texts import ENGLISH

if TYPE_CHECKING:
    from sqlalchemy import URL

    from twin.config import Config
    from twin.fleet.engines import Submit
    from twin.fleet.runner import Outcome
    from twin.log.reader import Log
    from twin.settings import Document

fleet_app = App("Many logs: work on each once, and compare.")


Item = TypeVar("Item")


class EngineName(StrEnum):
    """The engine that does the work."""

    LOCAL = "local"
    DASK = "dask"


Logs = Annotated[list[Path], typer.Argument(metavar="LOGS", help="Logs, or folders of them.")]
SomeLogs = Annotated[
    list[Path] | None, typer.Argument(metavar="LOGS", help="Default: all that were worked on.")
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="Instead of each log's own.")]
Assets = Annotated[
    str, typer.Option("--assets", metavar="URL", help="Asset database; it keeps the answers.")
]
Engine = Annotated[EngineName, typer.Option(help="Processes here, or a Dask cluster.")]
Scheduler = Annotated[
    str, typer.Option(metavar="ADDRESS", help="Where Dask's is: tcp://host:8786.")
]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes here; else one for each core.")]
FormerReport = Annotated[  # the former name of --report
    Path | None, typer.Option("--html", hidden=True, callback=written_as(PAGE))
]

# What a kind of work does with a log.
_ACTIONS = {"calibrate": "used", "diagnose": "diagnosed", "replay": "replayed"}
_DESCRIPTIONS = {
    "calibrate": "Fit every unit to its log of healthy cycles, and store its data set.",
    "diagnose": "Say of every log what the simulation gets wrong, and why.",
    "replay": "Run the twin over every log: mean key figures, and how much of every effect.",
}


def _command(work: str) -> Callable[..., None]:
    """The command of one kind of work."""

    def command(
        logs: Logs,
        config: ConfigFile = None,
        assets: Assets = "",
        engine: Engine = EngineName.LOCAL,
        scheduler: Scheduler = "",
        workers: Workers = None,
        json_file: JsonAlone = None,
    ) -> None:
        require_writable(json_file)
        files, workers_of = _files(logs), _Engine(engine, scheduler, workers)  # before a database
        fleet = _Fleet.of(config, assets)
        outcomes = _done(work, files, fleet, workers_of)
        if json_file is not None:
            write_json(json_file, {"work": work, "logs": _plain(outcomes, fleet)})
        _leave(outcomes)

    return command


for _name, _help in _DESCRIPTIONS.items():
    fleet_app.command(_name, help=_help)(_command(_name))


@fleet_app.command()
def report(
    logs: SomeLogs = None,
    *,
    config: ConfigFile = None,
    assets: Assets = "",
    engine: Engine = EngineName.LOCAL,
    scheduler: Scheduler = "",
    workers: Workers = None,
    output: Annotated[Path | None, output_option(PAGE, JSON)] = None,
    json_file: JsonFile = None,
    report: PageFile = None,
    former_report: FormerReport = None,
    language: LanguageCode = ENGLISH.code,
) -> None:
    """Say which units stand out or drift, and in what, worst first; new logs are replayed."""
    from twin.assets.database import open_assets
    from twin.fleet.report import Refused
    from twin.fleet.report import report as put_together
    from twin.fleet.results_database import open_store

    json_file = chosen_file(output, "--json", json_file, JSON)
    page = chosen_file(output, "--report", report or former_report, PAGE)
    require_writable(json_file, page)
    page_language = language_of(language, "--language")
    files, workers_of = _files(logs or []), _Engine(engine, scheduler, workers)
    from twin.fleet.report_page import (  # with Matplotlib, which the engine requires
        in_words,
        write_page,
    )

    fleet = _Fleet.of(config, assets, to_store=bool(files))
    outcomes = _done("replay", files, fleet, workers_of) if files else []
    with open_store(fleet.assets) as store, open_assets(fleet.assets) as database:
        results, records = store.newest(), database.records()
    if logs:
        hashes = {outcome.key.log_sha256 for outcome in outcomes if outcome.key}
        results = [result for result in results if result.key.log_sha256 in hashes]
    if not results:
        raise SourceError(f"{fleet.name}: no log was worked on", "name logs, or folders of them")
    refused = [Refused(str(outcome.log), outcome.error) for outcome in outcomes if outcome.error]
    fleet_report = put_together(results, records, time.time_ns(), refused)
    print(in_words(fleet_report))
    if json_file is not None:
        write_json(json_file, fleet_report.plain())
    if page is not None:
        write_page(fleet_report, page, page_language)
        print(f"drawn in {page}")
    _leave(outcomes)


@dataclass(frozen=True)
class _Engine:
    """The engine that the command line asks for."""

    name: EngineName
    scheduler: str
    workers: int | None

    def __post_init__(self) -> None:
        """ConfigError for options that do not fit together, or without the extra."""
        require("fleet", "twin fleet")
        if self.name is EngineName.LOCAL:
            if self.scheduler:
                raise ConfigError("a scheduler is Dask's", "add --engine dask")
            return
        if self.workers is not None:
            raise ConfigError("a cluster has the workers it has", "leave --workers away")
        if not self.scheduler:
            raise ConfigError("no scheduler is named", "give --scheduler tcp://HOST:8786")

    @contextmanager
    def open(self) -> "Iterator[Submit]":
        """Open the engine while the context lasts; gives the function that submits jobs."""
        from twin.fleet.engines import cores, dask, local

        if self.name is EngineName.LOCAL:
            with local(self.workers or cores()) as submit:
                yield submit
            return
        with dask(self.scheduler) as submit:
            yield submit


@dataclass(frozen=True)
class _Fleet:
    """The configuration for every log, and the database for answers."""

    document: "Document | None"
    assets: "URL"
    name: str

    @classmethod
    def of(cls, config: Path | None, assets: str, *, to_store: bool = True) -> "_Fleet":
        """Open it; a missing database is created if answers are ``to_store`` in it."""
        from twin.assets.database_url import chosen, is_new, open_chosen
        from twin.assets.engine import shown

        document = None if config is None else read_config(config)
        if not to_store and is_new(assets, document):
            raise SourceError(
                f"{shown(chosen(assets, document))}: no such asset database",
                "name logs, or folders of them",
            )
        say_if_new(assets, document)
        with open_chosen(assets, document, write=True) as database:
            return cls(document, chosen(assets, document), database.name)

    def config_of(self, log: "Log", work: str) -> "Config":
        """The configuration with the present data set of a log's unit, or of its type."""
        from twin.config import Config, document_in

        header = log.header
        document = self.document or document_in(header)
        unit = header.asset_id
        if work == "calibrate" and not unit:
            raise ConfigError(f"{log.path}: a log of no unit", "record it with [asset] id, or --id")
        calibrated = work != "calibrate"
        config = Config.of(document, self.assets, unit, calibrated=calibrated, own=unit)
        config.refuse_another(header, str(log.path))
        return config.of_rows(header)


def _done(work: str, files: Sequence[Path], fleet: _Fleet, engine: _Engine) -> "list[Outcome]":
    """Process logs that are not yet done; print failures and a summary; outcomes in order."""
    from twin.fleet.results_database import open_store
    from twin.fleet.runner import Outcome, ask, go

    pending = ask(work, files, lambda log: fleet.config_of(log, work))
    requests = list(_progress(pending, len(files), "reading logs"))
    jobs = [job for job in requests if not isinstance(job, Outcome)]
    outcomes = [outcome for outcome in requests if isinstance(outcome, Outcome)]
    for outcome in outcomes:
        print(f"twin: {outcome.error}", file=sys.stderr)
    for job in jobs:
        say_if_cut(job, job.job.log, _ACTIONS[work])
    with open_store(fleet.assets) as store, engine.open() as submit:
        for outcome in _progress(go(jobs, submit, store, fleet.assets), len(jobs), work):
            outcomes.append(outcome)
            if outcome.error:
                print(f"twin: {outcome.error}", file=sys.stderr)
    count = {
        state: sum(outcome.state == state for outcome in outcomes)
        for state in ("done", "known", "failed")
    }
    cut = sum(not outcome.complete for outcome in outcomes)
    print(
        f"{work}: {count['done']} of {len(outcomes)} logs done, {count['known']} were known,"
        f" {count['failed']} could not be{f', {cut} cut off' if cut else ''}; in {fleet.name}"
    )
    position = {log: number for number, log in enumerate(files)}
    return sorted(outcomes, key=lambda outcome: position[outcome.log])


def _leave(outcomes: "Iterable[Outcome]") -> None:
    """Exit as for an unreadable log if any log failed; all others are done."""
    if any(outcome.error for outcome in outcomes):
        raise typer.Exit(SourceError.exit_code)


def _files(logs: Sequence[Path]) -> list[Path]:
    """The named logs, and all logs in the named folders."""
    from twin.log.part import first_parts

    paths: list[Path] = []
    for path in logs:
        paths += first_parts(path) if path.is_dir() else [path]
    if logs and not paths:
        raise SourceError(f"{logs[0]}: no log in it", "name logs, or folders with *.mcap")
    return list(dict.fromkeys(paths))


def _progress(items: "Iterable[Item]", total: int, label: str) -> "Iterator[Item]":
    """Show progress and remaining time on a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(
        items, label, total, console=console, transient=True, disable=not console.is_terminal
    )


def _plain(outcomes: "Iterable[Outcome]", fleet: _Fleet) -> list[dict[str, object]]:
    """The outcome of every log for JSON, with its answer."""
    from twin.fleet.results_database import open_store

    with open_store(fleet.assets) as store:
        return [
            {
                "log": str(outcome.log),
                "state": outcome.state,
                "error": outcome.error or None,
                "log_complete": outcome.complete if outcome.key else None,
                "answer": store.answer(outcome.key) if outcome.key else None,
            }
            for outcome in outcomes
        ]
