"""Set-up of a command: the configuration of an ejector, its twin and its monitor."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from twin.cli.figures import key_figures_of
from twin.cli.stopping import heeded

if TYPE_CHECKING:
    from twin.config import Config
    from twin.live import Twin
    from twin.log.header import LogHeader
    from twin.monitor.monitor import Monitor
    from twin.settings import Document


def configured(document: "Document", assets: str, unit: str) -> "Config":
    """The configuration with its unit's data; prints a remark if the named unit is unknown."""
    from twin.config import Config

    settings = Config.of(document, assets, unit)
    _say_if_not_made(document, assets)
    _say_instead(settings, unit)
    return settings


def settings_of(
    header: "LogHeader",
    log: Path,
    instead: Path | None,
    assets: str,
    unit: str,
    as_of: str,
    *,
    to_store: bool = False,
) -> "Config":
    """The configuration of a log with the data set of its recording, or another configuration.

    With ``to_store`` something will be stored in the asset database, which may be new.
    """
    from twin.assets.file import parse_time
    from twin.config import Config
    from twin.settings import Document

    document = Document.read(instead) if instead is not None else None
    as_of_ns = parse_time(as_of) if as_of else None
    settings = Config.of_recorded(
        header, str(log), document, assets, unit, as_of_ns, to_store=to_store
    )
    if document is not None and not to_store:
        _say_if_not_made(document, assets)
    _say_instead(settings, unit)
    return settings


def _say_if_not_made(document: "Document", assets: str) -> None:
    """Print a remark if [assets] names a database that does not exist yet."""
    from twin.assets.database_url import AssetsSettings, is_new, name_of

    if not assets and document.section(AssetsSettings, "assets").url and is_new("", document):
        print(
            f"twin: {name_of('', document)}: no such asset database yet; the shipped data sets are"
            " used until twin commission makes it",
            file=sys.stderr,
        )


def _say_instead(settings: "Config", unit: str) -> None:
    """Print a remark if the named unit is unknown."""
    if unit and settings.instead:
        print(f"twin: {settings.instead}", file=sys.stderr)


def pair_of(settings: "Config", *, judges: bool = True) -> tuple["Twin", "Monitor"]:
    """The twin of a configuration and its monitor; with ``judges`` it evaluates cycles."""
    from twin.live import compiled
    from twin.monitor.isolation import Isolation
    from twin.monitor.measured_supply import is_known
    from twin.monitor.monitor import Monitor
    from twin.monitor.signal_checks import ReportWatch

    with heeded():
        twin = compiled(settings.data)
    watch = settings.monitor
    isolation = (
        Isolation.of(settings.data, watch.healthy, watch.false_alarm_days)
        if watch.isolate and judges
        else None
    )
    key_figure_source = key_figures_of(settings) if judges else None
    monitor = Monitor(
        watch, twin.theta, key_figure_source=key_figure_source, isolation=isolation, judges=judges
    )
    gauged = is_known(watch.healthy)
    monitor.reports = ReportWatch(twin.theta, twin.detector, gauged) if judges else None
    if settings.document.tables.get("driver", {}).get("mode") == "poll":
        monitor.clocks = None  # then times are this machine's
    return twin, monitor
