"""Arguments and options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from twin.errors import ConfigError
from twin.extras import require
from twin.files import require_ending

JSON, PAGE, RRD, AASX, TOML = ".json", ".html", ".rrd", ".aasx", ".toml"
TABLES, PICTURES = (".csv", ".parquet", ".xlsx"), (".svg", ".png")
LOG, FMU, SSP = ".mcap", ".fmu", ".ssp"
ALL_ENDINGS = (JSON, PAGE, RRD, AASX, TOML, *TABLES, *PICTURES, LOG, FMU, SSP, ".pdf", ".txt")

_EXTRAS = {  # that write a format
    **dict.fromkeys((PAGE, *PICTURES), "reports"),
    **dict.fromkeys(TABLES, "tables"),
    RRD: "view",
    AASX: "aas",
}

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML configuration.")]
ConfigFiles = Annotated[
    list[Path], typer.Argument(metavar="CONFIG", help="TOML configuration, one per ejector.")
]
LogFile = Annotated[Path, typer.Argument(metavar="LOG.mcap", help="A recorded log.")]
Address = Annotated[
    str, typer.Option(metavar="HOST:PORT", help="Where the PLC is, instead of the configuration's.")
]
AssetsUrl = Annotated[
    str, typer.Option("--assets", metavar="URL", help="Asset database, instead of the configured.")
]
UnitId = Annotated[str, typer.Option("--id", metavar="ID", help="Unit, instead of [asset] id.")]
ConfigOption = Annotated[Path | None, typer.Option(help="Instead of the one in the log.")]
AsOf = Annotated[str, typer.Option(metavar="TIME", help="What the asset database knew then, UTC.")]
LanguageCode = Annotated[
    str, typer.Option("--language", metavar="CODE", help="Language of the report, such as de.")
]
ViewFlag = Annotated[bool, typer.Option("--view", help="Open the Rerun viewer.")]
Force = Annotated[bool, typer.Option("--force", help="Replace a file of that name.")]
FailOnAlarm = Annotated[bool, typer.Option(help="Exit with 1 if an alarm was raised.")]


def strictly(*endings: str) -> Callable[[Path | None], Path | None]:
    """Callback of an option whose file's ending decides.

    ConfigError unless it is one of these, or if what writes it is not installed.
    """

    def checked(path: Path | None) -> Path | None:
        if path is not None:
            _require_writer(require_ending(path, *endings), path)
        return path

    return checked


def output(*endings: str) -> Any:
    """The option ``-o``: a file whose ending, one of ``endings``, decides the format."""
    *some, last = (f"*{ending}" for ending in endings)
    text = f"{', '.join(some)} or {last}: the ending decides." if some else f"{last}."
    return typer.Option("-o", metavar="FILE", callback=strictly(*endings), help=text)


def written_as(*endings: str) -> Callable[[Path | None], Path | None]:
    """Callback of an option that names the format: ConfigError if the ending names another one.

    Any other name is accepted: of a temporary file, or of a pipe. It is also a ConfigError if what
    writes the format is not installed.
    """

    def checked(path: Path | None) -> Path | None:
        if path is not None:
            is_named = path.suffix.lower() in ALL_ENDINGS
            _require_writer(require_ending(path, *endings) if is_named else endings[0], path)
        return path

    return checked


def _require_writer(ending: str, path: Path) -> None:
    """ConfigError unless the extra is installed that writes files of an ending."""
    if extra := _EXTRAS.get(ending):
        require(extra, f"writing {path}")


def chosen(output: Path | None, option: str, named: Path | None, *endings: str) -> Path | None:
    """The file to write in a format: that of ``-o`` if it ends so, else the one of ``option``.

    ConfigError if both name one.
    """
    if output is None or output.suffix.lower() not in endings:
        return named
    if named is not None:
        raise ConfigError(
            f"-o {output} and {option} {named} write the same", "leave one of them out"
        )
    return output


JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json", metavar="F", callback=written_as(JSON), help="Write the answer as JSON."
    ),
]
JsonAlone = Annotated[  # of a command that writes no other file
    Path | None,
    typer.Option(
        "--json", "-o", metavar="F", callback=written_as(JSON), help="Write the answer as JSON."
    ),
]
RrdFile = Annotated[
    Path | None,
    typer.Option(metavar="F.rrd", callback=written_as(RRD), help="Write the view to a file."),
]
PageFile = Annotated[
    Path | None,
    typer.Option(metavar="F.html", callback=written_as(PAGE), help="Write a page with pictures."),
]
PictureFile = Annotated[
    Path | None,
    typer.Option(metavar="F.(svg|png)", callback=strictly(*PICTURES), help="Draw the curves."),
]
