"""``twin figures``: key figures of a log, and of the database."""

import math
import sys
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.app import App, chosen_unit, not_negative, read_config, say_if_cut
from twin.cli.console import rows_progress, status
from twin.cli.options import (
    JSON,
    PICTURES,
    TABLES,
    Force,
    JsonAlone,
    JsonFile,
    LogFile,
    PictureFile,
)
from twin.cli.options import UnitId as LogUnit
from twin.cli.options import chosen as chosen_file
from twin.cli.options import output as output_option
from twin.errors import ConfigError
from twin.files import refuse_existing, require_writable, write_json

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Any

    from twin.assets.unit import Unit
    from twin.config import Config
    from twin.figures.costs import Tariff
    from twin.figures.cycle import CycleFigures, KeyFigures
    from twin.figures.database import History, Store
    from twin.figures.key_figures import Figure
    from twin.figures.settings import FigureSettings, Limits
    from twin.figures.writer import FigureWriter
    from twin.log.reader import Log
    from twin.settings import Document

figures_app = App("Key figures per cycle: leakage, evacuation times, air, counters, trends.")

Url = Annotated[
    str,
    typer.Option("--figures", metavar="URL", help="Database: sqlite:///FILE, postgresql://..."),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="CONFIG", help="Its unit, limits and [figures] url."),
]
UnitId = Annotated[str, typer.Option("--id", metavar="ID", help="Unit, where there are several.")]
Days = Annotated[
    float | None, typer.Option(metavar="N", callback=not_negative, help="Only the last N days.")
]


@figures_app.command()
def show(
    log: LogFile,
    config: ConfigFile = None,
    json_file: JsonFile = None,
    output: Annotated[Path | None, output_option(*TABLES, JSON)] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Add them to the database.")] = False,
    figures: Url = "",
    force: Force = False,
) -> None:
    """Key figures of every cycle of a log: measured, expected, and read off the curve."""
    from twin.assets.unit import Unit
    from twin.figures.curve import stretches, volume_of
    from twin.figures.database import open_store
    from twin.figures.text import curve_plain, curve_table, cycles_table
    from twin.log.reader import open_log

    if figures and not keep:
        raise ConfigError("--figures is for --keep", "say --keep as well, or leave it out")
    json_file = chosen_file(output, "--json", json_file, JSON)
    table = chosen_file(output, "", None, *TABLES)
    require_writable(json_file, table)
    if table is not None:
        refuse_existing(table, force=force)
    recorded = open_log(log)
    say_if_cut(recorded, log, "used")
    settings = _of_log(recorded, log, config)
    plain = [cycle for _, cycle in _read(recorded, settings)]
    if recorded.header.derived:  # timings of derived commands are unknown, and so are expectations
        plain = [{k: v for k, v in cycle.items() if not k.endswith("_expected")} for cycle in plain]
    blocks = rows_progress(recorded.blocks(), "reading off the curve")
    suctions = list(stretches((rows for rows, _ in blocks), volume_of(settings)))
    if recorded.header.derived:
        print(f"twin: {recorded.header.derived}", file=sys.stderr)
    print(cycles_table(plain), curve_table(suctions), sep="\n\n")
    unit, data_set = Unit(recorded.header.asset_type, recorded.header.asset_id), settings.data.hash
    if json_file is not None:
        content = {"log": str(log), "cycles": plain, "curve": curve_plain(suctions)}
        if recorded.header.derived:
            content["commands"] = recorded.header.derived
        write_json(json_file, content)
    if table is not None:
        from twin.figures.export import to_table
        from twin.tables.sheet import export as export_table

        with open_store("sqlite://") as store:
            store.add(unit, data_set, log.name, plain)
            export_table(to_table(store.history(unit), unit), table, force=force)
    if keep:
        with _open(figures, config, create=True) as store:
            count = store.add(unit, data_set, log.name, plain)
            print(f"{count} new of {len(plain)} cycles, in {store.name}")
            _say_if_deleted(store, unit, plain)


