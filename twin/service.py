"""Notifies a service manager (sd_notify(3)): ready, stopping, and the watchdog of all loops.

It sends datagrams to the socket that ``NOTIFY_SOCKET`` names; without one it does nothing. If a
loop hangs, the watchdog is not fed, and systemd restarts the process.
"""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager, suppress
from typing import TypeVar

T = TypeVar("T")

FEEDS = 4  # within systemd's watchdog time; systemd advises at least two


class Service:
    """The manager of this process; feeds its watchdog while all loops ask whether to stop.

    The manager's variables are removed from ``environ``, so that children do not inherit them.
    """

    def __init__(
        self, environ: MutableMapping[str, str], clock: Callable[[], float] = time.monotonic
    ) -> None:
        address = environ.pop("NOTIFY_SOCKET", "")
        limit_us, pid = environ.pop("WATCHDOG_USEC", ""), environ.pop("WATCHDOG_PID", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        is_meant = limit_us.isdecimal() and pid in ("", str(os.getpid()))
        self._limit_s = int(limit_us) * 1e-6 if is_meant else 0.0  # 0: there is no watchdog
        self._clock = clock
        self._fed_s = -self._limit_s
        self._last_beat_s: dict[str, float] = {}  # last sign of life of each loop
        self._lock = threading.Lock()

    def __enter__(self) -> "Service":
        self._tell("READY=1")
        return self

    def __exit__(self, *_: object) -> None:
        self._tell("STOPPING=1")

    @contextmanager
    def loop(self, name: str, stopped: Callable[..., T]) -> Iterator[Callable[..., T]]:
        """Wrap the query ``stopped``; each call of it is a sign of life of the loop."""

        def query_and_beat(*arguments: object, **options: object) -> T:
            self._beat(name)
            return stopped(*arguments, **options)

        self._beat(name)
        try:
            yield query_and_beat
        finally:
            with self._lock:
                del self._last_beat_s[name]

    def _beat(self, name: str) -> None:
        with self._lock:
            now = self._last_beat_s[name] = self._clock()
            all_go_on = now - min(self._last_beat_s.values()) < self._limit_s
            if all_go_on and now - self._fed_s >= self._limit_s / FEEDS:
                self._fed_s = now
                self._tell("WATCHDOG=1")

    def _tell(self, state: str) -> None:
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as to_manager:
            to_manager.setblocking(False)  # do not wait for a hanging manager
            to_manager.sendto(state.encode(), self._address)
