"""``twin log``: look after logs."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import App
from twin.cli.console import progress
from twin.cli.options import LogFile

if TYPE_CHECKING:
    from twin.log.check import Piece

log_app = App("Look after logs.")


@log_app.command()
def check(log: LogFile) -> None:
    """Say what a log holds and whether it is whole."""
    from twin.log.check import check as check_log

    report = check_log(log, partial(_shown, "checking"))
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
    print(recover_log(log, output, partial(_shown, "recovering")))


def _shown(label: str, pieces: "Iterator[Piece]") -> "Iterator[Piece]":
    """The pieces of a log, with progress on a terminal."""
    return progress(pieces, label, lambda piece: len(piece[0]))
