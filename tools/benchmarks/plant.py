"""Loads of a plant: one ejector with everything on and its page open, several in one process."""

import json
import subprocess
import threading
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import psutil
import tomli_w
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from benchmarks.figures import Measured, Run
from benchmarks.machine import PLC_CORE, on_core
from benchmarks.processes import CONFIG, TWIN, live, plc

SLICE_S, SHORT_SLICE_S, SLICES, LONG_SLICES = 10.0, 5.0, 3, 60
KEPT = {"figures": {"keep": True}, "alarms": {"keep": True}, "page": {"keep": True}}


def watched(run: Run) -> Sequence[Measured]:
    """CPU shares of a run that stores everything, and of its page with one browser."""
    with ExitStack() as stack:
        config = configured(run.folder / "watched", "rig-01", stack.enter_context(plc()), KEPT)
        process = stack.enter_context(live(run.folder / "watched.mcap", [config]))
        page, url = stack.enter_context(served(config))
        stack.enter_context(_client(url))
        shares = _shares(run, "a page open", [process.pid, page])
    return tuple(Measured(series) for series in zip(*shares, strict=True))


@contextmanager
def together(
    run: Run, ports: Sequence[int]
) -> Iterator[tuple["subprocess.Popen[bytes]", list[Path]]]:
    """Run one process with an ejector for each of these PLCs; yields it and the logs."""
    names = [f"rig-{number + 1:02}" for number in range(len(ports))]
    folder = run.folder / f"{len(ports)} together"
    log = folder / "log.mcap"
    pairs = zip(names, ports, strict=True)
    configs = [configured(folder / name, name, port, {}) for name, port in pairs]
    # A single ejector's log has the given name.
    logs = [log.with_suffix(f".{name}.mcap") for name in names] if len(ports) > 1 else [log]
    with live(log, configs, logs) as process:
        yield process, logs


def configured(folder: Path, name: str, port: int, more: dict[str, dict[str, bool]]) -> Path:
    """The test rig's configuration for another ejector, in a new folder."""
    tables = tomllib.loads(CONFIG.read_text(encoding="utf-8")) | more
    tables["asset"]["id"], tables["driver"]["port"] = name, port
    folder.mkdir(parents=True)
    path = folder / "rig.toml"
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return path


def _shares(run: Run, name: str, numbers: Sequence[int]) -> list[list[float]]:
    """CPU times (% of a core) of some processes over each slice."""
    slices, slice_s = (LONG_SLICES, SLICE_S) if run.long else (SLICES, SHORT_SLICE_S)
    processes = [psutil.Process(number) for number in numbers]
    shares = []
    for number in range(slices):
        run.tell(f"{name}: slice {number + 1} of {slices}")
        for process in processes:
            process.cpu_percent()
        time.sleep(slice_s)
        shares.append([process.cpu_percent() for process in processes])
    return shares


@contextmanager
def served(config: Path) -> Iterator[tuple[int, str]]:
    """Run ``twin serve`` of one ejector; yields its process number, and its address."""
    command = [TWIN, "serve", "--port", "0", "--config", config]
    with on_core(PLC_CORE):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    with process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().removeprefix("the page is at ").strip().rstrip("/")
            yield process.pid, url
        finally:
            process.terminate()


@contextmanager
def _client(url: str) -> Iterator[None]:
    """A client of the page that reads everything it is told."""
    with connect(f"ws{url.removeprefix('http')}/live", origin=url) as browser:
        browser.send("0")
        while "rows" not in json.loads(browser.recv()):
            pass
        taking = threading.Thread(target=_take, args=(browser,))
        taking.start()
        yield
    taking.join()


def _take(browser: ClientConnection) -> None:
    """Read and drop messages until the connection closes."""
    with suppress(ConnectionClosed):
        for _ in browser:
            pass