@figures_app.command()
def costs(
    log: LogFile,
    config: ConfigFile = None,
    unit: LogUnit = "",
    json_file: JsonFile = None,
    output: Annotated[Path | None, output_option(*TABLES, JSON)] = None,
    force: Force = False,
) -> None:
    """Air, energy and money of each day of a log, and of a year at its rate."""
    from twin.figures.costs import days, year
    from twin.figures.costs_text import days_plain, days_table

    json_file = chosen_file(output, "--json", json_file, JSON)
    table = chosen_file(output, "", None, *TABLES)
    require_writable(json_file, table)
    if table is not None:
        refuse_existing(table, force=force)
    recorded, settings = _opened(log, config, unit)
    tariff, cycles = _tariff(settings), [cycle for cycle, _ in _read(recorded, settings)]
    if recorded.header.derived:
        print(f"twin: {recorded.header.derived}", file=sys.stderr)
    by_day, whole = days(cycles), year(cycles, tariff)
    print(days_table(by_day, whole, tariff))
    if json_file is not None:
        write_json(json_file, {"log": str(log), **days_plain(by_day, whole, tariff)})
    if table is not None:
        from twin.figures.export import days_columns
        from twin.tables.sheet import export as export_table

        export_table(days_columns(by_day, tariff), table, force=force)


@figures_app.command()
def savings(
    log: LogFile,
    config: ConfigFile = None,
    unit: LogUnit = "",
    json_file: JsonAlone = None,
) -> None:
    """What another H1, hysteresis or supply pressure would save, as the model predicts it."""
    from twin.figures.key_figures import Unit
    from twin.figures.savings import MOST_CYCLES
    from twin.figures.savings import savings as predict
    from twin.figures.savings_text import savings_plain, savings_table
    from twin.figures.settings import FigureSettings
    from twin.figures.simulated import Program, mean_cycle_time, spread, whole_cycles

    require_writable(json_file)
    recorded, settings = _opened(log, config, unit)
    recorded.header.require_commands(str(log))
    blocks = rows_progress(recorded.blocks(), f"reading {log.name}")
    cycles = spread(whole_cycles(blocks), MOST_CYCLES)
    if not cycles:
        raise ConfigError(
            f"{log}: no complete cycle, so no program to predict for",
            "record suction, blow-off and the idle after it",
        )
    program, tariff = Program.of_cycles(cycles), _tariff(settings)
    figure_settings = settings.document.section(FigureSettings, "figures")
    ejector = Unit(settings.data, figure_settings.energy_kwh_m3)
    with status() as say:
        say("predicting other settings")
        predicted = predict(ejector, settings.monitor.healthy, program)
    rate = tariff.cycles_a_year(mean_cycle_time(program.cycle_seconds))
    air = [cycle.measured["air"] for cycle, _ in _read(recorded, settings)]
    measured = [value for value in air if math.isfinite(value)]
    print(savings_table(predicted, rate, tariff, measured))
    if json_file is not None:
        plain = savings_plain(predicted, rate, tariff, measured)
        write_json(json_file, {"log": str(log), **plain})


@figures_app.command()
def trend(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="FIGURE", help="Default: all there are.")
    ] = None,
    config: ConfigFile = None,
    unit: UnitId = "",
    figures: Url = "",
    days: Days = None,
    output: Annotated[Path | None, output_option(JSON, *PICTURES)] = None,
    json_file: JsonFile = None,
    picture: PictureFile = None,
) -> None:
    """How figures run, whether they stepped or drift, and when they come to their limits."""
    from twin.figures.database import SIDES
    from twin.figures.text import in_words, trend_of_figure, trend_plain

    json_file = chosen_file(output, "--json", json_file, JSON)
    picture = chosen_file(output, "--picture", picture, *PICTURES)
    require_writable(json_file, picture)
    chosen_figures = _chosen_figures(names, picture)
    limits = _limits(config)
    with _open(figures, config, create=False) as store:
        columns = [f"{figure.name}_{side}" for figure in chosen_figures for side in SIDES]
        history = _history(store, chosen_unit(store, config, unit), days, columns)
    plain = []
    for figure in chosen_figures:
        course = trend_of_figure(history, figure, limits)
        text = in_words(figure, course, time.time_ns())
        print(text)
        plain.append(trend_plain(figure, course))
        if picture is not None:
            from twin.figures.picture import draw

            draw(history, figure, course, text, picture)
    if json_file is not None:
        write_json(json_file, plain)


