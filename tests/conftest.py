"""What every test stands under: it must leave no task, thread, socket or process behind.

And what takes long to come by and is shared: a simulated PLC beside the tests of a module.
"""

import asyncio
import gc
import itertools
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
import rigs
from hypothesis import settings
from independent import missing
from opcua_plc import OpcuaPlc, start_opcua
from playwright.sync_api import Browser, expect, sync_playwright
from plc_process import PlcProcess, start_plc
from postgres import make_schema, postgres_server

from twin.cli import pair_of

_ME = psutil.Process()
_SCHEMAS = itertools.count()

settings.register_profile("untimed", deadline=None)  # what is slow here may be quick elsewhere
settings.load_profile("untimed")


def _alive() -> set[str]:
    """Name what could be left behind: threads, children, sockets and asyncio tasks.

    What a child starts is the child's: a browser starts and ends processes whenever it likes.
    """
    threads = {f"thread {t.name} ({t.ident})" for t in threading.enumerate()}
    children = {f"process {p.pid}" for p in _ME.children()}
    sockets = {f"socket {c.laddr} {c.status}" for c in _ME.net_connections(kind="inet")}
    try:
        tasks = {f"task {t.get_name()}" for t in asyncio.all_tasks(asyncio.get_running_loop())}
    except RuntimeError:  # no loop is running
        tasks = set()
    return threads | children | sockets | tasks


@contextmanager
def _nothing_left_behind() -> Iterator[None]:
    before = _alive()
    yield
    for patience in (0.0, 0.05, 0.2, 0.5, 1.0):  # closing is not instant; give it a moment
        time.sleep(patience)
        left = _alive() - before
        if not left:
            return
        gc.collect()
    pytest.fail(f"left behind: {', '.join(sorted(left))}")


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    with _nothing_left_behind():
        yield


@pytest.fixture(scope="session", autouse=True)
def nothing_left_by_what_is_shared() -> Iterator[None]:
    with _nothing_left_behind():
        yield


@pytest.fixture(scope="module")
def plc() -> Iterator[PlcProcess]:
    """The gripper's PLC in a process of its own; nobody may write to it or stop it."""
    with start_plc(rigs.path_of("gripper")) as running:
        yield running


@pytest.fixture(scope="session")
def opcua(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpcuaPlc]:
    """A PLC that serves OPC UA with every policy, and lets anybody in; nobody may stop it."""
    policies = ["None", "Basic256Sha256", "Aes256Sha256RsaPss"]
    with start_opcua(tmp_path_factory.mktemp("opcua"), policies=policies) as running:
        yield running


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def server(request: pytest.FixtureRequest) -> Iterator[Path | None]:
    """The folder of PostgreSQL's socket, or None for SQLite."""
    if request.param == "sqlite":
        yield None
        return
    with postgres_server() as folder:
        yield folder


@pytest.fixture
def url(server: Path | None, tmp_path: Path) -> str:
    """A database that is not there yet, or is empty."""
    if server is None:
        return f"sqlite:///{tmp_path / 'test.sqlite'}"
    return make_schema(server, f"test{next(_SCHEMAS)}")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A real Chromium; each test opens a page of its own and closes it."""
    path = shutil.which("chromium")
    if path is None:
        missing("chromium", "on Debian or Ubuntu: apt install chromium")
    expect.set_options(timeout=30e3)  # ms: the machine may be busy
    with sync_playwright() as playwright, playwright.chromium.launch(executable_path=path) as found:
        yield found


@pytest.fixture(scope="session", autouse=True)
def compiled_once() -> None:
    """Compile before a child process has to: tests wait for what it does, not for a compiler."""
    pair_of(rigs.config("gripper"))  # all that a live loop needs
