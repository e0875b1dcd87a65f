"""The command line: the only place where the twin meets the drivers.

Imports stand inside the commands so that ``twin --help`` is quick. What a command finds goes to
stdout, what it has to say about its work to stderr.
"""

import atexit
import gc
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from threading import Lock
from types import FrameType
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from twin.cli_alarms import alarms_app, alarms_of, asker_of
from twin.cli_app import App, not_negative, read_config, say_if_cut, say_if_new
from twin.cli_assets import assets_app
from twin.cli_cert import cert
from twin.cli_compare import compare
from twin.cli_config import config_app
from twin.cli_effects import effects_app
from twin.cli_exchange import export_fmu
from twin.cli_figures import figures_app, keeper_of, key_figures_of
from twin.cli_fleet import fleet_app
from twin.cli_init import init
from twin.cli_outlets import outlets_of
from twin.cli_serve import live_rows_of, reports_of, serve
from twin.cli_users import users_app
from twin.errors import ConfigError, SourceError, TwinError
from twin.events import Event, Kind, Severity
from twin.files import require_writable, write_json, write_whole
from twin.instants import stamp
from twin.lock import only_run
from twin.printer import Printer
from twin.service import Service

if TYPE_CHECKING:
    from sqlalchemy import URL

    from drivers.hil import Writer
    from drivers.results_state import Results
    from twin.cli_outlets import Begin, Standing
    from twin.config import Config
    from twin.diagnosis.answer import Diagnosis
    from twin.live import Adviser, Sink, Twin
    from twin.log.header import LogHeader
    from twin.monitor.detect import Monitor
    from twin.monitor.listening import Notices
    from twin.settings import Document
    from twin.signals import Samples, Ticks
    from twin.tables.reader import Table
    from twin.view import Screen

GARBAGE = 20_000  # objects made and not let go of, after which Python looks for garbage
INTERRUPTED = 130
WAITS = "it is tried until it answers"  # a PLC that is off
ALARMED = 1

# As the days go: begin, run, ask why, look after what is kept, tools.
ORDER = (
    *("init", "config", "probe", "import", "commission", "calibrate"),
    *("run", "serve", "replay", "diagnose", "compare", "figures", "alarms"),
    *("fleet", "log", "assets", "users", "cert"),
    *("export", "export-fmu", "effects", "paper", "plc"),
)

app = App("A live digital twin of pneumatic vacuum ejectors.", ORDER)
app.add_typer(assets_app, name="assets")
app.add_typer(figures_app, name="figures")
app.add_typer(alarms_app, name="alarms")
app.add_typer(fleet_app, name="fleet")
app.add_typer(users_app, name="users")
app.add_typer(config_app, name="config")
app.add_typer(effects_app, name="effects")
log_app = App("Look after logs.")
app.add_typer(log_app, name="log")

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


