"""The command line: the only place where the twin meets the drivers.

Imports stand inside the commands so that ``twin --help`` is quick. What a command finds goes to
stdout, what it has to say about its work to stderr.
"""

import json
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from twin.errors import ConfigError, TwinError
from twin.events import Event, Severity

if TYPE_CHECKING:
    from twin.config import Config
    from twin.live import Sink, Twin
    from twin.log.header import LogHeader
    from twin.monitor.detect import Monitor
    from twin.signals import Samples, Ticks

INTERRUPTED = 130
ALARMED = 1

app = typer.Typer(
    help="A live digital twin of pneumatic vacuum ejectors.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
log_app = typer.Typer(help="Look after logs.", no_args_is_help=True)
app.add_typer(log_app, name="log")

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="TOML configuration.")]
LogFile = Annotated[Path, typer.Argument(metavar="LOG.mcap", help="A recorded log.")]
Address = Annotated[
    str, typer.Option(metavar="HOST:PORT", help="Where the PLC is, instead of the configuration's.")
]
ViewFlag = Annotated[bool, typer.Option("--view", help="Open the Rerun viewer.")]
RrdFile = Annotated[Path | None, typer.Option(metavar="F.rrd", help="Write the view to a file.")]
FailOnAlarm = Annotated[bool, typer.Option(help="Exit with 1 if an alarm was raised.")]


@app.command()
def run(
    config: ConfigFile,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="Stop after S seconds.")
    ] = None,
    log: Annotated[Path | None, typer.Option(metavar="FILE", help="Write an MCAP log.")] = None,
    view: ViewFlag = False,
    rrd: RrdFile = None,
    address: Address = "",
    fail_on_alarm: FailOnAlarm = False,
) -> None:
    """Run the twin beside a PLC: read, expect, compare, log, alarm. Ctrl-C ends it."""
    from drivers.sources import open_source
    from twin.config import Config
    from twin.live import run as run_loop
    from twin.log.recorder import Recorder
    from twin.settings import Document

    settings = Config.of(Document.read(config))
    twin, monitor = _pair(settings)
    with _stop_on_signal(duration) as stopped:
        # A PLC that does not answer is said before a log is begun.
        source = _begun(open_source(settings.document, address))
        rotate = round(settings.log.rotate_mb * 1e6)
        console = Console()
        sinks = _opened(
            (lambda: Recorder(log, _header(settings), rotate_bytes=rotate)) if log else None,
            _view_of(settings, view, rrd),
            lambda: console,
        )
        run_loop(_until(stopped, source), twin, monitor, sinks)
        _leave(console, fail_on_alarm, interrupted=stopped() == "interrupted")


@app.command()
def replay(
    log: LogFile,
    config: Annotated[Path | None, typer.Option(help="Instead of the one in the log.")] = None,
    output: Annotated[Path | None, typer.Option("-o", metavar="OUT.mcap", help="New log.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="F", help="Events.")] = None,
    view: ViewFlag = False,
    rrd: RrdFile = None,
    fail_on_alarm: FailOnAlarm = False,
) -> None:
    """Run the same loop over a recorded log, as fast as it goes."""
    from twin.live import run as run_loop
    from twin.log.reader import open_log
    from twin.log.recorder import Recorder

    recorded = open_log(log)
    settings = _settings_of(recorded.header, config)
    twin, monitor = _pair(settings)
    with _stop_on_signal(None) as stopped:
        console = Console()
        sinks = _opened(
            (lambda: Recorder(output, _header(settings))) if output else None,
            _view_of(settings, view, rrd),
            lambda: console,
        )
        blocks = (samples for samples, _ in recorded.blocks())
        run_loop(_until(stopped, _progress(blocks, "replaying")), twin, monitor, sinks)
    if json_file is not None:
        events = [_plain(event) for event in console.events]
        json_file.write_text(json.dumps({"log": str(log), "events": events}, indent=1))
    _leave(console, fail_on_alarm, interrupted=stopped() == "interrupted")


@app.command()
def plc(
    config: ConfigFile,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE[@START][/COURSE]", help="For example leakage=2.0@10."),
    ] = None,
    port: Annotated[int | None, typer.Option(help="Modbus TCP port; 0 takes any free.")] = None,
    seed: Annotated[int, typer.Option(help="Of everything that is random.")] = 0,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="Stop after S seconds.")
    ] = None,
) -> None:
    """Run the simulated PLC with an ejector behind it, for trials and tests."""
    from drivers.plc.faults import parse_fault
    from drivers.plc.live import run_plc
    from drivers.plc.settings import PlcSettings
    from twin.settings import Document

    settings = Document.read(config).section(PlcSettings, "plc").on_port(port)
    run_plc(settings, [parse_fault(text) for text in fault or []], seed, duration)


@app.command()
def probe(config: ConfigFile, address: Address = "") -> None:
    """Say what a PLC at the configured address answers, word order included."""
    from drivers.sources import probe_source
    from twin.settings import Document

    for line in probe_source(Document.read(config), address):
        print(line)


@app.command()
def diagnose(
    log: LogFile,
    config: Annotated[Path | None, typer.Option(help="Instead of the one in the log.")] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="F", help="The answer.")
    ] = None,
    report: Annotated[Path | None, typer.Option(metavar="F.html", help="With pictures.")] = None,
) -> None:
    """Say what the simulation gets wrong on a log, why, and what knowing it gains."""
    from twin.diagnosis.answer import diagnose as find_cause
    from twin.diagnosis.report import in_words, write_report
    from twin.log.reader import open_log

    recorded = open_log(log)
    settings = _settings_of(recorded.header, config)
    with _status() as say:
        diagnosis = find_cause(settings, (rows for rows, _ in recorded.blocks()), str(log), say)
    print(in_words(diagnosis))
    if json_file is not None:
        json_file.write_text(json.dumps(diagnosis.json, indent=1, ensure_ascii=False))
    if report is not None:
        write_report(diagnosis, report)


