"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

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
JsonFile = Annotated[
    Path | None, typer.Option("--json", metavar="F", help="Write the answer as JSON.")
]
ViewFlag = Annotated[bool, typer.Option("--view", help="Open the Rerun viewer.")]
RrdFile = Annotated[Path | None, typer.Option(metavar="F.rrd", help="Write the view to a file.")]
FailOnAlarm = Annotated[bool, typer.Option(help="Exit with 1 if an alarm was raised.")]