@app.command()
def run(
    configs: ConfigFiles,
    *,
    duration: Annotated[
        float | None,
        typer.Option(metavar="S", callback=not_negative, help="Stop after S seconds with the PLC."),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write an MCAP log; a new one each time in a folder."),
    ] = None,
    view: ViewFlag = False,
    rrd: RrdFile = None,
    address: Address = "",
    unit: UnitId = "",
    assets: AssetsUrl = "",
    hil: Annotated[
        bool, typer.Option("--hil", help="Be the plant of the PLC: write what [hil.tags] lists.")
    ] = False,
    once: Annotated[
        bool, typer.Option("--once", help="End if the PLC does not answer at the start.")
    ] = False,
    fail_on_alarm: FailOnAlarm = False,
) -> None:
    """Run the twin beside a PLC: read, expect, compare, log, alarm, diagnose. Ctrl-C ends it.

    Several configurations are as many ejectors, each with its own twin and log (FILE gets the
    asset's id before its suffix). One that fails does not stop the others. A PLC that does not
    answer yet is tried until it does. Where FILE is a folder, logs in it are named by asset and
    time. The oldest logs make room for new ones, as [log] says.
    """
    from drivers.hil import open_writer
    from drivers.results_settings import open_results
    from drivers.shared import Lines
    from drivers.sources import open_source
    from twin.figures.table import FIGURES
    from twin.live import run as run_loop
    from twin.settings import Document
    from twin.together import run_together

    alone = len(configs) == 1
    if not alone:
        _refuse_one_id(unit, len(configs))
    _require_places(log, rrd)  # the PLC may answer much later
    ejectors = _named([_configured(Document.read(one), assets, unit) for one in configs])
    pairs = {name: pair_of(one) for name, one in ejectors.items()}  # compiled before time counts
    width = 0 if alone else max(map(len, ejectors))
    lines = Lines()

    def beside(name: str, settings: "Config") -> None:
        label = "" if alone else name
        twin, monitor = pairs[name]
        alarms, outlets = alarms_of(settings, complain), outlets_of(settings, complain)
        at = settings.document, address, lines if hil or not alone else None
        plc = _Plc(partial(open_source, *at), label, complain, once=once)
        shown = (
            show(name, settings.asset.type, asker_of(settings), plc.results_down) if show else None
        )
        with (
            service.loop(name, stop) as stopped,
            _closed(shown),
            _locked(settings, log, complain),
            ExitStack() as closing,
        ):
            if not plc.answers(stopped):  # said before a log is begun
                return
            # So is what is wrong with [hil].
            writer = closing.enter_context(open_writer(*at)) if hil else None
            file = _file_of(log, label, name)
            # The log comes last: what people are told does not wait for the disk.
            opened = _opened(
                {
                    "console": lambda: consoles[name],
                    "OPC UA results": (lambda: shown) if shown else None,
                    "key figures": keeper_of(settings, complain),
                    "live page": live_rows_of(settings, complain),
                    "view": view_of(name),
                    "log": partial(_recorder, file, settings, hil=hil) if file else None,
                }
            )
            closing.enter_context(
                _retained(settings, opened.get("log"), plc.listening.notices, complain)
            )
            adviser = _diagnosing(settings, file, stopped, alone=alone)
            # What is not measured has no faults. Alarms come last: they hear the diagnosis.
            advised: dict[str, Adviser] = (
                {} if hil else {"diagnosis": adviser, "alarms": (board := alarms())}
            )
            told = {} if hil else _told(board.standing(), shown, outlets)
            sinks, advisers = _supervised({**told, **opened}, advised, plc.listening.notices)
            # It begins with the newest row: what came while all this was opened is not judged.
            source = _answering(plc.blocks(), settings, writer) if writer else plc.blocks()
            with _closed(source):
                run_loop(_until(stopped, source), twin, monitor, sinks, plc.listening, advisers)

    failed: list[str] = []
    units = {figure.name: figure.unit for figure in FIGURES.values()}
    with (
        open_results([one.document for one in ejectors.values()], units) as show,
        _views_of(ejectors, view, rrd) as view_of,
        _stop_on_signal(duration) as stop,
        _spared(),
        Service(os.environ) as service,
        _printers() as (printer, complain),
    ):
        consoles = {
            name: Console("" if alone else name.ljust(width), printer.print) for name in ejectors
        }
        if alone:
            beside(*next(iter(ejectors.items())))
        else:
            loops = {name: partial(beside, name, one) for name, one in ejectors.items()}
            failed = run_together(loops, lambda name, why: complain(f"{name}: {why}"))
        if failed:
            raise SourceError(f"{len(failed)} of {len(loops)} ejectors failed: {', '.join(failed)}")
        alarmed = any(console.alarmed for console in consoles.values())
        _leave(fail_on_alarm and alarmed, interrupted=stop() == "interrupted")


@app.command()
def replay(
    log: LogFile,
    *,
    config: ConfigOption = None,
    unit: UnitId = "",
    assets: AssetsUrl = "",
    as_of: AsOf = "",
    output: Annotated[
        Path | None, typer.Option("-o", metavar="OUT.mcap", help="Write a new log.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="F", help="Write the events as JSON.")
    ] = None,
    view: ViewFlag = False,
    rrd: RrdFile = None,
    fail_on_alarm: FailOnAlarm = False,
) -> None:
    """Run the same loop over a recorded log, as fast as it goes."""
    with _unwatched():
        from twin.live import REPLAYED
        from twin.live import run as run_loop
        from twin.log.part import refuse_other_suffix
        from twin.log.reader import open_log
        from twin.log.recorder import Recorder

        require_writable(json_file)
        if output is not None:
            refuse_other_suffix(output)
        recorded = open_log(log)
        say_if_cut(recorded, log, "replayed")
        settings = _settings_of(recorded.header, log, config, assets, unit, as_of)
        twin, monitor = pair_of(settings, judges=not recorded.header.derived)
        alarms = alarms_of(settings)()
    with _views_of({"": settings}, view, rrd) as view_of, _stop_on_signal(None) as stopped:
        console, kept = Console(), _Kept() if json_file else None
        header = settings.log_header(recorded.header.unmeasured)
        sinks = _opened(
            {
                "log": partial(Recorder, output, header) if output else None,
                "view": view_of(""),
                "console": lambda: console,
                "events": (lambda: kept) if kept else None,
            }
        )
        blocks = _progress((samples for samples, _ in recorded.blocks(REPLAYED)), "replaying")
        run_loop(_until(stopped, blocks), twin, monitor, [*sinks.values()], advisers=[alarms])
    if json_file is not None and kept is not None:
        write_json(json_file, {"log": str(log), "events": kept.events})
    alarmed = fail_on_alarm and console.alarmed
    _leave(alarmed, interrupted=stopped() == "interrupted")


@app.command()
def plc(
    configs: ConfigFiles,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE[@START][/COURSE]", help="For example leakage=2.0@10."),
    ] = None,
    port: Annotated[int | None, typer.Option(help="Modbus TCP port; 0 takes any free.")] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="For all that is random: same seed, same run.")
    ] = 0,
    duration: Annotated[
        float | None,
        typer.Option(metavar="S", callback=not_negative, help="Stop after S seconds."),
    ] = None,
) -> None:
    """Run the simulated PLC with an ejector behind it, for trials and tests.

    With several configurations as many ejectors are behind it, each with its own unit and prefix
    of nodes; the first one says where it listens and has the faults.
    """
    from drivers.plc.faults import parse_fault
    from drivers.plc.live import run_plc
    from drivers.plc.settings import PlcSettings

    documents = [read_config(one) for one in configs]
    for document in documents:
        if "plc" not in document.tables:
            raise ConfigError(
                f"{document.name}: there is no [plc] table",
                "say what is simulated, as configs/test_rig.toml does",
            )
    settings = [one.section(PlcSettings, "plc").on_port(port) for one in documents]
    run_plc(settings, [parse_fault(text) for text in fault or []], seed, duration)


