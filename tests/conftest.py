"""What every test stands under: it must leave no task, thread, socket or process behind."""

import asyncio
import gc
import threading
import time
from collections.abc import Iterator

import psutil
import pytest

_ME = psutil.Process()


def _alive() -> set[str]:
    """Name what could be left behind: threads, children, sockets and asyncio tasks."""
    threads = {f"thread {t.name} ({t.ident})" for t in threading.enumerate()}
    children = {f"process {p.pid}" for p in _ME.children(recursive=True)}
    sockets = {f"socket {c.laddr} {c.status}" for c in _ME.net_connections(kind="inet")}
    try:
        tasks = {f"task {t.get_name()}" for t in asyncio.all_tasks(asyncio.get_running_loop())}
    except RuntimeError:  # no loop is running
        tasks = set()
    return threads | children | sockets | tasks


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    before = _alive()
    yield
    for patience in (0.0, 0.05, 0.2, 0.5, 1.0):  # closing is not instant; give it a moment
        time.sleep(patience)
        gc.collect()
        left = _alive() - before
        if not left:
            return
    pytest.fail(f"left behind: {', '.join(sorted(left))}")
