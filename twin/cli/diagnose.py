"""``twin diagnose``: what the simulation gets wrong on a log, and why."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import say_if_cut, say_if_new
from twin.cli.console import complain, hint, status
from twin.cli.options import (
    JSON,
    PAGE,
    TOML,
    AsOf,
    AssetsUrl,
    ConfigOption,
    JsonFile,
    LanguageCode,
    LogFile,
    PageFile,
    UnitId,
    chosen,
    written_as,
)
from twin.cli.options import output as output_option
from twin.cli.setup import settings_of
from twin.errors import ConfigError
from twin.files import require_writable, write_json, write_whole
from twin.languages.choice import language_of
from twin.languages.texts import ENGLISH

if TYPE_CHECKING:
    from twin.config import Config
    from twin.diagnosis.answer import Diagnosis
    from twin.log.header import LogHeader


def diagnose(
    log: LogFile,
    *,
    config: ConfigOption = None,
    unit: UnitId = "",
    assets: AssetsUrl = "",
    as_of: AsOf = "",
    output: Annotated[Path | None, output_option(PAGE, JSON)] = None,
    json_file: JsonFile = None,
    report: PageFile = None,
    language: LanguageCode = ENGLISH.code,
    save_as: Annotated[
        str, typer.Option(metavar="NEWID", help="Keep the extended model as that of a unit.")
    ] = "",
    judge_on: Annotated[
        Path | None,
        typer.Option(
            metavar="OTHER.mcap",
            help="Measure the gain on another log of it as well, under its supply and parts.",
        ),
    ] = None,
    propose: Annotated[
        Path | None,
        typer.Option(
            metavar="F.toml",
            callback=written_as(TOML),
            help="Write the unlisted mechanism that was found, for twin effects add.",
        ),
    ] = None,
) -> None:
    """Say what the simulation gets wrong on a log, why, and what knowing it gains."""
    from twin.diagnosis.answer import diagnose as find_cause
    from twin.diagnosis.text import lines
    from twin.log.reader import open_log

    json_file = chosen(output, "--json", json_file, JSON)
    report = chosen(output, "--report", report, PAGE)
    require_writable(json_file, report, propose)
    report_language = language_of(language, "--language")
    recorded = open_log(log)
    say_if_cut(recorded, log, "diagnosed")
    other_log = open_log(judge_on) if judge_on else None
    if other_log is not None and judge_on is not None:
        other_log.header.require_commands(str(judge_on))
        say_if_cut(other_log, judge_on, "judged on")
    store = bool(save_as)
    settings = settings_of(recorded.header, log, config, assets, unit, as_of, to_store=store)
    if not unit:
        settings.refuse_another(recorded.header, str(log))
    there = None
    if other_log is not None and judge_on is not None:
        from twin.diagnosis.another_log import conditions

        _refuse_another_asset(recorded.header, other_log.header, judge_on, unit)
        named = (str(log), recorded.header), (str(judge_on), other_log.header)
        there = conditions(settings, *named)
    with status() as say:
        derived = recorded.header.derived
        diagnosis = find_cause(settings, recorded.samples, str(log), say, derived=derived)
        if other_log is not None:
            from twin.diagnosis.another_log import judged_on

            say(f"judging on {judge_on}")
            rows = other_log.samples
            judged = judged_on(diagnosis, settings, str(judge_on), rows, there)
            diagnosis.json["judged_on"] = judged
    print(lines(diagnosis.json, time.time_ns()))
    if other_log is not None:
        from twin.diagnosis.extend import nothing
        from twin.diagnosis.text import on_another_log

        print(on_another_log(diagnosis.json, nothing(diagnosis)))
    if json_file is not None:
        write_json(json_file, diagnosis.json)
    if report is not None:
        from twin.diagnosis.report import write_report  # with Matplotlib

        write_report(diagnosis, report, report_language)
        hint(complain, f"{report} is written; a browser shows it")
    if save_as:
        _save(diagnosis, settings, save_as, assets, log)
    if propose is not None:
        _propose(diagnosis, settings, log, propose)


def _refuse_another_asset(header: "LogHeader", other: "LogHeader", log: Path, unit: str) -> None:
    """ConfigError if the log to judge on is of another asset; a person may name the ``unit``."""
    if unit:
        return
    own, others = ((one.asset_type, one.asset_id) for one in (header, other))
    if all((*own, *others)) and own != others:
        raise ConfigError(
            f"{log} is a log of {' '.join(others)}, not of {' '.join(own)}: a cause that was found"
            " on one unit cannot be judged on another",
            "take another log of the same unit, or name it with --id if only its name differs;"
            " twin effects add carries what was found to others",
        )


def _save(diagnosis: "Diagnosis", settings: "Config", unit: str, assets: str, log: Path) -> None:
    """Store the extended model, or print why there is none."""
    from twin.diagnosis.extend import extended, nothing, remarks, store

    print()
    for line in remarks(diagnosis):
        print(line)
    extended_config = extended(diagnosis, settings)
    if extended_config is None:
        print(f"nothing is stored as {unit}: {nothing(diagnosis)}")
        return
    say_if_new(assets, settings.document)
    record, location = store(extended_config, diagnosis, settings, unit, assets, log)
    print(f"stored as {unit} in {location}, record {record.id[:8]}; use it: --id {unit}")


def _propose(diagnosis: "Diagnosis", settings: "Config", log: Path, file: Path) -> None:
    """Write an unlisted mechanism as a proposed effect, or print why there is none."""
    from twin.diagnosis.propose import proposed

    text = proposed(diagnosis, settings, log, file)
    print()
    if text is None:
        print(f"nothing is written to {file}: no mechanism that nobody listed was found")
        return
    write_whole(file, text.encode())
    print(f"proposed as an effect in {file}; read it, then: twin effects add {file}")