@figures_app.command()
def counters(
    config: ConfigFile = None,
    unit: UnitId = "",
    figures: Url = "",
    erase: Annotated[
        bool, typer.Option("--erase", help="Let the erasable counters begin anew.")
    ] = False,
    json_file: JsonAlone = None,
) -> None:
    """Suction cycles, valve switchings and alarms: in all, and since they were erased."""
    require_writable(json_file)
    with _open(figures, config, create=False) as store:
        chosen = chosen_unit(store, config, unit)
        if erase:
            store.erase(chosen)
        total, erasable = store.counters(chosen), store.counters(chosen, erasable=True)
    print(f"{'':18}{'in all':>12}{'erasable':>12}")
    for name, label in _COUNTER_LABELS.items():
        print(f"{label:18}{getattr(total, name):12}{getattr(erasable, name):12}")
    if json_file is not None:
        counts = {"total": asdict(total), "erasable": asdict(erasable)}
        write_json(json_file, {"type": chosen.type, "id": chosen.id, **counts})


@figures_app.command()
def forget(
    older_than: Annotated[
        float,
        typer.Option(metavar="DAYS", callback=not_negative, help="Delete what is older."),
    ],
    config: ConfigFile = None,
    unit: UnitId = "",
    figures: Url = "",
) -> None:
    """Delete old cycles of an ejector, as a run does by [figures] keep_days.

    It is for an ejector that no run watches any more. The counters go on counting them.
    """
    from twin.figures.retention import forget as forget_cycles
    from twin.instants import DAY_NS

    with _open(figures, config, create=False) as store, status() as say:
        chosen = chosen_unit(store, config, unit)
        before_ns = time.time_ns() - round(older_than * DAY_NS)
        deleted = forget_cycles(
            store, chosen, before_ns, lambda count: say(f"{count} cycles deleted")
        )
    print(f"{deleted} cycles of {chosen.id} deleted; the counters go on counting them")


@figures_app.command()
def autoset(
    config: ConfigFile = None,
    unit: UnitId = "",
    figures: Url = "",
    tolerance: Annotated[
        float | None,
        typer.Option(
            metavar="S", callback=not_negative, help="Share of the worst good cycle, over it."
        ),
    ] = None,
    json_file: JsonAlone = None,
) -> None:
    """Permitted t1 and leakage from the last good cycles, to put into the configuration."""
    from twin.figures.autoset import autoset as teach

    require_writable(json_file)
    share = _settings(config).autoset_tolerance if tolerance is None else tolerance
    with _open(figures, config, create=False) as store:
        chosen = chosen_unit(store, config, unit)
        permitted = teach(store.history(chosen), share)
    print(f"# from the last {permitted.cycles} good cycles of {chosen.id or chosen.type}")
    print(permitted.toml(), end="")
    if json_file is not None:
        write_json(json_file, {"type": chosen.type, "id": chosen.id, **asdict(permitted)})


@figures_app.command()
def export(
    output: Annotated[Path, output_option(*TABLES)],
    config: ConfigFile = None,
    unit: UnitId = "",
    figures: Url = "",
    days: Days = None,
    force: Force = False,
) -> None:
    """Write the kept cycles of a unit as a table for other programs."""
    from twin.figures.export import to_table
    from twin.tables.sheet import export as export_table

    refuse_existing(output, force=force)
    with _open(figures, config, create=False) as store:
        chosen = chosen_unit(store, config, unit)
        table = to_table(_history(store, chosen, days), chosen)
    export_table(table, output, force=force)
    print(f"{table.num_rows} cycles in {output}")


# --- for the loop -------------------------------------------------------------------------------


def key_figures_of(settings: "Config") -> "KeyFigures":
    """The key figures of a configuration's unit, compiled; ConfigError names a wrong key."""
    from twin.figures.cycle import compiled

    return compiled(settings)


def figure_writer_of(
    settings: "Config", say: "Callable[[str], None]"
) -> "Callable[[], FigureWriter] | None":
    """A function that opens the sink of key figures; None unless ``[figures]`` asks for it.

    ConfigError for a URL of an unknown kind. The sink reports an unreachable database, and retries.
    """
    from twin.assets.engine import parse_url
    from twin.assets.unit import Unit
    from twin.figures.database import FIGURE_DATABASE
    from twin.figures.database_url import open_chosen
    from twin.figures.retention import Retention
    from twin.figures.settings import FigureSettings
    from twin.figures.writer import FigureWriter

    figure_settings = settings.document.section(FigureSettings, "figures")
    if not figure_settings.keep:
        return None
    parse_url(figure_settings.url, FIGURE_DATABASE)
    unit = Unit(settings.asset.type, settings.asset.id)
    open_database = partial(open_chosen, "", settings.document, create=True)
    days = figure_settings.keep_days
    retention = None if days is None else Retention(days, say)
    return lambda: FigureWriter(open_database, unit, settings.data.hash, say, retention)


# --- what the commands share --------------------------------------------------------------------

