"""Connections that the ejectors of one process share: PLCs grant few of them."""

import threading
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

C = TypeVar("C")


class ConnectionPool:
    """The shared connections of a process, of any driver.

    It closes none: the last who uses a connection does.
    """

    def __init__(self) -> None:
        self._connections: dict[Hashable, Any] = {}
        self._lock = threading.RLock()  # ejectors ask from threads of their own

    def shared(self, key: Hashable, make: Callable[[], C]) -> C:
        """The one connection of this ``key``, made by the first who asks for it.

        A key begins with the kind of driver, so that drivers do not mix. All wait for ``make``:
        what it makes should connect at its first use. If ``make`` fails, the next to ask tries.
        """
        with self._lock:
            if key not in self._connections:
                self._connections[key] = make()
            connection: C = self._connections[key]
        return connection