@app.command()
def effects() -> None:
    """List the effects: every way a real ejector can differ from its data set."""
    from twin.model.effects import table

    print(table())


@log_app.command()
def check(log: LogFile) -> None:
    """Say what a log holds and whether it is whole."""
    from twin.log.check import check as check_log

    report = check_log(log)
    print(report)
    raise typer.Exit(0 if report.sound else 3)


@log_app.command()
def recover(
    log: LogFile, output: Annotated[Path, typer.Option("-o", metavar="OUT.mcap", help="New log.")]
) -> None:
    """Write a complete log of everything that can be read in a damaged or unfinished one."""
    from twin.log.check import recover as recover_log

    print(recover_log(log, output))


def main() -> None:
    """Run the command line; errors become one message with a hint, and the exit code."""
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except TwinError as error:
        hint = f"\n  {error.hint}" if error.hint else ""
        print(f"twin: {error}{hint}", file=sys.stderr)
        sys.exit(error.exit_code)


# --- what the commands share --------------------------------------------------------------------


class Console:
    """A sink that prints what happens, one line each; cycles only where nobody redirects it."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def write(self, _samples: "Samples", _ticks: "Ticks", events: Sequence[Event]) -> None:
        """Print what happened."""
        for event in events:
            self.events.append(event)
            stamp = time.strftime("%H:%M:%S", time.gmtime(event.time_ns // 1_000_000_000))
            milli = event.time_ns // 1_000_000 % 1000
            line = f"{stamp}.{milli:03d}  {event.severity:<7}  {event.kind:<17}  {event.text}"
            print(line, flush=True)

    def close(self) -> None:
        """Nothing to finish."""


def _pair(settings: "Config") -> tuple["Twin", "Monitor"]:
    """The twin of a configuration and its monitor."""
    from twin.live import compiled
    from twin.model.dataset import coefficients
    from twin.monitor.detect import Monitor
    from twin.monitor.phases import expected_knees
    from twin.signals import MBAR

    theta = coefficients(settings.data)
    knees = expected_knees(theta, settings.data.sensor.noise_mbar * MBAR)
    return compiled(theta, knees), Monitor(settings.monitor, theta)


def _header(settings: "Config") -> "LogHeader":
    """What a log must carry to be replayed alone."""
    from importlib.metadata import version

    from twin.log.header import LogHeader
    from twin.signals import MBAR

    return LogHeader(
        asset_type=settings.asset.type,
        asset_id=settings.asset.id,
        config_name=Path(settings.document.name).name,
        config_text=settings.document.text,
        metadata={"data_set": settings.data.hash, "program": version("ejector-twin")},
        ambient=settings.data.ambient.pressure_mbar * MBAR,
    )


def _settings_of(header: "LogHeader", instead: Path | None) -> "Config":
    """The configuration a log carries, or another one."""
    from twin.config import Config
    from twin.settings import Document

    if instead is not None:
        return Config.of(Document.read(instead))
    return Config.of(Document.parse(header.config_text, header.config_name))


def _opened(*makers: "Callable[[], Sink] | None") -> "list[Sink]":
    """The sinks that are wanted; if one cannot be opened, those before it are closed."""
    sinks: list[Sink] = []
    try:
        for make in makers:
            if make is not None:
                sinks.append(make())
    except BaseException:
        for sink in sinks:
            sink.close()
        raise
    return sinks


def _view_of(settings: "Config", view: bool, rrd: Path | None) -> "Callable[[], Sink] | None":
    """What opens the Rerun view, in a window or in a file; or None."""
    if not view and rrd is None:
        return None
    if view and rrd is not None:
        raise ConfigError("--view and --rrd exclude each other", "open the file: rerun FILE.rrd")

    def open_view() -> "Sink":
        from twin.signals import MBAR
        from twin.view import View

        title = f"{settings.asset.type} {settings.asset.id}"
        shown = View(title, rrd, settings.data.ambient.pressure_mbar * MBAR)
        if shown.url:
            print(f"the view is at {shown.url}", file=sys.stderr)
        return shown

    return open_view


def _begun(source: "Iterator[Samples]") -> "Iterator[Samples]":
    """The same blocks, the first of them already fetched."""
    first = next(source)

    def blocks() -> "Iterator[Samples]":
        yield first
        yield from source

    return blocks()


@contextmanager
def _stop_on_signal(duration: float | None) -> Iterator[Callable[[], str]]:
    """Give a function that says why to stop: "" (go on), "duration" or "interrupted".

    The first Ctrl-C lets the loop finish its block and close the log; the second one is Python's.
    """
    end = None if duration is None else time.monotonic() + duration
    reason = ""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal reason
        if reason == "interrupted":
            raise KeyboardInterrupt
        reason = "interrupted"

    def why() -> str:
        nonlocal reason
        if not reason and end is not None and time.monotonic() >= end:
            reason = "duration"
        return reason

    before = {
        number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)
    }
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
        yield lambda _what: None
        return
    from rich.console import Console as Terminal

    with Terminal(stderr=True).status("") as status:
        yield status.update


def _leave(console: Console, fail_on_alarm: bool, *, interrupted: bool) -> None:
    """Exit as the contract of the command line has it."""
    if interrupted:
        raise typer.Exit(INTERRUPTED)
    if fail_on_alarm and any(event.severity is Severity.ALARM for event in console.events):
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
