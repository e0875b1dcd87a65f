"""``twin calibrate``: a unit's data set from healthy cycles, if its type is known."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.app import say_if_cut, say_if_new
from twin.cli.console import status
from twin.cli.options import AssetsUrl, JsonAlone, LogFile, UnitId
from twin.errors import ConfigError
from twin.files import require_writable, write_json


def calibrate(
    log: LogFile,
    config: Annotated[Path, typer.Option(help="TOML configuration of the unit and its system.")],
    unit: UnitId = "",
    assets: AssetsUrl = "",
    json_file: JsonAlone = None,
) -> None:
    """Fit the instance-specific data set of one unit to healthy cycles, and store it.

    The verdict is good, usable or refused (exit code 2). What is refused is not stored.
    """
    from twin.calibration.calibrate import calibrate as fit_unit
    from twin.calibration.report import CALIBRATION, as_json, in_words, refusal_as_json
    from twin.calibration.save import store
    from twin.config import Config
    from twin.log.reader import open_log
    from twin.settings import Document

    require_writable(json_file)
    settings = Config.of(Document.read(config), assets, unit, calibrated=False)
    if not settings.asset.id:
        raise ConfigError("no unit is named", "give --id ID, or [asset] id in the configuration")
    recorded = open_log(log)
    settings = settings.of_rows(recorded.header)
    say_if_cut(recorded, log, "used")
    try:
        recorded.header.require_commands(str(log))
        with status() as say:
            calibration = fit_unit(settings, (rows for rows, _ in recorded.blocks()), say)
    except ConfigError as error:
        if json_file is not None:
            write_json(json_file, refusal_as_json(error, settings.asset, CALIBRATION))
        raise
    print(in_words(calibration))
    record = None
    if calibration.verdict.word != "refused":
        say_if_new(assets, settings.document)
        record, location = store(calibration, settings, assets, log)
        print(f"stored as {settings.asset.id} in {location}, record {record.id[:8]}")
    if json_file is not None:
        write_json(json_file, as_json(calibration, settings.asset, record))
    if record is None:
        raise typer.Exit(2)
