"""``twin replay``: the same loop over a recorded log."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from twin.cli.alarms import alarms_of
from twin.cli.app import say_if_cut
from twin.cli.console import Console, EventRecorder, progress
from twin.cli.options import (
    JSON,
    AsOf,
    AssetsUrl,
    ConfigOption,
    FailOnAlarm,
    LogFile,
    RrdFile,
    UnitId,
    ViewFlag,
    written_as,
)
from twin.cli.setup import pair_of, settings_of
from twin.cli.sinks import open_sinks, views_of
from twin.cli.stopping import leave, stop_on_signal, until
from twin.files import require_writable, write_json


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
        Path | None,
        typer.Option(
            "--json", metavar="F", callback=written_as(JSON), help="Write the events as JSON."
        ),
    ] = None,
    view: ViewFlag = False,
    rrd: RrdFile = None,
    fail_on_alarm: FailOnAlarm = False,
) -> None:
    """Run the same loop over a recorded log, as fast as it goes."""
    with _gc_paused():
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
        settings = settings_of(recorded.header, log, config, assets, unit, as_of)
        twin, monitor = pair_of(settings, judges=not recorded.header.derived)
        alarms = alarms_of(settings)()
    with views_of({"": settings}, view, rrd) as view_of, stop_on_signal(None) as stopped:
        console, recorder = Console(), EventRecorder() if json_file else None
        header = settings.log_header(recorded.header.unmeasured)
        sinks = open_sinks(
            {
                "log": partial(Recorder, output, header) if output else None,
                "view": view_of(""),
                "console": lambda: console,
                "events": (lambda: recorder) if recorder else None,
            }
        )
        blocks = progress((samples for samples, _ in recorded.blocks(REPLAYED)), "replaying")
        run_loop(until(stopped, blocks), twin, monitor, [*sinks.values()], advisers=[alarms])
    if json_file is not None and recorder is not None:
        write_json(json_file, {"log": str(log), "events": recorder.events})
    alarmed = fail_on_alarm and console.alarmed
    leave(alarmed, interrupted=stopped() == "interrupted")


@contextmanager
def _gc_paused() -> "Iterator[None]":
    """Pause the garbage collector while a command starts: nothing allocated then is garbage."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()  # else it would scan all of it now
        gc.enable()
