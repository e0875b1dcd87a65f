"""``twin log``: look after logs."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.app import App
from twin.cli.options import LogFile

log_app = App("Look after logs.")


@log_app.command()
def check(log: LogFile) -> None:
    """Say what a log holds and whether it is whole."""
    from twin.log.check import check as check_log

    report = check_log(log)
    print(report)
    raise typer.Exit(0 if report.sound else 3)


@log_app.command()
def recover(
    log: LogFile,
    output: Annotated[Path, typer.Option("-o", metavar="OUT.mcap", help="Write a new log.")],
) -> None:
    """Write a complete log of everything that can be read in a damaged or unfinished one."""
    from twin.log.check import recover as recover_log
    from twin.log.part import refuse_other_suffix

    refuse_other_suffix(output)
    print(recover_log(log, output))
