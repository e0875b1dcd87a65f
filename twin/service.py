"""What a service manager is told (sd_notify(3)): ready, stopping, and that every loop goes on.

A datagram to the socket that ``NOTIFY_SOCKET`` names; without one nobody is told, and nothing is
different. A loop that hangs keeps the watchdog unfed, and systemd starts the process anew.
"""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager, suppress
from typing import TypeVar

T = TypeVar("T")

FEEDS = 4  # within the time after which systemd would act; it advises at least two


class Service:
    """The manager of this process; it feeds its watchdog as long as all loops ask whether to stop.

    ``environ`` loses what the manager put there for this process: children do not speak for it.
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
        self._heard_s: dict[str, float] = {}  # when each loop was heard of last
        self._lock = threading.Lock()

    def __enter__(self) -> "Service":
        self._tell("READY=1")
        return self

    def __exit__(self, *_: object) -> None:
        self._tell("STOPPING=1")

    @contextmanager
    def loop(self, name: str, stopped: Callable[..., T]) -> Iterator[Callable[..., T]]:
        """Give the question ``stopped`` back; that a loop asks it says that the loop goes on."""

        def asked(*arguments: object, **options: object) -> T:
            self._hear(name)
            return stopped(*arguments, **options)

        self._hear(name)
        try:
            yield asked
        finally:
            with self._lock:
                del self._heard_s[name]

    def _hear(self, name: str) -> None:
        with self._lock:
            now = self._heard_s[name] = self._clock()
            all_go_on = now - min(self._heard_s.values()) < self._limit_s
            if all_go_on and now - self._fed_s >= self._limit_s / FEEDS:
                self._fed_s = now
                self._tell("WATCHDOG=1")

    def _tell(self, state: str) -> None:
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as to_manager:
            to_manager.setblocking(False)  # a manager that hangs is not waited for
            to_manager.sendto(state.encode(), self._address)