_COUNTER_LABELS = {"cycles": "suction cycles", "switchings": "valve switchings", "alarms": "alarms"}


def _document(config: Path | None) -> "Document | None":
    return read_config(config) if config else None


def _open(url: str, config: Path | None, *, create: bool) -> "Store":
    from twin.figures.database_url import open_chosen

    store = open_chosen(url, _document(config), create=create)
    print(f"figure database: {store.name}", file=sys.stderr)
    return store


def _settings(config: Path | None) -> "FigureSettings":
    from twin.figures.settings import FigureSettings

    document = _document(config)
    return document.section(FigureSettings, "figures") if document else FigureSettings()


def _limits(config: Path | None) -> "Limits":
    """The limits of a configuration's unit, with people's changes; else the field's defaults."""
    from twin.alarms.limits import limits_in_force
    from twin.config import Config
    from twin.figures.settings import FigureSettings, limits
    from twin.model.dataset import DataSet
    from twin.monitor.settings import MonitorSettings

    document = _document(config)
    if document:
        return limits_in_force(Config.of(document)).limits
    return limits(FigureSettings(), DataSet(), MonitorSettings())


def _of_log(recorded: "Log", log: Path, instead: Path | None, unit: str = "") -> "Config":
    """The configuration of a log with the data set of its recording, or another one.

    ``unit`` has the data set looked up that the asset database knows of it.
    """
    from twin.config import Config
    from twin.settings import Document

    document = Document.read(instead) if instead is not None else None
    return Config.of_recorded(recorded.header, str(log), document, unit=unit)


def _opened(log: Path, config: Path | None, unit: str) -> "tuple[Log, Config]":
    """A log, and the configuration that it is read with; prints what is amiss with them."""
    from twin.log.reader import open_log

    recorded = open_log(log)
    say_if_cut(recorded, log, "used")
    settings = _of_log(recorded, log, config, unit)
    if unit and settings.instead:
        print(f"twin: {settings.instead}", file=sys.stderr)
    return recorded, settings


def _tariff(settings: "Config") -> "Tariff":
    from twin.figures.costs import Tariff
    from twin.figures.settings import FigureSettings

    return Tariff.of(settings.document.section(FigureSettings, "figures"))


def _read(recorded: "Log", settings: "Config") -> "list[tuple[CycleFigures, Mapping[str, Any]]]":
    """Every cycle of a log with its key figures, and in the database's form."""
    from twin.figures.read import of_log

    found = []
    with status() as say:
        say(f"key figures of {recorded.path.name}")
        for cycle in of_log(recorded, key_figures_of(settings)):
            found.append(cycle)
            say(f"key figures of {recorded.path.name}: {len(found)} cycles")
    return found


def _say_if_deleted(store: "Store", unit: "Unit", cycles: "Sequence[Mapping[str, Any]]") -> None:
    """Say how many cycles of a log the database does not take, since it has deleted such."""
    deleted = store.deleted_until(unit)
    count = 0 if deleted is None else sum(cycle["host_ns"] <= deleted for cycle in cycles)
    if count:
        print(
            f"twin: {count} cycles are as old as those that {store.name} has deleted, and are not"
            " added again",
            file=sys.stderr,
        )


def _history(
    store: "Store", unit: "Unit", days: float | None, columns: "Sequence[str] | None" = None
) -> "History":
    from twin.figures.text import deleted_in_words
    from twin.instants import DAY_NS

    now_ns = time.time_ns()
    since = None if days is None else now_ns - round(days * DAY_NS)
    history = store.history(unit, since, *([] if columns is None else [columns]))
    if not len(history.host_ns):
        raise ConfigError(f"{store.name}: no cycles of {unit.id or unit.type} in that time")
    deleted = store.deleted_until(unit)
    if deleted is not None and (since is None or since <= deleted):
        print(f"twin: {deleted_in_words(deleted, now_ns)}", file=sys.stderr)
    return history


def _chosen_figures(names: list[str] | None, picture: Path | None) -> "list[Figure]":
    from twin.figures.key_figures import FIGURES

    unknown = [name for name in names or [] if name not in FIGURES]
    if unknown:
        raise ConfigError(
            f"no figure is called {', '.join(unknown)}", f"there are: {', '.join(FIGURES)}"
        )
    if picture is not None and len(names or []) != 1:
        raise ConfigError("a picture shows one figure", "name one: twin figures trend leakage")
    return [FIGURES[name] for name in names or FIGURES]
