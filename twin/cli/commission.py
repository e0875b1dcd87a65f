"""``twin commission``: the data set of a unit of unknown type, from a record or from its PLC."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import say_if_cut, say_if_new
from twin.cli.console import status
from twin.cli.options import (
    JSON,
    LOG,
    PAGE,
    AssetsUrl,
    ConfigOption,
    JsonFile,
    LanguageCode,
    PageFile,
    UnitId,
    chosen,
    strictly,
)
from twin.cli.options import output as output_option
from twin.cli.recording import FEWEST_CYCLES
from twin.errors import ConfigError
from twin.files import require_writable, write_json
from twin.languages.choice import language_of
from twin.languages.texts import ENGLISH, Language

if TYPE_CHECKING:
    from twin.assets.record import Record
    from twin.calibration.commission import Commissioned
    from twin.config import Asset, Config


@dataclass(frozen=True)
class _Answers:
    """The files that an answer goes to, the page in its language."""

    json: Path | None
    page: Path | None
    language: Language

    def write(self, commissioned: "Commissioned", asset: "Asset", record: "Record | None") -> None:
        """Write what was found; SourceError if that fails."""
        from twin.calibration.report import commissioned_as_json

        if self.json is not None:
            write_json(self.json, commissioned_as_json(commissioned, asset, record))
        if self.page is not None:
            from twin.calibration.page import write_page  # with Matplotlib

            write_page(commissioned, asset, self.page, self.language)

    @contextmanager
    def refusals(self, asset: "Asset") -> Iterator[None]:
        """Write why the block raises a ConfigError: a refused record leaves its answer too."""
        from twin.calibration.report import refusal_as_json

        try:
            yield
        except ConfigError as error:
            if self.json is not None:
                write_json(self.json, refusal_as_json(error, asset))
            if self.page is not None:
                from twin.calibration.refusal import write_refusal  # with Matplotlib

                write_refusal(error, asset, self.page, self.language)
            raise


def commission(
    source: Annotated[
        Path, typer.Argument(metavar="LOG.mcap|CONFIG", help="A record, or the unit's PLC.")
    ],
    *,
    unit: UnitId = "",
    config: ConfigOption = None,
    cycles: Annotated[
        int,
        typer.Option(
            metavar="N", min=FEWEST_CYCLES, help="How many cycles to record from a PLC, 5 or more."
        ),
    ] = 12,
    log: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            callback=strictly(LOG),
            help="Where they are logged, instead of ID_TIME.mcap beside CONFIG.",
        ),
    ] = None,
    assets: AssetsUrl = "",
    output: Annotated[Path | None, output_option(PAGE, JSON)] = None,
    json_file: JsonFile = None,
    report: PageFile = None,
    language: LanguageCode = ENGLISH.code,
) -> None:
    """Fit a unit that nobody has seen before to a record of healthy cycles, and store it.

    The configuration says what hangs on the ejector; a fifth off is near enough. The record
    corrects it where they differ. The verdict is good, usable or refused (exit code 2). With CONFIG
    alone, cycles are recorded from the PLC into a log first, which is kept.
    """
    from twin.calibration.commission import commission as fit_unit
    from twin.calibration.report import commissioned_in_words
    from twin.calibration.save import store_first
    from twin.config import Config, document_in
    from twin.log.reader import open_log
    from twin.settings import Document

    answers = _Answers(
        chosen(output, "--json", json_file, JSON),
        chosen(output, "--report", report, PAGE),
        language_of(language, "--language"),
    )
    require_writable(answers.json, answers.page)
    if source.suffix == ".toml":
        source, config = _recorded(source, config, assets, unit, cycles, log), config or source
    elif log is not None:
        raise ConfigError(f"{source} is a log already", "leave --log out")
    recorded = open_log(source)
    say_if_cut(recorded, source, "used")
    document = document_in(recorded.header) if config is None else Document.read(config)
    settings = _named(Config.of(document, assets, unit, calibrated=False))
    settings = settings.of_rows(recorded.header)
    with status() as say, answers.refusals(settings.asset):
        recorded.header.require_commands(str(source))
        commissioned = fit_unit(settings, (rows for rows, _ in recorded.blocks()), say)
    print(commissioned_in_words(commissioned))
    record = None
    if commissioned.verdict.word != "refused":
        say_if_new(assets, settings.document)
        record, location = store_first(commissioned, settings, assets, source)
        print(f"stored as {settings.asset.id} in {location}, record {record.id[:8]}")
    answers.write(commissioned, settings.asset, record)
    if record is None:
        raise typer.Exit(2)


def _named(settings: "Config") -> "Config":
    """The configuration; ConfigError if it names no unit."""
    if not settings.asset.id:
        raise ConfigError("no unit is named", "give --id ID, or [asset] id in the configuration")
    return settings


def _recorded(
    source: Path, config: Path | None, assets: str, unit: str, cycles: int, log: Path | None
) -> Path:
    """Record the cycles of a PLC; gives their log. What is wrong otherwise is said before."""
    from twin.cli.recording import new_log, record_cycles
    from twin.config import Config
    from twin.settings import Document

    document = Document.read(config or source)
    settings = _named(Config.of(document, assets, unit, calibrated=False))
    log = new_log(log, source, settings.asset.id)
    record_cycles(settings, cycles, log)
    return log
