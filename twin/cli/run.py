"""``twin run``: the twin beside a PLC."""

import gc
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli.alarms import alarms_of, asker_of, limit_changes_of
from twin.cli.app import positive
from twin.cli.console import Console, hint, no_status, printers, status
from twin.cli.notifications import outlets_of
from twin.cli.options import (
    PAGE,
    Address,
    AssetsUrl,
    ConfigFiles,
    FailOnAlarm,
    RrdFile,
    UnitId,
    ViewFlag,
)
from twin.cli.serve import reports_of
from twin.cli.setup import configured
from twin.cli.sinks import live_sinks, outlet_sinks, supervised, views_of
from twin.cli.stopping import closed, leave, stop_on_signal, until
from twin.errors import ConfigError, SourceError, TwinError
from twin.events import Kind
from twin.files import require_writable
from twin.lock import only_run
from twin.service import Service

if TYPE_CHECKING:
    from sqlalchemy import URL

    from drivers.outputs.writer import Writer
    from twin.acquisition import Acquisition
    from twin.alarms.limit_changes import LimitChanges
    from twin.cli.compiling import Models
    from twin.config import Config
    from twin.live import EventEnricher, Sink
    from twin.monitor.staleness import Listening, Notices
    from twin.signals import Samples

POLL_S = 0.1  # between two looks whether the model is compiled
TOO_MANY = "too many rows wait for the model: the oldest are logged without expected pressure"
ENDED = "the run ended before the model was compiled: rows are logged without expected pressure"
WAITS = "it is tried until it answers"  # said of a PLC that is off


