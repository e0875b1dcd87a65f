"""``twin compare``: two logs beside each other, aligned at the suction edge."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import say_if_cut
from twin.cli.console import rows_progress, status
from twin.cli.options import JSON, PICTURES, RRD, JsonFile, PictureFile, RrdFile, chosen
from twin.cli.options import output as output_option
from twin.files import require_writable, write_json

if TYPE_CHECKING:
    from twin.compare.side import Side
    from twin.log.header import LogHeader
    from twin.log.reader import Log
    from twin.signals import Samples, Ticks


def compare(
    a: Annotated[Path, typer.Argument(metavar="A.mcap", help="A recorded log, as it was.")],
    b: Annotated[Path, typer.Argument(metavar="B.mcap", help="Another one, as it is.")],
    output: Annotated[Path | None, output_option(JSON, *PICTURES, RRD)] = None,
    json_file: JsonFile = None,
    picture: PictureFile = None,
    rrd: RrdFile = None,
) -> None:
    """Say what differs between two logs: key figures and courses, from the suction edge on."""
    from twin.compare.compare import compare as compare_sides
    from twin.compare.text import in_words, plain, remarks

    json_file = chosen(output, "--json", json_file, JSON)
    picture = chosen(output, "--picture", picture, *PICTURES)
    rrd = chosen(output, "--rrd", rrd, RRD)
    _refuse_before_work(json_file, picture, rrd)
    sides = _read(a), _read(b)
    with status() as say:
        say("comparing")
        comparison = compare_sides(*sides)
    for remark in remarks(comparison):
        print(f"twin: {remark}", file=sys.stderr)
    print(in_words(comparison))
    if json_file is not None:
        write_json(json_file, plain(comparison))
    if picture is not None:
        from twin.compare.picture import write

        write(comparison, picture)
    if rrd is not None:
        from twin.compare.recording import record

        record(comparison, rrd)


@dataclass(frozen=True)
class _Shown:
    """A log whose reading shows its progress."""

    log: "Log"

    @property
    def path(self) -> Path:
        return self.log.path

    @property
    def header(self) -> "LogHeader":
        return self.log.header

    def blocks(self) -> "Iterator[tuple[Samples, Ticks]]":
        return rows_progress(self.log.blocks(), f"reading {self.log.path.name}")


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
    return side_of(_Shown(log), settings, figures)


def _refuse_before_work(json_file: Path | None, picture: Path | None, rrd: Path | None) -> None:
    """Reject outputs that cannot be written, before the logs are read."""
    require_writable(json_file, picture, rrd)
    if rrd is not None:
        from twin.view import import_rerun

        import_rerun()
