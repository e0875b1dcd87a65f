"""What every test stands under: it must leave no task, thread, socket or process behind.

And what takes long to come by and is shared: a simulated PLC beside the tests of a module.
"""

import asyncio
import gc
import itertools
import os
import shutil
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import once
import psutil
import pytest
import rigs
from hypothesis import settings
from needs import NEEDS, Programs
from opcua_plc import OpcuaPlc, start_opcua
from playwright.sync_api import Browser, expect, sync_playwright
from plc_process import PlcProcess, start_plc
from postgres import make_schema, postgres_server

from tools import battery_first
from twin.cli.figures import figures_app
from twin.cli.setup import pair_of

_ME = psutil.Process()
_SCHEMAS = itertools.count()
_PROGRAMS = pytest.StashKey[Programs]()
_LEFT_OUT = pytest.StashKey[Counter[str]]()

settings.register_profile("untimed", deadline=None)  # what is slow here may be quick elsewhere
settings.load_profile("untimed")


# --- how files are divided ------------------------------------------------------------------------

# The files that take longest, as measured in CI. They go first, so that no process is alone with
# one at the end, and those that calculate beside those that wait for a PLC or a browser.
FIRST = (
    *("battery", "journeys", "hidden_mechanisms", "diagnosis", "fault_run", "base_installation"),
    *("hidden_mechanisms_second", "rhythms_commissioned", "peers"),
    *("first_change", "page_browser", "mechanisms", "hil", "site", "another_day", "run_many"),
    *("unmodelled", "cli", "commission", "written_pages", "signal_checks", "page_past", "results"),
    *("healthy", "started_at_once", "measured_supply", "calibration", "page_all", "report", "aas"),
)
MOST_PROCESSES = 4


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: a test in four waits for something that is not calculated."""
    return min((psutil.cpu_count() or 1) + 1, MOST_PROCESSES)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {f"test_{name}": place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


# --- programs of the system ---------------------------------------------------------------------


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--without",
        action="append",
        default=[],
        choices=["all", *NEEDS],
        help="hide programs of the system, as if they were not installed",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_LEFT_OUT] = Counter()
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        return  # the processes that run tests look for programs themselves, on this path
    without = config.getoption("--without")
    folder = tempfile.TemporaryDirectory(prefix="needs")
    config.add_cleanup(folder.cleanup)
    Path(folder.name).chmod(0o755)  # PostgreSQL runs as another user
    programs = Programs(Path(folder.name), [*NEEDS] if "all" in without else without)
    config.add_cleanup(programs.close)
    config.stash[_PROGRAMS] = programs


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """A test finds the programs that it names; it is skipped without, but fails in CI."""
    programs = item.config.stash[_PROGRAMS]
    names = list(dict.fromkeys(name for mark in item.iter_markers("needs") for name in mark.args))
    missing = [name for name in names if programs.is_missing(name)]
    if not missing:
        programs.offer(names)
        return
    packages = " ".join(package for name in missing for package in NEEDS[name].packages)
    reason = f"no {', '.join(missing)} (make peers; on Debian or Ubuntu: apt install {packages})"
    if os.environ.get("CI") == "true":
        pytest.fail(reason, pytrace=False)
    item.config.stash[_LEFT_OUT].update(missing)
    pytest.skip(reason)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A process of several hands over what it has left out."""
    handed = getattr(session.config, "workeroutput", None)
    if handed is not None:
        handed["left_out"] = dict(session.config.stash[_LEFT_OUT])


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take it from a process that has ended; one that has died hands over nothing."""
    node.config.stash[_LEFT_OUT].update(getattr(node, "workeroutput", {}).get("left_out", {}))


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Say what stayed untested for want of a program."""
    left_out = config.stash[_LEFT_OUT]
    if not left_out:
        return
    terminalreporter.section("left out: make peers installs what these tests need")
    rows = [("tests", "need", "Debian packages", "what stays untested")]
    for name, need in NEEDS.items():
        if left_out[name]:
            rows.append((str(left_out[name]), name, " ".join(need.packages), need.tested))
    for tests, name, packages, tested in rows:
        terminalreporter.write_line(f"{tests:>5}  {name:<10}  {packages:<25}  {tested}")


# --- nothing is left behind ---------------------------------------------------------------------


def _alive() -> set[str]:
    """Name what could be left behind: threads, children, sockets and asyncio tasks.

    What a child starts is the child's: a browser starts and ends processes whenever it likes.
    """
    threads = {f"thread {t.name} ({t.ident})" for t in threading.enumerate()}
    children = {f"process {child}" for child in _children()}
    sockets = set(_inet_sockets(_open_sockets()))
    try:
        tasks = {f"task {t.get_name()}" for t in asyncio.all_tasks(asyncio.get_running_loop())}
    except RuntimeError:  # no loop is running
        tasks = set()
    return threads | children | sockets | tasks


def _children() -> list[int]:
    """Process numbers; the kernel says at once that there is none, as in most tests."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return []
    return [child.pid for child in _ME.children()]


def _open_sockets() -> frozenset[str]:
    """The sockets among the open files of this process, of any family."""
    found = set()
    for descriptor in os.listdir("/proc/self/fd"):  # noqa: PTH208 - a hundred Paths take as long
        with suppress(FileNotFoundError):  # that of the listing
            found.add(os.readlink(f"/proc/self/fd/{descriptor}"))  # noqa: PTH115
    return frozenset(name for name in found if name.startswith("socket:"))


@lru_cache(maxsize=1)  # to look up addresses takes 7 ms, and most tests open no socket
def _inet_sockets(_sockets: frozenset[str]) -> list[str]:
    return [f"socket {c.laddr} {c.status}" for c in _ME.net_connections(kind="inet")]


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


# --- what is shared -----------------------------------------------------------------------------


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


@pytest.fixture(
    scope="module",
    params=["sqlite", pytest.param("postgresql", marks=pytest.mark.needs("postgresql"))],
)
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


@pytest.fixture(
    scope="module", params=[pytest.param("chromium", marks=pytest.mark.needs("chromium"))]
)
def browser() -> Iterator[Browser]:
    """A real Chromium; each test opens a page of its own and closes it."""
    path = shutil.which("chromium")
    expect.set_options(timeout=30e3)  # ms: the machine may be busy
    with sync_playwright() as playwright, playwright.chromium.launch(executable_path=path) as found:
        yield found


@pytest.fixture(scope="session", autouse=True)
def calculated_once(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> None:
    """Processes of one run share what was calculated once."""
    if hasattr(request.config, "workerinput"):
        once.share(tmp_path_factory.getbasetemp().parent / "shared")
    battery_first.unit = once.once(battery_first.unit)  # two calibrations


@pytest.fixture(scope="session", autouse=True)
def compiled_once(calculated_once: None) -> None:
    """Compile before a child process has to: tests wait for what it does, not for a compiler."""
    with once.alone("compiled"):
        pair_of(rigs.config("gripper"))  # all that a live loop needs


@pytest.fixture
def figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Run a command of `twin figures` in an empty folder; gives what it printed."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str | Path) -> str:
        figures_app([str(argument) for argument in arguments], standalone_mode=False)
        return capsys.readouterr().out

    return command