@app.command()
def probe(config: ConfigFile, address: Address = "") -> None:
    """Say what a PLC at the configured address answers, word order included."""
    from drivers.sources import probe_source

    for line in probe_source(read_config(config), address):
        print(line)


@app.command()
def diagnose(
    log: LogFile,
    *,
    config: ConfigOption = None,
    unit: UnitId = "",
    assets: AssetsUrl = "",
    as_of: AsOf = "",
    json_file: JsonFile = None,
    report: Annotated[
        Path | None, typer.Option(metavar="F.html", help="Write a page with pictures.")
    ] = None,
    save_as: Annotated[
        str, typer.Option(metavar="NEWID", help="Keep the extended model as that of a unit.")
    ] = "",
    judge_on: Annotated[
        Path | None,
        typer.Option(metavar="OTHER.mcap", help="Measure the gain on another log as well."),
    ] = None,
    propose: Annotated[
        Path | None,
        typer.Option(metavar="F.toml", help="Write what acts, unlisted, for twin effects add."),
    ] = None,
) -> None:
    """Say what the simulation gets wrong on a log, why, and what knowing it gains."""
    from twin.diagnosis.another_log import judged_on
    from twin.diagnosis.answer import diagnose as find_cause
    from twin.diagnosis.extend import nothing
    from twin.diagnosis.report import in_words, write_report
    from twin.diagnosis.words import on_another_log
    from twin.log.reader import open_log

    require_writable(json_file, report, propose)
    recorded = open_log(log)
    say_if_cut(recorded, log, "diagnosed")
    other = open_log(judge_on) if judge_on else None
    if other is not None and judge_on is not None:
        other.header.require_commands(str(judge_on))
        say_if_cut(other, judge_on, "judged on")
    store = bool(save_as)
    settings = _settings_of(recorded.header, log, config, assets, unit, as_of, to_store=store)
    if not unit:
        settings.refuse_another(recorded.header, str(log))
    with _status() as say:
        blocks = (rows for rows, _ in recorded.blocks())
        diagnosis = find_cause(settings, blocks, str(log), say, derived=recorded.header.derived)
        if other is not None:
            say(f"judging on {judge_on}")
            blocks = (rows for rows, _ in other.blocks())
            diagnosis.json["judged_on"] = judged_on(diagnosis, settings, str(judge_on), blocks)
    print(in_words(diagnosis))
    if other is not None:
        print(on_another_log(diagnosis.json, nothing(diagnosis)))
    if json_file is not None:
        write_json(json_file, diagnosis.json)
    if report is not None:
        write_report(diagnosis, report)
    if save_as:
        _save(diagnosis, settings, save_as, assets, log)
    if propose is not None:
        _propose(diagnosis, settings, log, propose)


@app.command()
def calibrate(
    log: LogFile,
    config: Annotated[Path, typer.Option(help="TOML configuration of the unit and its system.")],
    unit: UnitId = "",
    assets: AssetsUrl = "",
    json_file: JsonFile = None,
) -> None:
    """Fit the instance-specific data set of one unit to healthy cycles, and store it."""
    from twin.calibration.calibrate import calibrate as fit_unit
    from twin.calibration.report import as_json, in_words
    from twin.calibration.store import store
    from twin.config import Config
    from twin.log.reader import open_log
    from twin.settings import Document

    require_writable(json_file)
    settings = Config.of(Document.read(config), assets, unit, calibrated=False)
    if not settings.asset.id:
        raise ConfigError("no unit is named", "give --id ID, or [asset] id in the configuration")
    recorded = open_log(log)
    recorded.header.require_commands(str(log))
    settings = settings.of_rows(recorded.header)
    say_if_cut(recorded, log, "used")
    with _status() as say:
        calibration = fit_unit(settings, (rows for rows, _ in recorded.blocks()), say)
    say_if_new(assets, settings.document)
    record, where = store(calibration, settings, assets, log)
    print(in_words(calibration))
    print(f"stored as {settings.asset.id} in {where}, record {record.id[:8]}")
    if json_file is not None:
        write_json(json_file, as_json(calibration, record))


