"""Sinks of rows: opened together, and the Rerun view."""

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

from twin.errors import ConfigError
from twin.extras import require

if TYPE_CHECKING:
    from twin.config import Config
    from twin.live import Sink
    from twin.view import Screen


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
