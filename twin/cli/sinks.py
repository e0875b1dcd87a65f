"""Where rows go: the sinks of a live run, opened together and supervised, and the Rerun view."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

from twin.cli.console import Console
from twin.cli.figures import figure_writer_of
from twin.cli.serve import live_rows_of
from twin.errors import ConfigError
from twin.extras import require

if TYPE_CHECKING:
    from drivers.outputs.state import Results
    from twin.cli.notifications import Begin, Standing
    from twin.config import Config
    from twin.live import EventEnricher, Sink
    from twin.monitor.staleness import Notices
    from twin.view import Screen


def live_sinks(
    settings: "Config",
    console: Console,
    results: "Results | None",
    file: Path | None,
    view: "Callable[[], Sink] | None",
    complain: Callable[[str], None],
    *,
    hil: bool,
) -> "dict[str, Sink]":
    """Where the rows of a live run go, opened; a new destination is added here.

    The log comes last: messages to people do not wait for the disk.
    """
    return open_sinks(
        {
            "console": lambda: console,
            "OPC UA results": (lambda: results) if results else None,
            "key figures": figure_writer_of(settings, complain),
            "live page": live_rows_of(settings, complain, file),
            "view": view,
            "log": partial(_recorder, file, settings, hil=hil) if file else None,
        }
    )


def open_sinks(makers: "Mapping[str, Callable[[], Sink] | None]") -> "dict[str, Sink]":
    """Open the sinks; if one cannot be opened, those before it are closed."""
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


@contextmanager
def views_of(
    ejectors: "dict[str, Config]", view: bool, rrd: Path | None
) -> "Iterator[Callable[[str], Callable[[], Sink] | None]]":
    """Give a function that returns the opener of an ejector's view; all share a window or file."""
    if view and rrd is not None:
        raise ConfigError("--view and --rrd exclude each other", "open the file: rerun FILE.rrd")
    if view or rrd is not None:
        require("view", "the view")
    one_at_a_time, alone = Lock(), len(ejectors) == 1
    with ExitStack() as closing:

        @cache
        def screen() -> "Screen":  # opened by the first ejector that shows something
            from twin.view import Screen

            titles = [f"{config.asset.type} {config.asset.id}" for config in ejectors.values()]
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


def _recorder(file: Path, settings: "Config", *, hil: bool) -> "Sink":
    """The recorder of a live run's log."""
    from twin.log.header import HIL, RECORDED
    from twin.log.recorder import Recorder

    rotate = round(settings.log.rotate_mb * 1e6)
    metadata = {RECORDED: "twin run"}
    if hil:
        metadata[HIL] = "the pressure is the model's own, as it was written to the PLC"
    return Recorder(file, settings.log_header(metadata), rotate_bytes=rotate)


def supervised(
    sinks: "Mapping[str, Sink]", advisers: "Mapping[str, EventEnricher]", notices: "Notices"
) -> "tuple[list[Sink], list[EventEnricher]]":
    """The same with supervision: a failure of one does not end the run."""
    from twin.log.recorder import Recorder
    from twin.supervised import Outages, SupervisedEnricher, SupervisedSink

    outages = Outages(notices)

    def by_itself(name: str, sink: "Sink") -> "Sink":
        if isinstance(sink, Recorder):
            return SupervisedSink(name, sink, sink.again, outages, held=lambda: sink.held)
        rows = not isinstance(sink, Console)
        return SupervisedSink(name, sink, lambda: sink, outages, rows=rows)

    return (
        [by_itself(*item) for item in sinks.items()],
        [SupervisedEnricher(name, enricher, outages) for name, enricher in advisers.items()],
    )


def outlet_sinks(
    standing: "Standing", results: "Results | None", outlets: "Begin | None"
) -> "dict[str, Sink]":
    """Report the alarms that stand when a run begins; gives the sinks for further alarms."""
    if results is not None:
        results.resume(standing, time.time_ns())
    return {} if outlets is None else {"MQTT and webhook": outlets(standing)}
