"""``twin compare``: two logs beside each other, aligned at the suction edge."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import say_if_cut
from twin.errors import ConfigError
from twin.files import require_writable, write_json

if TYPE_CHECKING:
    from twin.compare.side import Side


def compare(
    a: Annotated[Path, typer.Argument(metavar="A.mcap", help="A recorded log, as it was.")],
    b: Annotated[Path, typer.Argument(metavar="B.mcap", help="Another one, as it is.")],
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="F", help="Write the answer as JSON.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="F.(svg|png)", help="Draw the mean courses of a cycle.")
    ] = None,
    rrd: Annotated[
        Path | None, typer.Option(metavar="F.rrd", help="Write the same for Rerun.")
    ] = None,
) -> None:
    """Say what differs between two logs: key figures and courses, from the suction edge on."""
    from twin.compare.compare import compare as compare_sides
    from twin.compare.text import in_words, plain, remarks

    _refuse_before_work(json_file, picture, rrd)
    comparison = compare_sides(_read(a), _read(b))
    for remark in remarks(comparison):
        print(f"twin: {remark}", file=sys.stderr)
    print(in_words(comparison))
    if json_file is not None:
        write_json(json_file, plain(comparison))
    if picture is not None:
        from twin.compare.picture import draw

        draw(comparison, picture)
    if rrd is not None:
        from twin.compare.recording import record

        record(comparison, rrd)


def _read(path: Path) -> "Side":
    """All cycles of a log, by the twin that recorded it."""
    from twin.compare.side import side_of
    from twin.config import Config
    from twin.figures.cycle import compiled
    from twin.log.reader import open_log

    log = open_log(path)
    say_if_cut(log, path, "compared")
    settings = Config.of_recorded(log.header, str(path))
    figures = compiled(settings)
    return side_of(log, settings, figures)


def _refuse_before_work(json_file: Path | None, picture: Path | None, rrd: Path | None) -> None:
    """Reject outputs that cannot be written, before the logs are read."""
    from twin.compare.picture import FORMATS

    if picture is not None and picture.suffix not in FORMATS:
        raise ConfigError(f"{picture}: not a picture", f"let it end in {' or '.join(FORMATS)}")
    require_writable(json_file, picture, rrd)
    if rrd is not None:
        from twin.view import import_rerun

        import_rerun()