def run(
    configs: ConfigFiles,
    *,
    duration: Annotated[
        float | None,
        typer.Option(metavar="S", callback=positive, help="Stop after S seconds with the PLC."),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write an MCAP log; in a folder, a new one each time."),
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
    from drivers.connection_pool import ConnectionPool
    from drivers.outputs.open import open_results, open_writer
    from drivers.sources import open_source
    from twin.cli.compiling import Models
    from twin.run_many import run_together
    from twin.settings import Document

    alone = len(configs) == 1
    if not alone:
        _refuse_one_id(unit, len(configs))
    ejectors = _by_asset([configured(Document.read(path), assets, unit) for path in configs])
    _require_writable_targets(log, rrd)  # the PLC may answer much later
    width = 0 if alone else max(map(len, ejectors))
    pool = ConnectionPool()

    def run_one(name: str, settings: "Config") -> None:
        label = "" if alone else name
        alarms, outlets = alarms_of(settings, complain), outlets_of(settings, complain)
        source_arguments = settings.document, address, pool if hil or not alone else None
        plc = _Plc(partial(open_source, *source_arguments), label, complain, once=once)
        results = (
            show(name, settings.asset.type, asker_of(settings), plc.results_down) if show else None
        )
        with (
            service.loop(name, stop) as stopped,
            closed(results),
            _locked(settings, log, complain),
            ExitStack() as closing,
        ):
            if not plc.answers(stopped):  # reported before a log begins
                return
            # A mistake in [hil] is reported before a log begins, too.
            writer = closing.enter_context(open_writer(*source_arguments)) if hil else None
            file = closing.enter_context(
                _hinted(_file_of(log, label, name), complain if alone else None, hil=hil)
            )
            # From here on every row counts: what takes time comes after it.
            source = _answering(plc.blocks(), settings, writer) if writer else plc.blocks()
            rows = closing.enter_context(
                _acquired(until(stopped, source), plc.listening, ahead=not hil)
            )
            models.load()
            opened = live_sinks(
                settings, consoles[name], results, file, view_of(name), complain, hil=hil
            )
            closing.enter_context(
                _retained(settings, opened.get("log"), plc.listening.notices, complain)
            )
            adviser = _diagnosing(settings, file, stopped, complain, alone=alone)
            # With --hil nothing is measured, so nothing is diagnosed. Alarms come last: they use
            # the diagnosis.
            enrichers: dict[str, EventEnricher] = (
                {} if hil else {"diagnosis": adviser, "alarms": (board := alarms())}
            )
            limits = None if hil else limit_changes_of(settings, board)
            enrichers |= {"limits": limits} if limits else {}
            reached = {} if hil else outlet_sinks(board.standing(), results, outlets)
            sinks, advisers = supervised({**reached, **opened}, enrichers, plc.listening.notices)
            _loop(name, models, rows, plc.listening, sinks, advisers, stopped, limits)

    failed: list[str] = []
    models = Models(ejectors, at_once=hil)  # then the PLC waits for the model
    with (
        closed(models),
        open_results([settings.document for settings in ejectors.values()], _figure_units) as show,
        views_of(ejectors, view, rrd) as view_of,
        stop_on_signal(duration) as stop,
        _gc_frozen(),
        Service(os.environ) as service,
        printers() as (printer, complain),
    ):
        consoles = {
            name: Console("" if alone else name.ljust(width), printer.print) for name in ejectors
        }
        if alone:
            run_one(*next(iter(ejectors.items())))
        else:
            models.load()  # several loops that load at once would hold up their own acquisition
            loops = {name: partial(run_one, name, settings) for name, settings in ejectors.items()}
            failed = run_together(loops, lambda name, cause: complain(f"{name}: {cause}"))
        if failed:
            raise SourceError(f"{len(failed)} of {len(loops)} ejectors failed: {', '.join(failed)}")
        alarmed = any(console.alarmed for console in consoles.values())
        leave(fail_on_alarm and alarmed, interrupted=stop() == "interrupted")


class _Plc:
    """The PLC of one ejector: retried until it answers, unless it must answer at ``once``."""

    def __init__(
        self,
        opened: "Callable[..., Iterator[Samples]]",
        name: str,
        complain: Callable[[str], None],
        *,
        once: bool,
    ) -> None:
        from twin.monitor.staleness import Listening

        self.listening = Listening()
        self._opened, self._complain, self._once = opened, complain, once
        self._prefix = f"{name}: " if name else ""
        self._waits = False  # it did not answer at first
        self._known = False  # it has given a row: from now on any error may pass

    def blocks(self) -> "Iterator[Samples]":
        """Its samples from now on; errors as from ``drivers.sources.open_source``."""
        away = None if self._once and not self._known else self._away
        return self._opened(away, known=self._known)

    def answers(self, stopped: Callable[..., str]) -> bool:
        """Wait for a row and hang up; False if the run is interrupted before there is one."""
        source = self.blocks()
        with closed(source):
            for block in source:
                if len(block):
                    self._known = True
                    self.listening.answer.keep(block)
                    break
                if stopped(begun=False):
                    return False
        if self._waits:
            self._complain(f"{self._prefix}the PLC answers")
        return True

    def results_down(self, cause: str) -> None:
        """Report among the events of this ejector that the results server is down."""
        self.listening.notices.tell(Kind.RESULTS_DOWN, cause)

    def _away(self, error: TwinError) -> None:
        if self._known:
            self.listening.notices.tell(Kind.PLC_LOST, str(error))
            return
        waits = "" if self._waits else f"\n  {WAITS}; with --once the run ends instead"
        self._waits = True
        self._complain(f"{self._prefix}{error}\n  {error.hint}{waits}")


def _figure_units() -> dict[str, str]:
    """The unit of each key figure; its module loads slowly, and only published results need it."""
    from twin.figures.key_figures import FIGURES

    return {figure.name: figure.unit for figure in FIGURES.values()}


def _by_asset(ejectors: "Sequence[Config]") -> "dict[str, Config]":
    """The configurations by asset; ConfigError if two are of the same asset."""
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
    """ConfigError if ``--id`` is given for several ejectors."""
    if unit:
        raise ConfigError(
            f"--id is for one ejector, and here are {ejectors}",
            "leave it out, and give each configuration its own under [asset]",
        )


def _require_writable_targets(log: Path | None, rrd: Path | None) -> None:
    """SourceError if log or view cannot be written; ConfigError if the log's name is no log's.

    A name without an ending is a folder; it is made if there is none.
    """
    from twin.log.part import refuse_other_suffix

    require_writable(rrd)
    if log is None:
        return
    if log.suffix and not log.is_dir():
        refuse_other_suffix(log, "--log")
        require_writable(log)
    else:
        _require_folder(log)


def _require_folder(path: Path) -> None:
    """Make a folder if it does not exist; SourceError if it cannot be written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}", "name a folder, or a file.mcap") from error
    if not os.access(path, os.W_OK):
        raise SourceError(f"{path}: cannot be written to", "see to the rights of the folder")


def _file_of(path: Path | None, label: str, name: str) -> Path | None:
    """Log file of one ejector: run.mcap becomes run.rig-01.mcap; in a folder it is a new file."""
    if path is not None and path.is_dir():
        return path / time.strftime(f"{name}.%Y%m%dT%H%M%SZ.mcap", time.gmtime())
    return path.with_name(f"{path.stem}.{label}{path.suffix}") if path and label else path


@contextmanager
def _hinted(
    log: Path | None, say: Callable[[str], None] | None, *, hil: bool
) -> Iterator[Path | None]:
    """The log; a person at a terminal is told how the run ends, and what to do with it then."""
    if say is not None:
        hint(say, f"{f'log: {log}; ' if log else ''}Ctrl-C ends the run")
    yield log
    if say is not None and log is not None and not hil:
        page = log.with_suffix(PAGE)
        hint(say, f"{log} is written; next: twin diagnose {log} --report {page}")


@contextmanager
def _locked(
    settings: "Config", log: Path | None, complain: Callable[[str], None]
) -> Iterator[None]:
    """Lock the folders of this run for its unit; SourceError names another run that has them."""
    unit = " ".join(part for part in (settings.asset.type, settings.asset.id) if part)
    with ExitStack() as locks:
        for folder in sorted(_written_folders(settings, log)):
            locks.enter_context(only_run(folder, unit, time.time_ns(), complain))
        yield


def _written_folders(settings: "Config", log: Path | None) -> set[Path]:
    """The folders in which a second run of the unit would write the same data again."""
    from twin.alarms.database_url import place_of as alarms_in
    from twin.alarms.settings import AlarmSettings
    from twin.assets.engine import sqlite_file
    from twin.figures.database_url import place_of as figures_in
    from twin.figures.settings import FigureSettings

    document, urls = settings.document, list["URL"]()
    if document.section(AlarmSettings, "alarms").keep:
        urls.append(alarms_in(document))
    if document.section(FigureSettings, "figures").keep:
        urls.append(figures_in(document))
    files = (sqlite_file(url) or Path(document.name) for url in urls)  # or a server
    logs = [] if log is None else [log if log.is_dir() else log.parent]
    return {folder.resolve() for folder in [*logs, *(Path(file).parent for file in files)]}


def _retained(
    settings: "Config",
    log: "Sink | None",
    notices: "Notices",
    complain: Callable[[str], None],
) -> "AbstractContextManager[object]":
    """Keeps the logs of a live run within the bounds of [log]."""
    from twin.log.recorder import Recorder
    from twin.log.retention import GB, Bounds, Retention

    if not isinstance(log, Recorder):
        return nullcontext()
    log_settings, unit = settings.log, (settings.asset.type, settings.asset.id)
    bounds = Bounds(
        log_settings.keep_days,
        log_settings.keep_gb and log_settings.keep_gb * GB,
        log_settings.disk_pct / 100,
    )
    tell = partial(notices.tell, Kind.LOG_DELETED)
    return Retention(log.under_way.parent, unit, bounds, lambda: log.under_way, tell, complain)


def _diagnosing(
    settings: "Config",
    log: Path | None,
    stopped: Callable[[], str],
    complain: Callable[[str], None],
    *,
    alone: bool,
) -> "EventEnricher":
    """The enricher that has alarms of a live run diagnosed."""
    from twin.diagnosis.process import LiveDiagnosis

    return LiveDiagnosis(
        settings,
        str(log or "live"),
        lambda: stopped() == "interrupted",
        status if alone else no_status,
        reports=reports_of(settings, complain),
    )


def _answering(
    source: "Iterator[Samples]", settings: "Config", writer: "Writer"
) -> "Iterator[Samples]":
    """The blocks with the model as the plant: it answers the PLC's commands."""
    from drivers.outputs.writer import Outputs
    from twin.hil import Plant, in_place
    from twin.model.dataset import coefficients

    plant = Plant(coefficients(settings.data), settings.data.terms)
    return in_place(source, plant, lambda *values: writer.put(Outputs(*values)))


@contextmanager
def _acquired(
    source: "Iterator[Samples]", listening: "Listening", *, ahead: bool
) -> "Iterator[Acquisition]":
    """Acquires the rows of a run, ``ahead`` of its model; ``listening`` times them."""
    from twin.acquisition import Acquisition

    with closed(source):
        rows = Acquisition(source, ahead=ahead)
        listening.clock, listening.is_starting = rows.clock, rows.is_waiting
        with closed(rows):
            yield rows


def _loop(
    name: str,
    models: "Models",
    rows: "Acquisition",
    listening: "Listening",
    sinks: "Sequence[Sink]",
    advisers: "Sequence[EventEnricher]",
    stopped: Callable[..., str],
    limits: "LimitChanges | None",
) -> None:
    """Wait for the model of one ejector, and run the loop over all its rows.

    Rows that find no room meanwhile are logged without the model. So are all that wait where it
    does not come, as after an interrupt.
    """
    from twin.live import closing_all, dispatch_unmodelled, run

    logged, pair = 0, None
    try:
        while not models.wait(POLL_S) and stopped(begun=False) != "interrupted":
            logged += dispatch_unmodelled(sinks, rows.surplus(), "" if logged else TOO_MANY)
        if models.wait(0.0):
            pair = models.take(name)
    finally:
        if pair is None:
            rows.close()
            with closing_all(sinks, advisers):
                dispatch_unmodelled(sinks, rows.waiting(), ENDED)
    if pair is not None:
        if limits is not None:
            limits.attach(pair[1])
        gc.freeze()
        run(rows.blocks(), *pair, sinks, listening, advisers)


@contextmanager
def _gc_frozen() -> "Iterator[None]":
    """Exclude from garbage collection what is there when a loop begins (``_loop`` freezes it).

    Scanning it would delay a block by 0.2 s.
    """
    try:
        yield
    finally:
        gc.unfreeze()
