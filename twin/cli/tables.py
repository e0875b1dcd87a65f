"""``twin import`` and ``twin export``: logs from tables, and tables from logs."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import say_if_cut
from twin.cli.console import Console, complain, hint, progress, rows_progress
from twin.cli.options import AssetsUrl, Force, LogFile, UnitId
from twin.cli.options import output as output_option
from twin.cli.setup import configured, pair_of
from twin.cli.sinks import open_sinks
from twin.cli.stopping import leave, stop_on_signal, until
from twin.errors import SourceError
from twin.extras import require
from twin.files import refuse_existing

if TYPE_CHECKING:
    from twin.tables.reader import Table


def _known_zone(name: str) -> str:
    """Callback of ``--time-zone``: usage error unless the zone exists."""
    from twin.tables.settings import known_zone

    try:
        return known_zone(name) if name else name
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="CSV, Excel (.xlsx) or Parquet.")],
    config: Annotated[Path, typer.Option(help="TOML configuration; [import] maps columns.")],
    output: Annotated[
        Path | None, typer.Option("-o", metavar="LOG.mcap", help="Write the new log.")
    ] = None,
    *,
    unit: UnitId = "",
    assets: AssetsUrl = "",
    time_zone: Annotated[
        str,
        typer.Option(
            metavar="ZONE",
            callback=_known_zone,
            help="Zone of times without one: Europe/Berlin, or UTC.",
        ),
    ] = "",
    derive_commands: Annotated[
        bool,
        typer.Option("--derive-commands", help="Find commands that FILE lacks from the pressure."),
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Write nothing; show how FILE is understood."),
    ] = False,
    force: Force = False,
) -> None:
    """Make a log of a PLC's trace export, with what the twin expects beside it."""
    require("tables", "twin import")
    from twin.live import run as run_loop
    from twin.log.header import DERIVED
    from twin.log.part import refuse_other_suffix
    from twin.log.recorder import Recorder
    from twin.settings import Document
    from twin.signals import MBAR
    from twin.tables.reader import open_table
    from twin.tables.settings import ImportSettings

    if output is not None:
        refuse_other_suffix(output)
        if not dry_run:
            _refuse_existing_log(output, force=force)
    elif not dry_run:
        raise typer.BadParameter("say with -o LOG.mcap where the log goes, or look with --dry-run")
    settings = configured(Document.read(config), assets, unit)
    import_settings = settings.document.section(ImportSettings, "import")
    if time_zone:
        import_settings = import_settings.model_copy(update={"time_zone": time_zone})
    ambient = settings.data.ambient.pressure_mbar * MBAR
    table = open_table(file, import_settings, ambient, derive=derive_commands)
    settings = settings.with_sensor(is_gauge=table.counts_from_ambient)
    for note in table.notes:
        print(f"twin: {file}: {note}", file=sys.stderr)
    if dry_run or output is None:
        return _show(table, derive=derive_commands)
    if table.ignored:
        print(f"twin: columns not taken: {', '.join(table.ignored)}", file=sys.stderr)
    unmeasured = {}
    if derive_commands:
        table = table.with_commands()
        unmeasured[DERIVED] = table.commands
        print(f"twin: {table.commands}", file=sys.stderr)
    else:  # read the whole table first, so that no events come of rows that are then refused
        for _ in progress(table.blocks(), "reading"):
            pass
    twin, monitor = pair_of(settings, judges=not table.commands)
    with _complete_file(output) as draft, stop_on_signal(None) as stopped:
        header = settings.log_header(unmeasured)
        sinks = open_sinks({"log": partial(Recorder, draft, header), "console": Console})
        blocks = until(stopped, progress(table.blocks(), "importing"))
        run_loop(blocks, twin, monitor, [*sinks.values()])
    command = "twin figures show" if table.commands else "twin diagnose"
    hint(complain, f"{output} is written; next: {command} {output}")
    return leave(interrupted=stopped() == "interrupted")


def _show(table: "Table", *, derive: bool) -> None:
    """Print how a table is read, even if it is then refused."""
    from twin.tables.preview import Preview

    preview = Preview(table)
    try:
        for block in progress(table.blocks(), "reading"):
            preview.see(block)
    finally:
        print(preview)
    if derive:
        print(table.with_commands().commands)


def _refuse_existing_log(path: Path, *, force: bool) -> None:
    """SourceError if a log is there and no ``force``, or if it has further parts."""
    from twin.log.part import part_path

    refuse_existing(path, force=force)
    if (second := part_path(path, 1)).exists():
        raise SourceError(
            f"{second}: there is already a log in several parts",
            "choose another name, or remove all its parts",
        )


@contextmanager
def _complete_file(path: Path) -> Iterator[Path]:
    """Give a draft to write to; it gets the name ``path`` only on success."""
    draft = path.with_name(f"{path.name}.part")
    with suppress(OSError):
        draft.unlink()  # left by a killed command
    try:
        yield draft
        draft.replace(path)
    finally:
        with suppress(OSError):
            draft.unlink()


def export(
    log: LogFile,
    output: Annotated[Path, output_option(".csv", ".parquet")],
    *,
    force: Force = False,
) -> None:
    """Write a log as a table for other programs, lossless."""
    from twin.log.reader import open_log
    from twin.tables.export import ROWS
    from twin.tables.export import export as write_table

    refuse_existing(output, force=force)
    recorded = open_log(log)
    say_if_cut(recorded, log, "exported")
    rows = rows_progress(recorded.blocks(ROWS), "exporting")
    write_table(rows, recorded.header, output, force=force)