@app.command()
def commission(
    source: Annotated[
        Path, typer.Argument(metavar="LOG.mcap|CONFIG", help="A record, or the unit's PLC.")
    ],
    unit: UnitId = "",
    config: ConfigOption = None,
    cycles: Annotated[
        int, typer.Option(metavar="N", help="How many cycles to record from a PLC.")
    ] = 12,
    assets: AssetsUrl = "",
    json_file: JsonFile = None,
    report: Annotated[
        Path | None, typer.Option(metavar="F.html", help="One page for people.")
    ] = None,
) -> None:
    """Fit a unit that nobody has seen before to a record of healthy cycles, and store it.

    The configuration says what hangs on the ejector; a fifth off is near enough. The record
    corrects it where they differ. The verdict is good, usable or refused (exit code 2).
    """
    from twin.calibration.commission import commission as fit_unit
    from twin.calibration.page import write_page
    from twin.calibration.report import commissioned_as_json, commissioned_in_words
    from twin.calibration.store import store_first
    from twin.config import Config, document_in
    from twin.log.reader import open_log
    from twin.settings import Document

    require_writable(json_file, report)
    recorded = None if source.suffix == ".toml" else open_log(source)
    if recorded is not None:
        recorded.header.require_commands(str(source))
        say_if_cut(recorded, source, "used")
    if recorded is None or config is not None:
        document = Document.read(config or source)
    else:
        document = document_in(recorded.header)
    settings = Config.of(document, assets, unit, calibrated=False)
    if recorded is not None:
        settings = settings.of_rows(recorded.header)
    if not settings.asset.id:
        raise ConfigError("no unit is named", "give --id ID, or [asset] id in the configuration")
    with _status() as say:
        blocks = (
            (rows for rows, _ in recorded.blocks())
            if recorded is not None
            else _recorded_cycles(document, cycles, say)
        )
        found = fit_unit(settings, blocks, say)
    print(commissioned_in_words(found))
    record = None
    if found.verdict.word != "refused":
        say_if_new(assets, settings.document)
        record, where = store_first(found.calibration, settings, assets, source)
        print(f"stored as {settings.asset.id} in {where}, record {record.id[:8]}")
    if json_file is not None:
        write_json(json_file, commissioned_as_json(found, settings.asset, record))
    if report is not None:
        write_page(found, settings.asset, report)
    if record is None:
        raise typer.Exit(2)


def _recorded_cycles(
    document: "Document", cycles: int, say: "Callable[[str], None]"
) -> "Iterator[Samples]":
    """Blocks from the PLC until so many cycles have ended after the first, which may be cut."""
    from drivers.sources import open_source
    from twin.signals import Command

    begun, before = 0, True
    source = open_source(document)
    with _closed(source):
        for block in source:
            on = (block["commands"] & Command.SUCTION) != 0
            for row in on.tolist():
                begun, before = begun + (row and not before), row
            say(f"recording: suction {min(begun, cycles + 2)} of {cycles + 2}")
            yield block
            if begun > cycles + 1:
                return


def _known_zone(name: str) -> str:
    """For ``--time-zone``: usage error unless there is such a zone."""
    from twin.tables.settings import known_zone

    try:
        return known_zone(name) if name else name
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error


