"""Time until a browser shows the first ejector, and until a run takes and logs its first rows."""

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack

from playwright.sync_api import Browser, sync_playwright

from benchmarks.figures import Measured, Run
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.plant import KEPT, configured, served
from benchmarks.processes import CONFIG, command, live, plc
from benchmarks.replay import IMPORTS, STARTS, seconds_of
from twin.log.reader import open_log

VIEWS = 7
LOOK_S = 0.005  # between looks at the log
# Runs before the page's own scripts: when the first ejector's button is drawn.
WATCH = """
window.firstShown = new Promise((resolve) => {
  new MutationObserver((_, watch) => {
    if (!document.querySelector("#ejectors button")) return;
    watch.disconnect();
    requestAnimationFrame(() => resolve(performance.now()));
  }).observe(document, { childList: true, subtree: true });
});
"""
PARSED = "performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd"


def page(run: Run) -> Sequence[Measured]:
    """Time (ms) from the request until the document is parsed, and until it shows an ejector."""
    path = shutil.which("chromium")
    if path is None:
        return (Measured((), note="no chromium"),) * 2
    with ExitStack() as stack:
        config = configured(run.folder / "first view", "rig-01", stack.enter_context(plc()), KEPT)
        stack.enter_context(live(run.folder / "first view.mcap", [config]))
        _, url = stack.enter_context(served(config))
        chromium = stack.enter_context(sync_playwright()).chromium
        browser = stack.enter_context(chromium.launch(executable_path=path))
        run.tell("first view")
        _view(browser, url)  # the server's first answer compiles its templates
        views = [_view(browser, url) for _ in range(VIEWS)]
    parsed, shown = zip(*views, strict=True)
    return Measured(parsed), Measured(shown)


def _view(browser: Browser, url: str) -> tuple[float, float]:
    """Times (ms) of one view with an empty cache: document parsed, first ejector drawn."""
    with browser.new_context() as context:
        context.add_init_script(WATCH)
        tab = context.new_page()
        tab.goto(url)
        shown = tab.evaluate("window.firstShown")
        return tab.evaluate(PARSED), shown


def row(run: Run) -> Sequence[Measured]:
    """Times (ms) of ``twin run`` until it has a row, and until its log holds rows.

    By turns with the imports alone.
    """
    with plc() as port:
        _started(run, port)  # compiles first
        run.tell("first row")
        starts = [
            (*_started(run, port), 1e3 * seconds_of([sys.executable, "-c", IMPORTS]))
            for _ in range(STARTS)
        ]
    taken, logged, floors = zip(*starts, strict=True)
    return Measured(taken, floors), Measured(logged, floors)


def _started(run: Run, port: int) -> tuple[float, float]:
    """Times (ms) from the start of ``twin run``: its first logged row came; its log has rows."""
    path = run.folder / "first row.mcap"
    begin_ns, begin, sizes = time.time_ns(), time.perf_counter(), set[int]()
    with on_core(TWIN_CORE):
        process = subprocess.Popen(command(path, (CONFIG,), port), stdout=subprocess.DEVNULL)
    with process:
        while len(sizes) < 2:
            if process.poll() is not None:
                sys.exit(f"twin run ended with exit code {process.returncode}")
            time.sleep(LOOK_S)
            if path.exists() and (size := path.stat().st_size):
                sizes.add(size)
        logged = 1e3 * (time.perf_counter() - begin)
        process.send_signal(signal.SIGINT)
    first, _ = next(open_log(path).blocks())
    path.unlink()  # a log is never overwritten
    return 1e-6 * float(first["host_ns"][0] - begin_ns), logged
