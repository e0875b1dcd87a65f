"""A limit for a whole answer: the timeout of a socket limits only each piece of it."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def whole_within(sock: socket.socket, limit_s: float) -> Iterator[None]:
    """Shut a socket down if the block lasts longer than ``limit_s``; TimeoutError then."""
    timed_out = threading.Event()

    def shut_down() -> None:
        timed_out.set()
        with suppress(OSError):  # it is closed already
            sock.shutdown(socket.SHUT_RDWR)

    timer = threading.Timer(limit_s, shut_down)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()
        if timed_out.is_set():  # a truncated answer may look whole
            raise TimeoutError("timed out")