@app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="CSV, Excel (.xlsx) or Parquet.")],
    config: Annotated[Path, typer.Option(help="TOML configuration; [import] maps columns.")],
    output: Annotated[
        Path | None, typer.Option("-o", metavar="LOG.mcap", help="Write the new log.")
    ] = None,
    unit: UnitId = "",
    assets: AssetsUrl = "",
    time_zone: Annotated[
        str,
        typer.Option(
            metavar="ZONE",
            callback=_known_zone,
            help="Of times that say none, as Europe/Berlin or UTC.",
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
) -> None:
    """Make a log of a PLC's trace export, with what the twin expects beside it."""
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
    elif not dry_run:
        raise typer.BadParameter("say with -o LOG.mcap where the log goes, or look with --dry-run")
    settings = _configured(Document.read(config), assets, unit)
    wanted = settings.document.section(ImportSettings, "import")
    if time_zone:
        wanted = wanted.model_copy(update={"time_zone": time_zone})
    ambient = settings.data.ambient.pressure_mbar * MBAR
    table = open_table(file, wanted, ambient, derive=derive_commands)
    settings = replace(settings, gauge=table.counts_from_ambient)
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
    else:  # a whole look first: nothing is said of rows that are then refused
        for _ in _progress(table.blocks(), "reading"):
            pass
    twin, monitor = pair_of(settings, judges=not table.commands)
    with _whole(output) as part, _stop_on_signal(None) as stopped:
        header = settings.log_header(unmeasured)
        sinks = _opened({"log": partial(Recorder, part, header), "console": Console})
        blocks = _until(stopped, _progress(table.blocks(), "importing"))
        run_loop(blocks, twin, monitor, [*sinks.values()])
    return _leave(interrupted=stopped() == "interrupted")


def _show(table: "Table", *, derive: bool) -> None:
    """Print how a table is understood, also where it is then refused."""
    from twin.tables.preview import Preview

    preview = Preview(table)
    try:
        for block in _progress(table.blocks(), "reading"):
            preview.see(block)
    finally:
        print(preview)
    if derive:
        print(table.with_commands().commands)


@app.command()
def export(
    log: LogFile,
    output: Annotated[Path, typer.Option("-o", metavar="FILE", help="*.csv or *.parquet.")],
) -> None:
    """Write a log as a table for other programs, lossless."""
    from twin.log.reader import open_log
    from twin.tables.export import ROWS
    from twin.tables.export import export as write_table

    recorded = open_log(log)
    say_if_cut(recorded, log, "exported")
    write_table(recorded.blocks(ROWS), recorded.header, output)


@app.command()
def paper(
    json_file: Annotated[
        Path | None,
        typer.Option("--json", metavar="F", help="Write the recomputed figures as JSON."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="F.(svg|png)", help="Draw the curves.")
    ] = None,
) -> None:
    """Recompute the founding paper's tables 2 and 4, and say what they can tell."""
    from twin.paper.separation import separate
    from twin.paper.tables import late_by, recomputed
    from twin.paper.words import in_words

    require_writable(json_file, picture)
    rows = recomputed()
    separation = separate(late_by(rows))
    if picture is not None:
        from twin.paper.picture import draw

        draw(rows, separation, picture)
    if json_file is not None:
        write_json(json_file, [row.json for row in rows])
    print(in_words(rows, separation))


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


app.command()(compare)
app.command()(export_fmu)
app.command()(serve)
app.command()(cert)
app.command()(init)


def main() -> None:
    """Run the command line; errors become one message with a hint, and the exit code."""
    # Matrices are small here: more threads only wait for each other, on cores that others need.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when a command imports NumPy
    gc.set_threshold(GARBAGE)  # of what is imported nothing is: looking is a tenth of the start
    atexit.register(gc.freeze)  # what is left ends with the process: no 0.2 s for its garbage
    try:
        app(prog_name="twin")
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except TwinError as error:
        _complain(f"{error}\n  {error.hint}" if error.hint else str(error))
        sys.exit(error.exit_code)


# --- what the commands share --------------------------------------------------------------------


class Console:
    """A sink that prints what happens, one line each, with whose loop says it.

    ``say`` prints lines in one piece, since others may be printing too.
    """

    def __init__(self, name: str = "", say: Callable[[str], None] | None = None) -> None:
        self.alarmed = False  # all it keeps: a loop runs for months
        self._name = f"{name}  " if name else ""
        self._say = say or _print

    def write(self, _samples: "Samples", _ticks: "Ticks", events: Sequence[Event]) -> None:
        """Print what happened; an alarm does not say again what it is made of."""
        told, lines = {event.text for event in events}, ""
        for event in events:
            self.alarmed |= event.severity is Severity.ALARM
            what = f"{event.severity:<7}  {event.kind:<17}  {_short(event, told)}"
            lines += f"{stamp(event.time_ns)}  {self._name}{what}\n"
        if lines:
            self._say(lines)

    def close(self) -> None:
        """Nothing to finish."""


def _short(event: Event, told: Collection[str]) -> str:
    """The text of an event; of an alarm without its evidence, where that has been ``told``."""
    words = event.data.get("evidence", {}).get("words")
    return event.text.replace(f": {words}", "", 1) if words in told else event.text


class _Kept:
    """A sink that keeps what happens, as JSON has it."""

    def __init__(self) -> None:
        self.events: list[dict[str, object]] = []

    def write(self, _samples: "Samples", _ticks: "Ticks", events: Sequence[Event]) -> None:
        """Keep what happened."""
        self.events += map(_plain, events)

    def close(self) -> None:
        """Nothing to finish."""


@contextmanager
def _printers() -> Iterator[tuple[Printer, Callable[[str], None]]]:
    """Give what prints to stdout, and what complains on stderr, without waiting for who reads."""
    printer, talk = Printer(sys.stdout), Printer(sys.stderr)
    try:
        yield printer, lambda what: talk.say(f"twin: {what}\n")
    finally:
        if left := printer.close():
            talk.say(f"twin: nobody took what was said last, in {left} parts\n")
        talk.close()


def _print(text: str) -> None:
    try:
        print(text, end="", flush=True)
    except OSError:  # a pipe that nobody reads any more, a terminal that was closed
        _mute(sys.stdout)


def _complain(what: str) -> None:
    """In one piece, since others may be printing too."""
    try:
        print(f"twin: {what}\n", end="", file=sys.stderr, flush=True)
    except OSError:
        _mute(sys.stderr)


def _mute(stream: TextIO) -> None:
    """Have nothing more written to where nobody reads: each write would be an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def _named(ejectors: "Sequence[Config]") -> "dict[str, Config]":
    """The configurations by asset; ConfigError where two are of the same."""
    named: dict[str, Config] = {}
    for settings in ejectors:
        name = re.sub(r"[^\w.-]", "_", settings.asset.id) or Path(settings.document.name).stem
        if name in named:
            raise ConfigError(
                f"{named[name].document.name} and {settings.document.name} are both of {name}",
                "give each ejector its own id under [asset]",
            )
        named[name] = settings
    return named


def _refuse_one_id(unit: str, ejectors: int) -> None:
    """ConfigError if several are to be the one unit."""
    if unit:
        raise ConfigError(
            f"--id is for one ejector, and here are {ejectors}",
            "leave it out, and give each configuration its own under [asset]",
        )


@contextmanager
def _locked(
    settings: "Config", log: Path | None, complain: Callable[[str], None]
) -> Iterator[None]:
    """Be the only run of the unit that writes where this one does; SourceError says who else is."""
    unit = " ".join(part for part in (settings.asset.type, settings.asset.id) if part)
    with ExitStack() as locks:
        for folder in sorted(_written_by(settings, log)):
            locks.enter_context(only_run(folder, unit, time.time_ns(), complain))
        yield


def _written_by(settings: "Config", log: Path | None) -> set[Path]:
    """The folders in which a second run of the unit would write the same once more."""
    from twin.alarms.place import place_of as alarms_in
    from twin.alarms.settings import AlarmSettings
    from twin.assets.engine import sqlite_file
    from twin.figures.place import place_of as figures_in
    from twin.figures.settings import FigureSettings

    document, places = settings.document, list["URL"]()
    if document.section(AlarmSettings, "alarms").keep:
        places.append(alarms_in(document))
    if document.section(FigureSettings, "figures").keep:
        places.append(figures_in(document))
    files = (sqlite_file(place) or Path(document.name) for place in places)  # or a server
    logs = [] if log is None else [log if log.is_dir() else log.parent]
    return {folder.resolve() for folder in [*logs, *(Path(file).parent for file in files)]}


def _diagnosing(
    settings: "Config", log: Path | None, stopped: Callable[[], str], *, alone: bool
) -> "Adviser":
    """Who has the alarms of a live run diagnosed."""
    from twin.diagnosis.process import LiveDiagnosis

    return LiveDiagnosis(
        settings,
        str(log or "live"),
        lambda: stopped() == "interrupted",
        _status if alone else _unsaid,
        reports=reports_of(settings),
    )


def _require_places(log: Path | None, rrd: Path | None) -> None:
    """SourceError if no log or no view can be written there."""
    require_writable(rrd)
    if log is None or not log.is_dir():
        require_writable(log)
    elif not os.access(log, os.W_OK):
        raise SourceError(f"{log}: cannot be written to", "see to the rights of the folder")


def _file_of(path: Path | None, label: str, name: str) -> Path | None:
    """Where one of several writes: run.mcap becomes run.rig-01.mcap; in a folder a new file."""
    if path is not None and path.is_dir():
        return path / time.strftime(f"{name}.%Y%m%dT%H%M%SZ.mcap", time.gmtime())
    return path.with_name(f"{path.stem}.{label}{path.suffix}") if path and label else path


def _retained(
    settings: "Config",
    log: "Sink | None",
    notices: "Notices",
    complain: Callable[[str], None],
) -> "AbstractContextManager[object]":
    """What keeps the logs of a live run within the bounds of [log]."""
    from twin.log.recorder import Recorder
    from twin.log.retention import GB, Bounds, Retention

    if not isinstance(log, Recorder):
        return nullcontext()
    kept, unit = settings.log, (settings.asset.type, settings.asset.id)
    bounds = Bounds(kept.keep_days, kept.keep_gb and kept.keep_gb * GB, kept.disk_pct / 100)
    tell = partial(notices.tell, Kind.LOG_DELETED)
    return Retention(log.under_way.parent, unit, bounds, lambda: log.under_way, tell, complain)


def _recorder(file: Path, settings: "Config", *, hil: bool) -> "Sink":
    """The log of a live run."""
    from twin.log.header import HIL, RECORDED
    from twin.log.recorder import Recorder

    rotate = round(settings.log.rotate_mb * 1e6)
    own = {RECORDED: "twin run"}
    if hil:
        own[HIL] = "the pressure is the model's own, as it was written to the PLC"
    return Recorder(file, settings.log_header(own), rotate_bytes=rotate)


def pair_of(settings: "Config", *, judges: bool = True) -> tuple["Twin", "Monitor"]:
    """The twin of a configuration and its monitor, which may be one that ``judges`` no cycle."""
    from twin.live import compiled
    from twin.monitor.detect import Monitor
    from twin.monitor.isolation import Isolation
    from twin.monitor.reports import ReportWatch

    with _heeded():
        twin = compiled(settings.data)
    watch = settings.monitor
    isolation = (
        Isolation.of(settings.data, watch.healthy, watch.false_alarm_days)
        if watch.isolate and judges
        else None
    )
    teller = key_figures_of(settings) if judges else None
    monitor = Monitor(watch, twin.theta, teller=teller, isolation=isolation, judges=judges)
    monitor.reports = ReportWatch(twin.theta, twin.knees) if judges else None
    if settings.document.tables.get("driver", {}).get("mode") == "poll":
        monitor.clocks = None  # then time is that of the poll here
    return twin, monitor


@contextmanager
def _heeded() -> Iterator[None]:
    """Have a Ctrl-C end what is done here: a compiler's callbacks swallow Python's exception."""
    interrupted = False

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupted:
        raise KeyboardInterrupt


def _answering(
    source: "Iterator[Samples]", settings: "Config", writer: "Writer"
) -> "Iterator[Samples]":
    """The blocks with the model as the plant, which answers what the PLC commands."""
    from drivers.hil import Outputs
    from twin.hil import Plant, in_place
    from twin.model.dataset import coefficients

    plant = Plant(coefficients(settings.data), settings.data.terms)
    return in_place(source, plant, lambda *values: writer.put(Outputs(*values)))


def _configured(document: "Document", assets: str, unit: str) -> "Config":
    """The configuration with what is known of its unit; says so if one that is named is unknown."""
    from twin.config import Config

    settings = Config.of(document, assets, unit)
    _say_instead(settings, unit)
    return settings


def _settings_of(
    header: "LogHeader",
    log: Path,
    instead: Path | None,
    assets: str,
    unit: str,
    as_of: str,
    *,
    to_store: bool = False,
) -> "Config":
    """The configuration a log carries, with the data set it was made with; or another one.

    ``to_store`` something in the asset database: it may be new.
    """
    from twin.assets.file import parse_time
    from twin.config import Config
    from twin.settings import Document

    document = Document.read(instead) if instead is not None else None
    known = parse_time(as_of) if as_of else None
    settings = Config.of_recorded(
        header, str(log), document, assets, unit, known, to_store=to_store
    )
    _say_instead(settings, unit)
    return settings


def _say_instead(settings: "Config", unit: str) -> None:
    """Say so if a unit that is named is unknown."""
    if unit and settings.instead:
        print(f"twin: {settings.instead}", file=sys.stderr)


def _save(diagnosis: "Diagnosis", settings: "Config", unit: str, assets: str, log: Path) -> None:
    """Keep the extended model, or say why there is none."""
    from twin.diagnosis.extend import extended, nothing, remarks, store

    print()
    for line in remarks(diagnosis):
        print(line)
    known = extended(diagnosis, settings)
    if known is None:
        print(f"nothing is stored as {unit}: {nothing(diagnosis)}")
        return
    say_if_new(assets, settings.document)
    record, where = store(known, diagnosis, settings, unit, assets, log)
    print(f"stored as {unit} in {where}, record {record.id[:8]}; use it: --id {unit}")


def _propose(diagnosis: "Diagnosis", settings: "Config", log: Path, file: Path) -> None:
    """Write what acts that nobody listed as an effect to be taken in, or say why there is none."""
    from twin.diagnosis.propose import proposed

    text = proposed(diagnosis, settings, log, file)
    print()
    if text is None:
        print(f"nothing is written to {file}: no mechanism that nobody listed was found")
        return
    write_whole(file, text.encode())
    print(f"proposed as an effect in {file}; read it, then: twin effects add {file}")


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """Give a name to write under; ``path`` is there only once all went well, and never replaced."""
    if path.exists():
        message = f"{path}: there is already a file of that name"
        raise SourceError(message, "choose another name, or remove it")
    part = path.with_name(f"{path.name}.part")
    with suppress(OSError):
        part.unlink()  # left by one that was killed
    try:
        yield part
        part.rename(path)
    finally:
        with suppress(OSError):
            part.unlink()


def _opened(makers: "Mapping[str, Callable[[], Sink] | None]") -> "dict[str, Sink]":
    """The sinks that are wanted; if one cannot be opened, those before it are closed."""
    sinks: dict[str, Sink] = {}
    try:
        for name, make in makers.items():
            if make is not None:
                sinks[name] = make()
    except BaseException:
        for sink in sinks.values():
            sink.close()
        raise
    return sinks


def _supervised(
    sinks: "Mapping[str, Sink]", advisers: "Mapping[str, Adviser]", notices: "Notices"
) -> "tuple[list[Sink], list[Adviser]]":
    """The same; one that fails does not end the run."""
    from twin.log.recorder import Recorder
    from twin.supervised import Outages, SupervisedAdviser, SupervisedSink

    outages = Outages(notices)

    def supervised(name: str, sink: "Sink") -> "Sink":
        if isinstance(sink, Recorder):
            return SupervisedSink(name, sink, sink.again, outages, held=lambda: sink.held)
        rows = not isinstance(sink, Console)
        return SupervisedSink(name, sink, lambda: sink, outages, rows=rows)

    return (
        [supervised(*one) for one in sinks.items()],
        [SupervisedAdviser(name, one, outages) for name, one in advisers.items()],
    )


@contextmanager
def _unwatched() -> "Iterator[None]":
    """Keep the garbage collector off while a command gets ready: nothing made then is garbage."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()  # or it would go through all of it now
        gc.enable()


@contextmanager
def _spared() -> "Iterator[None]":
    """Keep the garbage collector from all there is: going through it holds a block up by 0.2 s."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _told(
    standing: "Standing", shown: "Results | None", outlets: "Begin | None"
) -> "dict[str, Sink]":
    """Tell of the alarms that stand when a run begins; gives the sinks that tell of the others."""
    if shown is not None:
        shown.resume(standing, time.time_ns())
    return {} if outlets is None else {"MQTT and webhook": outlets(standing)}


@contextmanager
def _views_of(
    ejectors: "dict[str, Config]", view: bool, rrd: Path | None
) -> "Iterator[Callable[[str], Callable[[], Sink] | None]]":
    """Give what opens the Rerun view of an ejector, by its name: all in one window or one file."""
    if view and rrd is not None:
        raise ConfigError("--view and --rrd exclude each other", "open the file: rerun FILE.rrd")
    one_at_a_time, alone = Lock(), len(ejectors) == 1
    with ExitStack() as closing:

        @cache
        def screen() -> "Screen":  # opened by the first that has something to show
            from twin.view import Screen

            titles = [f"{one.asset.type} {one.asset.id}" for one in ejectors.values()]
            opened = Screen(", ".join(titles), rrd, ("",) if alone else tuple(ejectors))
            closing.callback(opened.close)
            if opened.url:
                print(f"the view is at {opened.url}", file=sys.stderr)
            return opened

        def open_view(name: str) -> "Sink":
            from twin.signals import MBAR
            from twin.view import View

            ambient = ejectors[name].data.ambient.pressure_mbar * MBAR
            with one_at_a_time:
                return View(screen(), ambient, "" if alone else name)

        yield lambda name: partial(open_view, name) if view or rrd is not None else None


@contextmanager
def _closed(source: object) -> Iterator[None]:
    """Close it at the end, begun or not: drivers have threads and connections."""
    try:
        yield
    finally:
        if hasattr(source, "close"):
            source.close()


class _Plc:
    """The PLC of one ejector: tried until it answers, unless it is to answer at ``once``."""

    def __init__(
        self,
        opened: "Callable[..., Iterator[Samples]]",
        name: str,
        complain: Callable[[str], None],
        *,
        once: bool,
    ) -> None:
        from twin.monitor.listening import Listening

        self.listening = Listening()
        self._opened, self._complain, self._once = opened, complain, once
        self._said = f"{name}: " if name else ""
        self._waits = False  # it did not answer at first
        self._known = False  # it has given a row: whatever it sends from now on may pass

    def blocks(self) -> "Iterator[Samples]":
        """Its samples from now on; errors as from ``drivers.sources.open_source``."""
        away = None if self._once and not self._known else self._away
        return self._opened(away, known=self._known)

    def answers(self, stopped: Callable[..., str]) -> bool:
        """Wait for a row and hang up; False if the run is interrupted before there is one."""
        source = self.blocks()
        with _closed(source):
            for block in source:
                if len(block):
                    self._known = True
                    break
                if stopped(begun=False):
                    return False
        if self._waits:
            self._complain(f"{self._said}the PLC answers")
        return True

    def results_down(self, why: str) -> None:
        """Have it said with the events of this ejector."""
        self.listening.notices.tell(Kind.RESULTS_DOWN, why)

    def _away(self, error: TwinError) -> None:
        if self._known:
            self.listening.notices.tell(Kind.PLC_LOST, str(error))
            return
        waits = "" if self._waits else f"\n  {WAITS}; with --once the run ends instead"
        self._waits = True
        self._complain(f"{self._said}{error}\n  {error.hint}{waits}")


@contextmanager
def _stop_on_signal(duration: float | None) -> Iterator[Callable[..., str]]:
    """Give a function that says why to stop: "" (go on), "duration" or "interrupted".

    The first Ctrl-C lets the loop finish its block and close the log; the second one is Python's.
    """
    end: float | None = None  # from the first question on: what comes before takes its time
    reason = ""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal reason
        if reason == "interrupted":
            raise KeyboardInterrupt
        reason = "interrupted"

    def why(*, begun: bool = True) -> str:
        nonlocal reason, end
        if begun and end is None and duration is not None:
            end = time.monotonic() + duration
        if not reason and end is not None and time.monotonic() >= end:
            reason = "duration"
        return reason

    wanted = {signal.SIGINT, signal.SIGTERM}
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup
        wanted.add(signal.SIGHUP)  # the terminal was closed
    before = {number: signal.signal(number, interrupt) for number in wanted}
    try:
        yield why
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _until(stopped: Callable[[], str], source: "Iterable[Samples]") -> "Iterator[Samples]":
    """The blocks of ``source`` until ``stopped`` gives a reason; the source is closed."""
    blocks = iter(source)
    try:
        while not stopped() and (block := next(blocks, None)) is not None:
            yield block
    finally:
        if hasattr(blocks, "close"):
            blocks.close()


def _progress(source: "Iterable[Samples]", what: str) -> "Iterator[Samples]":
    """Count samples on a terminal, say nothing in a pipe."""
    if not sys.stderr.isatty():
        yield from source
        return
    from rich.console import Console as Terminal
    from rich.progress import MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), MofNCompleteColumn())
    with Progress(*columns, console=Terminal(stderr=True), transient=True) as progress:
        task = progress.add_task(f"{what} (samples)", total=None)
        for block in source:
            progress.advance(task, len(block))
            yield block


@contextmanager
def _status() -> Iterator[Callable[[str], None]]:
    """Give a function that says what is being done: on a terminal, and nothing in a pipe."""
    if not sys.stderr.isatty():
        with _unsaid() as say:
            yield say
        return
    from rich.console import Console as Terminal

    with Terminal(stderr=True).status("") as status:
        yield status.update


@contextmanager
def _unsaid() -> Iterator[Callable[[str], None]]:
    """As ``_status`` where several would say it at once."""
    yield lambda _what: None


def _leave(alarmed: bool = False, *, interrupted: bool) -> None:
    """Exit as the contract of the command line has it."""
    if interrupted:
        raise typer.Exit(INTERRUPTED)
    if alarmed:
        raise typer.Exit(ALARMED)


def _plain(event: Event) -> dict[str, object]:
    return {
        "time_ns": event.time_ns,
        "kind": str(event.kind),
        "severity": str(event.severity),
        "text": event.text,
        "data": dict(event.data),
    }


if __name__ == "__main__":
    main()
